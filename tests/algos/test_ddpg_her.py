"""DDPG+HER: targets, target networks, gradients and order of operations against derivations."""

import copy
import dataclasses
import math

import gymnasium as gym
import numpy as np
import pytest
import torch
from tactilerl.algos import DivergenceError, recipes
from tactilerl.algos.ddpg_her import (
    DDPGHER,
    DDPGHERConfig,
    Exploration,
    td_targets,
)
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.ppo import PPO, PPOConfig
from tactilerl.algos.rollout import largest_return
from tactilerl.envs import vector
from tactilerl.runs import training
from tactilerl.runs.policies import load_policy, save_policy

from states import vector as parameters


class GoalEnv(gym.Env):
    """A goal environment that goes nowhere: random observations, sparse rewards."""

    max_episode_steps, failing = 5, 0.0

    def __init__(
        self, scale=1.0, offset=0.0, reward=None, length=5, terminated=False, reward_scale=1.0
    ):
        def box(n):
            return gym.spaces.Box(-np.inf, np.inf, (n,), np.float32)

        low, high = np.array([[-np.inf] * 3 + [0.0], [np.inf] * 3 + [1.0]], np.float32)
        self.observation_space = gym.spaces.Dict(
            observation=gym.spaces.Box(low, high), achieved_goal=box(2), desired_goal=box(2)
        )
        self.action_space = gym.spaces.Box(-2.0, 2.0, (3,), np.float32)
        self.scale, self.offset, self.bad_reward = scale, offset, reward
        self.length, self.terminated, self.reward_scale = length, terminated, reward_scale
        self.steps, self.seeds = 0, []

    def _obs(self):
        observation = self.offset + self.scale * self.np_random.standard_normal(4)
        observation[-1] = self.np_random.random() < 0.5
        achieved, desired = self.np_random.standard_normal((2, 2))
        return dict(observation=observation, achieved_goal=achieved, desired_goal=desired)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        self.seeds.append(seed)
        if self.np_random.random() < self.failing:
            raise FloatingPointError("it exploded")
        return self._obs(), {}

    def step(self, action):
        self.steps += 1
        obs, ended = self._obs(), self.steps >= self.length
        achieved, desired = (obs[k].astype(np.float32) for k in ("achieved_goal", "desired_goal"))
        reward = float(self.compute_reward(achieved, desired, {}))
        reward = reward if self.bad_reward is None else self.bad_reward
        flags = (ended and self.terminated, ended and not self.terminated)
        return obs, reward, *flags, {"is_success": reward == 0}

    def compute_reward(self, achieved, desired, info):
        return self.reward_scale * ((np.linalg.norm(achieved - desired, axis=-1) < 1.0) - 1.0)


SMALL = dict(hidden=(16, 16), buffer_size=200, batch_size=8, n_cycles=2, n_batches=3)


def make(env=None, seed=0, comm=None, **choices):
    config = DDPGHERConfig(**{**SMALL, **choices})
    workers = vector.start(lambda: env or GoalEnv())
    return DDPGHER(config, workers, comm or Communicator(), seed, total_timesteps=100)


def make_ppo(env):
    config = PPOConfig(hidden=(16,), steps_per_epoch=40, n_passes=2)
    return PPO(config, vector.start(lambda: env), Communicator(), 0, total_timesteps=100)


def trained(cycles=3, learner=None, **choices):
    learner = learner or make(**choices)
    for _ in range(cycles):
        learner.collect()
        learner.update()
    return learner


def everything(learner):
    return parameters(learner.actor, learner.critic)


def targets(learner):
    return parameters(learner.target_actor, learner.target_critic)


def rates_of(learner):
    adams = learner.actor_adam, learner.critic_adam
    return [group["lr"] for adam in adams for group in adam.param_groups]


class TestTargets:
    @pytest.mark.parametrize(
        ("values", "terminal", "gamma", "bounds", "targets"),
        [
            ([-2.0, -3.0, 5.0], [0.0, 0.0, 1.0], 0.5, None, [-1.0, -2.5, -1.0]),
            # Clipped: with gamma .9, returns of rewards from -1 to 0 lie between -10 and 0.
            ([3.0, -99.0, -5.0], [0.0, 0.0, 0.0], 0.9, (-1.0, 0.0), [0.0, -10.0, -5.5]),
        ],
    )
    def test_by_hand(self, values, terminal, gamma, bounds, targets):
        rewards, values, terminal = map(torch.tensor, ([0.0, -1.0, -1.0], values, terminal))
        got = td_targets(rewards, values, terminal, gamma, bounds)
        torch.testing.assert_close(got, torch.tensor(targets))

    def test_bounds_follow_the_rewards_seen(self):
        """gamma .8: 5 times the lowest and the highest, at least from -1 to 0."""
        for scale, rewards in ((0.5, [0.0, -0.5]), (-7.0, [0.0, 7.0]), (3.0, [0.0, -3.0])):
            learner = trained(2, make(GoalEnv(reward_scale=scale)))
            low, high = min(-1.0, *rewards), max(0.0, *rewards)
            assert (learner.reward_scale.lowest, learner.reward_scale.highest) == (low, high)
            with torch.no_grad():
                learner.target_critic[-1].bias += 1e4
            batch = learner.replay.sample(8, 0.8)
            target = learner._targets(learner._as_inputs(batch))
            torch.testing.assert_close(target, torch.full((8,), 5 * high))

    def test_terminal_transitions_bootstrap_unless_told_otherwise(self):
        for termination, is_cut in (("bootstrap", False), ("terminal", True)):
            env = GoalEnv(length=1, terminated=True)
            learner = make(env, termination=termination, clip_target=False, gamma=0.5)
            learner.collect()
            batch = learner.replay.sample(8, 0.8)
            target = learner._targets(learner._as_inputs(batch))
            assert torch.equal(target, torch.from_numpy(batch.reward)) == is_cut


class Ended(GoalEnv):
    """Its reward comes with the end, and grows from one episode to the next."""

    def __init__(self, unit=1.0):
        super().__init__(terminated=True)
        self.unit, self.worth = unit, 0.0

    def step(self, action):
        obs, _, terminated, truncated, info = super().step(action)
        self.worth += 3.0 * terminated
        obs["achieved_goal"] = obs["desired_goal"] + np.float32([self.worth * terminated, 0.0])
        reward = float(self.compute_reward(obs["achieved_goal"], obs["desired_goal"], info))
        return obs, reward, terminated, truncated, info

    def compute_reward(self, achieved, desired, info):
        far = np.abs(achieved - desired).max(axis=-1)
        return self.unit * np.where(far > 6.0, far, 0.0)


class TestUnitOfRewards:
    """With their own scale, nothing that is learned depends on the unit of the rewards."""

    def test_largest_return_by_hand(self):
        assert largest_return([1.0, 0.0, -4.0], 0.5) == 4.0
        assert largest_return([-8.0, 4.0, 4.0], 0.5) == 6.0
        assert largest_return([0.0], 0.5) == 0.0

    @pytest.mark.parametrize(("unit", "tolerance"), [(2.0**-10, 0), (20, 1e-6)])
    def test_does_not_matter(self, unit, tolerance):
        """Powers of two change no digit; others round."""
        config = dataclasses.asdict(recipes.recipe("ddpg_her", "scaled")) | SMALL
        one, other = (trained(5, make(Ended(unit), **config)) for unit in (1.0, unit))
        assert other.reward_scale.scale == pytest.approx(unit * one.reward_scale.scale)
        both = (everything(learner) for learner in (one, other))
        torch.testing.assert_close(*both, atol=tolerance, rtol=0)


class TestFallsOverTheRun:
    """100 steps are half over after five cycles of two episodes of 5 steps."""

    @pytest.mark.parametrize("anneals", [False, True])
    def test_noise_and_that_of_a_saved_policy(self, anneals, tmp_path):
        learner = make(anneal_noise=anneals, noise_eps=0.2, random_eps=0.3)
        assert learner.config.anneals == anneals
        for cycles, share in ((0, 1.0), (5, 0.5), (5, 0.0), (1, 0.0)):
            noise = trained(cycles, learner).policy().explore.keywords
            share = share if anneals else 1.0
            expected = dict(noise_eps=share * 0.2, random_eps=share * 0.3, random_hold=1.0)
            assert noise == pytest.approx(expected)
            save_policy(tmp_path / "policy.pt", "ddpg_her", learner)
            assert load_policy(tmp_path / "policy.pt").explore.keywords == noise

    @pytest.mark.parametrize("anneals", [False, True])
    def test_action_penalty(self, anneals):
        """As much is left of it as of the learning rates."""
        rates = dict(actor_lr=1e-3, critic_lr=2e-3)
        learner = make(anneal_action_l2=anneals, anneal_lr=anneals, action_l2=0.3, **rates)
        assert learner.config.anneals == anneals
        for cycles, share in ((1, 1.0), (4, 0.6), (5, 0.1), (1, 0.0)):
            inputs = torch.ones(8, trained(cycles, learner).actor.linears[0].in_features)
            share = share if anneals else 1.0
            assert rates_of(learner) == pytest.approx([share * 1e-3, share * 2e-3])
            loss, value = learner._actor_gradient(inputs)
            with torch.no_grad():
                penalty = learner.actor(inputs).square().mean()
            torch.testing.assert_close(loss + value, share * 0.3 * penalty)

    def test_ends_where_the_run_ends(self):
        """Short episodes make short cycles: the last epoch has as many as the run has steps for."""
        env = GoalEnv(length=2, terminated=True)
        learner = make(env, anneal_lr=True, n_cycles=50, n_test_rollouts=0)
        rows = [*training.epochs(learner, 0)]
        assert learner.env_steps == rows[-1]["env_steps"] == learner.total_timesteps == 100
        assert rates_of(learner) == pytest.approx([0.04 * 1e-3] * 2)
        assert rows[-1]["updates"] == 25 * learner.config.n_batches


def test_a_policy_acts_without_the_achieved_goal():
    obs = GoalEnv().reset(seed=0)[0]
    policy, seen = make().policy(), {k: v for k, v in obs.items() if k != "achieved_goal"}
    assert np.array_equal(policy.act(seen), policy.act(obs))
    filtered = gym.wrappers.FilterObservation(GoalEnv(), [*seen])
    with pytest.raises(ValueError, match="Dict with observation, achieved_goal and desired_goal"):
        make(filtered)


class TestExploration:
    def test_random_actions_are_held_for_a_geometric_number_of_steps(self):
        """Of mean 8: another random action may follow at once, and is another hold."""
        explore = Exploration(np.random.default_rng(1), 0.0, 0.3, 8.0)
        steps = np.stack([explore(np.zeros((2000, 1), np.float32))[:, 0] for _ in range(200)])
        assert (steps != 0).mean() == pytest.approx(0.3, abs=0.01)
        assert (steps[:3] != 0).mean(axis=1) == pytest.approx([0.3] * 3, abs=0.04)
        lengths = []
        for column in steps.T:
            starts = 1 + np.flatnonzero(np.diff(column))  # so none is cut by the first or last step
            lengths += [*np.diff(starts)[column[starts[:-1]] != 0]]
        assert np.mean(lengths) == pytest.approx(8, rel=0.06)
        for n in (1, 2, 3):  # P(length > n) = (1 - 1 / 8)^n
            assert np.mean(np.array(lengths) > n) == pytest.approx((7 / 8) ** n, abs=0.03)

    def test_a_hold_of_one_step_is_the_exploration_of_the_source(self):
        rng, again = np.random.default_rng(3), np.random.default_rng(3)
        explore, actions = Exploration(rng, 0.2, 0.3), np.full((1, 3), 0.1, np.float32)
        for _ in range(50):
            noisy = actions + np.float32(0.2) * again.standard_normal((1, 3), dtype=np.float32)
            is_random = again.random(1)[..., None] < 0.3
            drawn = again.uniform(-1.0, 1.0, (1, 3)).astype(np.float32)
            expected = np.where(is_random, drawn, np.clip(noisy, -1.0, 1.0))
            np.testing.assert_array_equal(explore(actions), expected)


class TestUpdate:
    @pytest.mark.parametrize(("interval", "after"), [(2, (1, 3, 4)), (None, (4,))])
    def test_target_networks_follow_at_intervals_and_at_the_end_of_a_cycle(self, interval, after):
        learner = make(n_batches=5, target_update_interval=interval, polyak=0.75)
        learner.collect()
        expected, moves, step = targets(learner), [], learner._update_networks

        def update(batch):
            losses = step(batch)
            moves.append(everything(learner))
            return losses

        learner._update_networks = update
        learner.update()
        for batch in after:
            expected.lerp_(moves[batch], 0.25)
        torch.testing.assert_close(targets(learner), expected)

    def test_gradients_are_those_of_the_two_losses_apart(self):
        learner = make(action_l2=0.3)
        learner.collect()
        batch = learner._as_inputs(learner.replay.sample(8, 0.8))
        target = learner._targets(batch)
        actor, critic = copy.deepcopy((learner.actor, learner.critic))
        q = critic(torch.cat([batch.obs, batch.action], dim=1)).squeeze(-1)
        critic_loss = ((q - target) ** 2).mean()
        actions = actor(batch.obs)
        value = critic(torch.cat([batch.obs, actions], dim=1)).mean()
        actor_loss = -value + 0.3 * (actions**2).mean()
        of_critic = torch.autograd.grad(critic_loss, list(critic.parameters()))
        of_actor = torch.autograd.grad(actor_loss, list(actor.parameters()))
        got = learner._update_networks(batch)
        torch.testing.assert_close([p.grad for p in learner.actor_parameters], [*of_actor])
        torch.testing.assert_close([p.grad for p in learner.critic_parameters], [*of_critic])
        torch.testing.assert_close(got, torch.stack([critic_loss, actor_loss, value]).detach())

    def test_the_floor_is_of_observations_not_of_goals_nor_taxels(self):
        learner = trained(1, make(GoalEnv(), min_std=7.0))
        assert (learner.obs_stats.std[:-1] == 7.0).all()
        assert learner.obs_stats.std[-1] < 1.0
        assert (learner.goal_stats.std < 7.0).all()

    def test_what_is_observed_is_cut_before_it_is_normalized(self):
        learner = trained(1, make(GoalEnv(scale=1e3), clip_obs=50.0))
        batch = learner.replay.sample(64, 0.8)
        assert np.abs(batch.obs).max() > 500
        assert np.abs(learner.obs_stats.mean).max() < 50
        assert learner.obs_stats.std.max() <= 50
        huge = batch._replace(obs=batch.obs * 1e6, goal=batch.goal * 1e9)
        small = batch._replace(obs=np.sign(batch.obs) * 50, goal=np.sign(batch.goal) * 50)
        seen = [learner._as_inputs(one).obs[:, [0, 1, 2, 4, 5]] for one in (huge, small)]
        torch.testing.assert_close(*seen)

    def test_taxels_have_a_scale_of_their_own(self):
        for scale, low, high in (("none", 1.0, 1.0), ("block", 4.0, 5.0), ("each", 0.9, 2.0)):
            learner = trained(2, make(taxel_scale=scale))
            seen = learner._as_inputs(learner.replay.sample(64, 0.8)).obs[:, 3]
            assert low <= seen.max() <= high
            assert (seen.min() == 0.0) == (scale != "each")

    def test_normalizer_is_fed_relabelled_goals_of_new_episodes(self):
        learner, asked = make(), []
        sample = learner.replay.sample
        learner.replay.sample = lambda *args: asked.append(args) or sample(*args)
        learner.collect()
        assert learner.obs_stats.count == learner.goal_stats.count == 10
        learner.collect()
        assert learner.goal_stats.count == 20
        (n, replay_p, first), (_, _, second) = asked
        assert (n, replay_p) == (10, 0.8)
        assert len(first) == len(second) == 2
        assert not {*first} & {*second}

    def test_targets_are_those_of_the_target_networks_in_what_follows(self):
        learner = trained(3, make(clip_target=False, gamma=0.9))
        drawn = learner.replay.sample(16, 0.8)
        following = learner.scaling()(
            torch.from_numpy(np.concatenate([drawn.next_obs, drawn.goal], axis=1))
        )
        with torch.no_grad():
            actions = learner.target_actor(following)
            values = learner.target_critic(torch.cat([following, actions], dim=1)).squeeze(-1)
        target = learner._targets(learner._as_inputs(drawn))
        torch.testing.assert_close(target, torch.from_numpy(drawn.reward) + 0.9 * values)

    def test_sum_and_mean_of_gradients(self):
        got = {}
        for how in ("sum", "mean"):
            learner = make(reduction=how)
            learner.collect()
            batch = learner._as_inputs(learner.replay.sample(8, 0.8))
            learner.comm.size = 2  # a partner whose gradient is zero
            learner._update_networks(batch)
            got[how] = [p.grad for p in learner.critic_parameters]
        torch.testing.assert_close(got["sum"], [2 * gradient for gradient in got["mean"]])

    def test_one_goal_is_never_relabelled(self):
        env = GoalEnv()
        assert make(env).config.replay_p == 0.8
        goal = np.ones(2, np.float32)
        env.observation_space["desired_goal"] = gym.spaces.Box(goal, goal)
        assert make(env).config.replay_p == 0.0
        assert make(env, replay_p=0.5).config.replay_p == 0.5

    def test_test_episodes_learn_nothing(self):
        learner = trained()
        before = everything(learner), learner.env_steps, len(learner.replay)
        assert 0 <= learner.test()["test_success_rate"] <= 1
        assert torch.equal(before[0], everything(learner))
        assert before[1:] == (learner.env_steps, len(learner.replay))

    def test_ranks_have_their_own_seeds(self):
        comm = Communicator()
        comm.rank = 1
        first, second = make(), make(comm=comm)
        assert torch.equal(everything(first), everything(second))
        for learner in (first, second):
            learner.collect()
        seeds = [set(learner.workers.env.seeds) for learner in (first, second)]
        assert not seeds[0] & seeds[1]


class TestHardCases:
    @pytest.mark.parametrize(
        ("env", "choices"),
        [
            (dict(scale=0.0), {}),
            (dict(length=1), dict(batch_size=1)),
            (dict(offset=1e8), dict(clip_obs=1e9)),
            (dict(scale=1e30), dict(clip_obs=1e30)),
            (dict(reward_scale=1e6), {}),
            (dict(reward_scale=1e6), dict(clip_target=False, gamma=1 - 1e-7)),
        ],
    )
    def test_stays_finite(self, env, choices):
        learner = make(GoalEnv(**env), **choices)
        for _ in range(4):
            learner.collect()
            assert all(math.isfinite(value) for value in learner.update().values())
        assert torch.isfinite(everything(learner)).all()

    def test_broken_parameters_stop_the_run(self):
        learner = trained(1)
        with torch.no_grad():
            learner.critic[0].bias[0] = math.nan
        with pytest.raises(DivergenceError, match="not finite"):
            learner.update()

    @pytest.mark.parametrize("learn", [make, make_ppo])
    def test_episodes_that_cannot_begin_are_counted(self, learn):
        env, failed = GoalEnv(), 0
        env.failing = 0.5
        learner = learn(env)
        if learn is make:
            learner.check()
        for _ in range(5):
            seen = learner.collect()
            assert seen["episodes"] - seen["diverged"] >= 2
            failed += seen["diverged"]
            learner.update()
        assert failed > 0

    @pytest.mark.parametrize("learn", [make, make_ppo])
    def test_where_no_episode_begins_the_run_stops(self, learn):
        env = GoalEnv()
        env.failing = 1.0
        with pytest.raises(DivergenceError, match=r"100 episodes in a row .*: it exploded"):
            learn(env).collect()

    def test_rewards_that_cannot_be_recomputed_are_refused(self):
        with pytest.raises(ValueError, match="compute_reward"):
            make(GoalEnv(reward=-0.37)).check()

    def test_an_environment_without_a_time_limit_is_refused(self):
        env = GoalEnv()
        env.max_episode_steps = None
        with pytest.raises(ValueError, match="max_episode_steps"):
            make(env)
