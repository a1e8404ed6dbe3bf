"""PPO against numbers derived by hand, and on inputs that break careless code."""

import copy
import math
from dataclasses import asdict
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
from tactilerl.algos import DivergenceError, recipes
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.policy import Policy, Spaces
from tactilerl.algos.ppo import (
    PPO,
    Gaussian,
    GaussianNoise,
    PPOConfig,
    Silence,
    explained_variance,
    gae,
    normalize,
    surrogate,
)
from tactilerl.envs import vector

from states import flat
from states import vector as parameters

SMALL = dict(hidden=(32, 32), steps_per_epoch=60, n_passes=5)
ROBUST = {**asdict(recipes.recipe("ppo", "robust")), **SMALL, "minibatch_size": 16}


class ScriptedEnv(gym.Env):
    """Rewards, observations and ends of episodes are given; random ones follow from the seed."""

    def __init__(self, obs=None, reward=None, length=5, terminated=True, info=None, space=None):
        self.observation_space = space or gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.obs = obs or (lambda rng: rng.standard_normal(3).astype(np.float32))
        self.reward = reward or (lambda rng: float(rng.standard_normal()))
        self.info = info or (lambda step: {})
        self.length, self.terminated = length, terminated
        self.steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.obs(self.np_random), {}

    def step(self, action):
        self.steps += 1
        ended = self.steps >= self.length
        flags = (ended and self.terminated, ended and not self.terminated)
        return self.obs(self.np_random), self.reward(self.np_random), *flags, self.info(self.steps)


def scripted(**choices):
    return vector.start(partial(ScriptedEnv, **choices))


def make_ppo(workers, seed=0, comm=None, **choices):
    config = PPOConfig(**{**SMALL, **choices})
    return PPO(config, workers, comm or Communicator(), seed, total_timesteps=1000)


def trained(ppo, epochs, state=None):
    if state is not None:
        ppo.load_state_dict(state)
    for _ in range(epochs):
        ppo.collect()
        ppo.update()
    return ppo


def values_of(ppo, obs):
    return ppo.critic(torch.from_numpy(np.stack(obs))).detach().numpy().ravel()


class TestAdvantagesAndLoss:
    def test_advantages_of_three_steps_by_hand(self):
        # gamma = lambda = 1/2; deltas: 1 + .5*2 - 1 = 1, 2 + .5*4 - 2 = 2, 3 + 0 - 4 = -1
        # backwards: -1, 2 - 1/4 = 1.75, 1 + 1.75/4 = 1.4375
        rewards, values = np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 4.0])
        assert gae(rewards, values, 0.0, 0.5, 0.5).tolist() == [1.4375, 1.75, -1.0]
        # with 6 after them the last delta is 3 + .5*6 - 4 = 2
        assert gae(rewards, values, 6.0, 0.5, 0.5).tolist() == [1.0 + (2.0 + 2.0 / 4) / 4, 2.5, 2.0]

    def test_clipped_loss_case_by_case(self):
        # ratios 1.5, 1.5, 0.5, 0.5 and advantages 1, -1, 1, -1 at clip 0.2:
        # min(1.5, 1.2) = 1.2; min(-1.5, -1.2) = -1.5; min(.5, .8) = .5; min(-.5, -.8) = -.8
        log_ratio = torch.tensor([1.5, 1.5, 0.5, 0.5]).log()
        got = surrogate(log_ratio, torch.tensor([1.0, -1.0, 1.0, -1.0]), 0.2)
        assert got.loss.tolist() == pytest.approx([-1.2, 1.5, -0.5, 0.8], rel=1e-6)
        assert got.is_clipped.tolist() == [True] * 4

    @pytest.mark.parametrize("gap", [1e3, -1e3])
    @pytest.mark.parametrize("advantage", [1.0, -1.0])
    def test_overflowing_ratio_stays_finite(self, gap, advantage):
        log_ratio = torch.tensor([gap], requires_grad=True)
        loss, kl, _ = surrogate(log_ratio, torch.tensor([advantage]), 0.2)
        loss.backward()
        assert torch.isfinite(loss)
        assert log_ratio.grad == 0.0
        assert torch.isfinite(kl)


class TestBatch:
    def test_normalized_advantages(self):
        assert normalize(np.array([1.0, 3.0])) == pytest.approx([-1.0, 1.0])
        assert normalize(np.full(50, 1e6 + 0.1)).tolist() == [0.0] * 50

    def test_observations_are_copied(self):
        """An environment may hand out the same buffer again and again."""
        buffer, count = np.zeros(3, np.float32), iter(range(1000))

        def obs(rng):
            buffer[:] = next(count)
            return buffer

        ppo = make_ppo(scripted(obs=obs), steps_per_epoch=5)
        ppo.collect()
        assert [o[0] for o in ppo.episodes[0].obs] == [0, 1, 2, 3, 4, 5]

    @pytest.mark.parametrize(
        ("truncation", "terminated", "diverges", "goes_on"),
        [
            ("terminal", False, False, 0.0),
            ("terminal", True, True, 1.0),  # what diverged is not taken for an end
            ("bootstrap", True, False, 0.0),
            ("bootstrap", False, False, 1.0),
        ],
    )
    def test_a_value_follows_what_is_no_end(self, truncation, terminated, diverges, goes_on):
        info = {"diverged": True} if diverges else {}
        choices = dict(length=3, terminated=terminated, reward=lambda rng: 1.0)
        workers = scripted(**choices, info=lambda step: info if step == 3 else {})
        ppo = make_ppo(workers, truncation=truncation)
        ppo.collect()
        returns, advantages = [], []
        learned = values_of(ppo, [o for e in ppo.episodes for o in e.obs[:-1]])
        for episode in ppo.episodes:
            *values, last = values_of(ppo, episode.obs)
            last = goes_on * last.clip(learned.min(), learned.max())
            advantages += [*gae(np.ones(len(values)), np.array(values), last, 0.99, 0.97)]
            returns += [*(advantages[-len(values) :] + np.array(values))]
        batch = ppo._batch()
        np.testing.assert_allclose(batch.returns.numpy(), returns, rtol=1e-4)
        expected = normalize(np.array(advantages))
        np.testing.assert_allclose(batch.advantages.numpy(), expected, atol=1e-4)

    def test_normalized_rewards_mean_the_same_in_any_unit(self):
        learners = []
        for unit in (1.0, 1024.0):  # a power of two, so that floats are exact
            workers = scripted(length=7, reward=lambda rng, unit=unit: unit * rng.standard_normal())
            learners.append(trained(make_ppo(workers, normalize_rewards=True), 3))
        one, other = learners
        assert other.reward_scale.scale == 1024.0 * one.reward_scale.scale
        assert parameters(one.critic).tolist() == parameters(other.critic).tolist()
        assert parameters(one.actor).tolist() == parameters(other.actor).tolist()

    def test_values_stay_when_the_scale_of_rewards_grows(self):
        ppo = trained(make_ppo(scripted(length=7), normalize_rewards=True), 1)
        obs, scale = torch.ones(4, 3), ppo.reward_scale.scale
        values = scale * ppo.critic(obs)
        ppo.episodes[0].rewards[-1] = -10.0 * scale
        ppo.prepare()
        assert ppo.reward_scale.scale >= 9.0 * scale
        torch.testing.assert_close(ppo.reward_scale.scale * ppo.critic(obs), values)

    def test_whole_episodes_until_enough_steps(self):
        ppo = make_ppo(scripted(length=7), steps_per_epoch=15)
        seen = ppo.collect()
        assert (seen["episodes"], seen["mean_length"], ppo.env_steps) == (3, 7, 21)

    def test_tests_come_every_so_many_epochs_and_teach_nothing(self):
        success = {"is_success": True}
        tested, untested = (
            make_ppo(scripted(info=lambda step: success), test_interval=interval)
            for interval in (2, None)
        )
        rates = []
        for _ in range(4):
            for ppo in (tested, untested):
                trained(ppo, 1)
            assert untested.test() == {}
            rates.append(tested.test())
        assert torch.equal(parameters(tested.actor), parameters(untested.actor))
        assert math.isnan(rates[0]["test_success_rate"])
        assert rates[0]["test_diverged"] == 0
        assert [row["test_success_rate"] == 1.0 for row in rates] == [False, True] * 2
        assert rates[1].keys() == rates[0].keys()

    def test_an_orthogonal_start_is_orthogonal(self):
        ppo = make_ppo(scripted(), hidden=(40, 40), orthogonal_init=True)
        for network, gains in ((ppo.actor, [2, 2, 1e-4]), (ppo.critic, [2, 2, 1])):
            for linear, gain in zip(network.linears, gains, strict=True):
                weight = linear.weight.detach()
                product = weight @ weight.T if weight.shape[0] <= weight.shape[1] else weight.T @ weight
                torch.testing.assert_close(product, gain * torch.eye(len(product)), atol=1e-5, rtol=0)
                assert not linear.bias.any()

    def test_minibatches(self):
        assert PPOConfig().minibatches(1003) == 6
        assert PPOConfig(minibatch_size=6).minibatches(1003) == 167
        assert PPOConfig().minibatches(2) == 2


class TestLearning:
    @pytest.mark.parametrize("std_lr", [None, 1e-2])
    @pytest.mark.parametrize("exploration", ["fixed", "learned"])
    def test_update_is_adam_on_the_clipped_gradient(self, exploration, std_lr):
        """One minibatch, two passes (Adam's first step has the same size for any gradient), against a
        plain PyTorch implementation."""
        choices = dict(n_passes=2, n_minibatches=1, max_grad_norm=0.05)
        ppo = make_ppo(scripted(), exploration=exploration, std_lr=std_lr, **choices)
        ppo.collect()
        obs, actions, old, advantages, returns, _ = ppo._batch()
        actor, critic = copy.deepcopy((ppo.actor, ppo.critic))
        log_std = torch.zeros(2, requires_grad=exploration == "learned")
        of_std = {"params": [log_std], "lr": std_lr or 3e-4}
        adams = [
            torch.optim.Adam([{"params": actor.parameters()}, of_std], 3e-4),
            torch.optim.Adam(critic.parameters(), 1e-3),
        ]
        for _ in range(2):
            normal = torch.distributions.Normal(actor(obs), math.sqrt(0.05) * log_std.exp())
            ratio = (normal.log_prob(actions).sum(-1) - old).exp()
            loss = -torch.min(ratio * advantages, ratio.clamp(0.8, 1.2) * advantages).mean()
            value_loss = torch.nn.functional.mse_loss(critic(obs).squeeze(-1), returns)
            for adam in adams:
                adam.zero_grad()
            (loss + value_loss).backward()
            parts_of = [*actor.parameters(), log_std], critic.parameters()
            for adam, parts in zip(adams, parts_of, strict=True):
                assert torch.nn.utils.clip_grad_norm_(parts, 0.05) > 0.05
                adam.step()
        ppo.update()
        learned = [ppo.gaussian.log_std, *ppo.actor.parameters(), *ppo.critic.parameters()]
        expected = [log_std, *actor.parameters(), *critic.parameters()]
        for mine, theirs in zip(learned, expected, strict=True):
            torch.testing.assert_close(mine, theirs, atol=2e-6, rtol=1e-4)

    def test_what_acts_is_what_learns(self):
        """Old log-probabilities are those of the actions by the policy that took them."""
        ppo = trained(make_ppo(scripted(), **ROBUST), 2)
        ppo.collect()
        obs, actions, old, *_ = ppo._batch()
        std = torch.from_numpy(ppo.gaussian.std())
        density = torch.distributions.Normal(ppo.actor(obs), std).log_prob(actions)
        torch.testing.assert_close(density.sum(-1), old, atol=1e-4, rtol=1e-4)

    @pytest.mark.parametrize("normalize", [False, True])
    @pytest.mark.parametrize(
        ("scale", "low", "high"), [("none", 1.0, 1.0), ("block", 4.5, 5.0), ("each", 4.9, 5.0)]
    )
    def test_taxels_have_a_scale_of_their_own(self, normalize, scale, low, high):
        """Others are normalized or not, whatever taxels are."""

        def obs(rng):
            return np.append(rng.normal(7.0, 2.0, 2), rng.random() < 0.02).astype(np.float32)

        space = gym.spaces.Box(np.float32([-np.inf, -np.inf, 0]), np.float32([np.inf, np.inf, 1]))
        choices = dict(normalize_obs=normalize, taxel_scale=scale, min_std=1.0)  # which taxels ignore
        ppo = trained(make_ppo(scripted(obs=obs, space=space), **choices), 1)
        ppo.collect()
        shown = ppo._batch().obs
        assert (shown[:, :2].mean().abs() < 0.5) == normalize
        assert low <= shown[:, 2].max() <= high
        assert shown[:, 2].min() == 0.0 or scale == "each"

    def test_observations_are_divided_by_a_floor_at_least(self):
        ppo = trained(make_ppo(scripted(), normalize_obs=True, min_std=10.0), 1)
        ppo.collect()
        assert ppo._batch().obs.std().item() == pytest.approx(0.1, rel=0.2)

    @pytest.mark.parametrize("correlation", [0.0, 0.7, 1.0])
    def test_noise_lasts_as_long_as_asked_and_is_as_large(self, correlation):
        explore = GaussianNoise(np.random.default_rng(0), np.float32([0.5]), correlation)
        noise = np.stack([explore(np.ones((20_000, 1), np.float32)) for _ in range(4)]) - 1.0
        assert noise.std(axis=1).ravel() == pytest.approx(0.5, abs=0.01)
        for n_steps in (1, 2):
            found = np.corrcoef(noise[0, :, 0], noise[n_steps, :, 0])[0, 1]
            assert found == pytest.approx(correlation**n_steps, abs=0.02)

    def test_entropy_and_explained_variance_by_hand(self):
        normal = torch.distributions.Normal(0.0, 0.5)
        assert Gaussian(3, 0.25).entropy() == pytest.approx(3 * normal.entropy().item())
        returns = torch.tensor([0.0, 2.0, 4.0, 6.0])  # variance 5
        assert explained_variance(returns + 7.0, returns) == 1.0
        assert explained_variance(torch.tensor([1.0, 1.0, 5.0, 5.0]), returns) == pytest.approx(0.8)
        assert explained_variance(returns, torch.ones(4)) == 0.0

    def test_target_kl_ends_the_passes(self):
        ppo = make_ppo(scripted(), n_passes=50, target_kl=1e-6)
        ppo.collect()
        assert ppo.update()["updates"] < 50 * 6

    def test_annealed_step_sizes_are_those_of_an_epochs_beginning(self):
        """So that the last epoch learns, and what would come after it does not."""
        ppo = make_ppo(scripted(), anneal_lr=True)
        found = []
        for env_steps in (0, 600, 999, 1000):
            ppo.env_steps = env_steps
            ppo.collect()
            before = parameters(ppo.actor)
            ppo.update()
            rate, critics = (adam.param_groups[0]["lr"] for adam in (ppo.actor_adam, ppo.critic_adam))
            assert critics == pytest.approx(rate / 0.3)
            found.append((rate, bool((parameters(ppo.actor) != before).any())))
        rates, moved = zip(*found, strict=True)
        assert rates == pytest.approx([3e-4, 1.2e-4, 3e-7, 0.0])
        assert moved == (True, True, True, False)


class Switch(gym.Env):
    """Reward 1 where the first action lies above a threshold, in one step; else nothing."""

    threshold = 0.0

    def __init__(self):
        self.observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        success = bool(action[0] > self.threshold)
        return np.zeros(1, np.float32), float(success), True, False, {"is_success": success}


class TestUndo:
    def parts(self, ppo):
        return flat([x.state_dict() for x in (ppo.actor, ppo.gaussian, ppo.actor_adam, ppo.std_adam)])

    def test_epochs_of_nothing_but_failures_teach_the_critic_alone_and_are_undone(self):
        env = Switch()
        steady = dict(undo_silent=True, exploration="learned", target_kl=0.05)
        ppo = make_ppo(vector.start(lambda: env), **steady)
        env.threshold = 2.0  # nothing was ever rewarded: updates are as always
        before = self.parts(ppo)
        trained(ppo, 1)
        assert self.parts(ppo) != before
        env.threshold = 0.0
        trained(ppo, 1)
        ppo.collect()
        before = self.parts(ppo)
        assert ppo.update()["undone"] == 0
        assert self.parts(ppo) != before
        env.threshold = 2.0
        for undone in (1, 0):  # and not once more
            critic = parameters(ppo.critic)
            ppo.collect()
            cut_off = ppo.episodes[0]  # by the physics: it does not count
            cut_off.faults["diverged"], cut_off.rewards = 1, [0.5]
            learned = ppo.update()
            assert (learned["undone"], learned["policy_loss"], learned["kl"]) == (undone, 0.0, 0.0)
            assert self.parts(ppo) == before
            assert (parameters(ppo.critic) != critic).any()
        env.threshold = 0.0
        ppo.collect()
        assert ppo.update()["undone"] == 0
        assert self.parts(ppo) != before

    @pytest.mark.parametrize("rate", [0.03, 0.05])
    def test_updates_that_change_nothing_are_kept(self, rate):
        """Fifteen episodes an epoch, of which some succeed whatever was learned: two in a hundred."""
        updates = undone = 0
        for seed in range(20):
            silence, rng = Silence(), np.random.default_rng(seed)
            for _ in range(500):
                verdict = silence.judge((rng.random(15) < rate).astype(float).tolist())
                undone += verdict == "undo"
                updates += verdict == "learn" and silence.can_undo
        assert undone <= 0.02 * updates

    @pytest.mark.parametrize(("rate", "epochs", "longest"), [(0.3, 3, 3), (1 / 15, 1, 14), (0.1, 9, 9)])
    def test_an_update_that_silences_is_undone_once(self, rate, epochs, longest):
        for seed in range(20):
            silence, rng, n = Silence(), np.random.default_rng(seed), round(15 * rate)
            for _ in range(epochs):
                n = 1 if rate < 0.1 else max(1, rng.binomial(15, rate))
                assert silence.judge([1000.0] * n + [-100.0] * (15 - n)) == "learn"
            verdicts = [silence.judge([-100.0] * 15) for _ in range(100)]
            assert verdicts.index("undo") < longest
            assert verdicts.count("undo") == 1

    def test_a_lower_return_makes_another_failure(self):
        """Where a timeout costs 0, and a miss 100, an epoch with both is no silent one."""
        silence = Silence()
        for returns in ([0.0, 1000.0], [0.0, -100.0]):
            assert silence.judge(returns) == "learn"
            assert silence.failure == min(returns)
        assert silence.judge([-100.0, -100.0]) == "wait"

    def test_resumes_bit_for_bit_in_silence(self):
        def run(epochs, state=None):
            env = Switch()
            ppo = trained(make_ppo(vector.start(lambda: env), undo_silent=True), 0 if state else 2)
            env.threshold = 2.0
            return trained(ppo, epochs, state)

        half = run(2)
        assert half.before_update
        assert flat(run(4).state_dict()) == flat(run(2, half.state_dict()).state_dict())


HARD = {
    "+1e6": dict(reward=lambda rng: 1e6),
    "-1e6": dict(reward=lambda rng: -1e6),
    "±1e6": dict(reward=lambda rng: float(rng.choice([-1e6, 1e6]))),
    "1e-6": dict(reward=lambda rng: 1e-6 * float(rng.standard_normal())),
    "constant obs": dict(obs=lambda rng: np.ones(3, np.float32)),
    "offset obs": dict(obs=lambda rng: (1e8 + rng.standard_normal(3)).astype(np.float32)),
    "one step": dict(length=1),
    "truncated at once": dict(length=1, terminated=False),
}


class TestHardCases:
    @pytest.mark.parametrize("choices", HARD.values(), ids=HARD)
    def test_stays_finite(self, choices):
        ppo = make_ppo(scripted(**choices))
        for _ in range(3):
            ppo.collect()
            learned = ppo.update()
        assert all(math.isfinite(value) for value in learned.values())
        assert torch.isfinite(parameters(ppo.actor, ppo.critic)).all()

    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_actions_stay_within_any_bounds(self, dtype):
        """However the way from -1 and 1 to the bounds is rounded."""
        low, high = np.sort(np.random.default_rng(0).normal(size=(2, 1000)), axis=0).astype(dtype)
        action = gym.spaces.Box(low, high, dtype=dtype)
        policy = Policy(None, None, None, Spaces(gym.spaces.Box(-1, 1, (1,)), action))
        for end in (-1.0, 1.0):
            assert action.contains(policy.to_env(np.full(1000, end, np.float32)).astype(dtype))

    @pytest.mark.parametrize("bad", [math.nan, math.inf, 1e308, -1e39])
    def test_reward_that_is_not_finite_stops_the_run(self, bad):
        with pytest.raises(DivergenceError, match="reward"):
            make_ppo(scripted(reward=lambda rng: bad)).collect()

    def test_observation_that_is_not_finite_stops_the_run(self):
        with pytest.raises(DivergenceError, match=r"observation .* \(entry 2\)"):
            make_ppo(scripted(obs=lambda rng: np.array([0, 0, np.nan], np.float32))).collect()

    def test_a_diverged_step_is_counted_and_not_learned_from(self):
        info = {"diverged": True, "is_success": False}
        workers = scripted(length=9, info=lambda step: info if step == 4 else {"is_success": True})
        ppo = make_ppo(workers, steps_per_epoch=30)
        seen = ppo.collect()
        assert seen["diverged"] == seen["episodes"] > 0
        assert seen["mean_length"] == 3
        assert seen["success_rate"] == 0.0  # and counts as a failure

    def test_the_success_rate_is_that_of_episodes_that_say_it(self):
        """One of three says it, and succeeded."""
        count = iter(range(1000))
        ppo = make_ppo(
            scripted(info=lambda step: {"is_success": True} if next(count) % 15 == 4 else {}),
            steps_per_epoch=30,
        )
        assert ppo.collect()["success_rate"] == 1.0
        assert math.isnan(make_ppo(scripted()).collect()["success_rate"])
