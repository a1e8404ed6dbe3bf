"""A batch of runs learns as each run does by itself."""

import re
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector.utils import batch_space
from tactilerl import algos
from tactilerl.algos import batch
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.recipes import recipe
from tactilerl.envs import vector
from tactilerl.envs.toy import PointReachEnv

SMALL = {"hidden": (16, 16)}


class Point(PointReachEnv):
    """Ends when the goal is reached; sees `n_seen` more numbers, of which the last may be a taxel."""

    tolerance, max_episode_steps = 0.5, 12

    def __init__(self, n_seen=0):
        super().__init__()
        self.n_seen = n_seen
        low, high = np.full(2 + n_seen, -np.inf, np.float32), np.full(2 + n_seen, np.inf, np.float32)
        low[2:], high[2:] = 0.0, 1.0
        spaces = {**self.observation_space.spaces, "observation": gym.spaces.Box(low, high)}
        self.observation_space = gym.spaces.Dict(spaces)

    def step(self, action):
        obs, reward, _, is_over, info = super().step(action)
        is_there = info["is_success"]
        return obs, reward, is_there, is_over and not is_there, info

    def _obs(self):
        obs = super()._obs()
        seen = (np.arange(self.n_seen) < 3 * obs["observation"][0]).astype(np.float32)
        return {**obs, "observation": np.append(obs["observation"], seen)}


class PointBatch(gym.vector.VectorEnv):
    """Points side by side, `worlds` a run; steps of some are not over at once."""

    device, max_episode_steps = torch.device("cpu"), Point.max_episode_steps

    def __init__(self, seen, worlds):
        self.points = [Point(n) for n in seen for _ in range(worlds)]
        self.num_envs = len(self.points)
        self.single_observation_space = Point(max(seen)).observation_space
        self.single_action_space = self.points[0].action_space
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._seen, self._later = [None] * self.num_envs, {}
        self._over, self._waits = np.ones(self.num_envs, bool), np.zeros(self.num_envs, int)

    def reset(self, *, seed=None, options=None):
        for i in np.flatnonzero(options["reset_mask"]):
            self._seen[i], _ = self.points[i].reset(seed=seed[i])
            self._over[i], self._waits[i] = False, 0
        return self._obs(), self._info()

    def _info(self, **flags):
        return dict.fromkeys(("is_success", "diverged", "holding"), self._over & False) | flags

    def step(self, actions):
        rewards, nowhere = np.zeros(self.num_envs, np.float32), self._over & False
        ends, cuts, success, holding = (nowhere.copy() for _ in range(4))
        for i, (point, action) in enumerate(zip(self.points, actions.numpy(), strict=True)):
            if self._over[i]:
                continue
            if self._waits[i] == 0:
                self._later[i] = point.step(action)
                self._waits[i] = 3 if self._later[i][2] else 1
            self._waits[i] -= 1
            if self._waits[i]:
                self._seen[i], holding[i] = self._later[i][0], True
                continue
            self._seen[i], rewards[i], ends[i], cuts[i], info = self._later[i]
            success[i], self._over[i] = info["is_success"], ends[i] or cuts[i]
        info = self._info(is_success=success, holding=holding)
        return self._obs(), *map(torch.from_numpy, (rewards, ends, cuts)), info

    def _obs(self):
        width = self.single_observation_space["observation"].shape[0]
        zero = self.points[0].reset(seed=0)[0] if None in self._seen else None
        seen = [obs or zero for obs in self._seen]
        rows = {key: [obs[key] for obs in seen] for key in seen[0]}
        rows["observation"] = [np.pad(row, (0, width - len(row))) for row in rows["observation"]]
        return {key: torch.from_numpy(np.stack(values)) for key, values in rows.items()}


def single(algo, config, seed, n_seen, total=400):
    _, kind = algos.get(algo)
    workers = vector.start(lambda: Point(n_seen))
    return kind(config, workers, Communicator(), seed, total)


PPO_CONFIG = replace(
    recipe("ppo", "robust"),
    **SMALL,
    steps_per_epoch=60,
    minibatch_size=16,
    n_passes=3,
    critic_lr=1e-2,
    target_kl=0.02,
    noise_correlation=0.5,
    test_interval=5,
)
PAPERS_PPO = replace(recipe("ppo"), **SMALL, steps_per_epoch=50, n_passes=4)
HER_CONFIG = replace(
    recipe("ddpg_her", "robust"), **SMALL, n_batches=6, batch_size=32, target_update_interval=4,
    n_cycles=2, n_test_rollouts=2, random_hold=3.0,
)  # fmt: skip


def rows_of(one):
    return {**one.collect(), **one.update()}


@pytest.mark.parametrize(
    ("algo", "config", "rates", "tolerance"),
    [
        ("ppo", PPO_CONFIG, (3e-3, 1e-3, 3e-2), 2e-3),
        (
            "ppo",
            PAPERS_PPO,
            (3e-4, 1e-3, 3e-3),
            2e-3,
        ),
        ("ddpg_her", HER_CONFIG, (1e-3, 3e-3, 3e-4), 2e-3),
        (
            "ddpg_her",
            replace(recipe("ddpg_her"), **SMALL, n_batches=5, n_test_rollouts=1),
            (1e-3, 3e-3, 3e-4),
            2e-3,
        ),
    ],
)
@pytest.mark.parametrize("worlds", [2, pytest.param(9, marks=pytest.mark.slow)])
def test_run_i_of_a_batch_is_the_single_run(algo, config, rates, tolerance, worlds):
    """Three runs of other seeds, rates and numbers of inputs, five epochs, whoever plays how many."""
    seen, configs = (0, 2, 1), [replace(config, actor_lr=rate) for rate in rates]
    make = [(algo, one, seed, n) for one, seed, n in zip(configs, (5, 6, 7), seen, strict=True)]
    alone, learners = ([single(*args) for args in make] for _ in range(2))
    envs = PointBatch(seen, worlds), PointBatch(seen, 3)
    many = batch.BATCHED[type(learners[0])](learners, *envs)
    if algo == "ddpg_her":
        many.memory = many.memory[:, :1]  # grows
    for _ in range(5):
        expected = [rows_of(one) for one in alone]
        collected, updated = many.collect(), many.update()
        for i, want in enumerate(expected):
            got = {**collected[i], **updated[i]}
            assert want.keys() == got.keys()
            assert got == pytest.approx(want, rel=tolerance, abs=tolerance, nan_ok=True)
    assert not many.failures
    tests = many.test(range(3))
    for i, one in enumerate(alone):
        assert tests.get(i, {}) == pytest.approx(one.test(), rel=1e-3)
    assert bool(tests) == (config != PAPERS_PPO)
    for i, one in enumerate(alone):
        _same(one.state_dict(), learners[i].state_dict(), tolerance)


def _same(want, got, tolerance, where=""):
    if isinstance(want, dict):
        assert want.keys() == got.keys(), where
        for key in want:
            _same(want[key], got[key], tolerance, f"{where} {key}")
    elif isinstance(want, list):
        for a, b in zip(want, got, strict=True):
            _same(a, b, tolerance, where)
    elif isinstance(want, torch.Tensor):
        torch.testing.assert_close(
            got, want, rtol=tolerance, atol=tolerance, msg=lambda m: f"{where}: {m}"
        )
    elif isinstance(want, float) and "lr" not in where:
        assert got == pytest.approx(want, rel=tolerance), where


class Breaks(PointBatch):
    """Points of which run 1's break: their first steps, observations or rewards."""

    def __init__(self, seen, worlds, what):
        super().__init__(seen, worlds)
        self.what, self.broken = what, np.arange(self.num_envs) // worlds == 1

    def step(self, actions):
        assert actions.isfinite().all()
        over = self._over.copy()
        obs, reward, *ends, info = super().step(actions)
        if self.what in ("observation", "reward"):
            value = obs["observation"] if self.what == "observation" else reward
            value[torch.from_numpy(self.broken)] = np.nan
        if self.what == "step":
            info["diverged"] = self.broken & ~over
            ends[1] |= torch.from_numpy(info["diverged"])
            self._over |= self.broken
        return obs, reward, *ends, info


@pytest.mark.parametrize(("algo", "config"), [("ppo", PPO_CONFIG), ("ddpg_her", HER_CONFIG)])
@pytest.mark.parametrize(
    "what",
    [
        *("observation", "parameter"),
        *(pytest.param(what, marks=pytest.mark.slow) for what in ("step", "reward")),
    ],
)
def test_a_run_that_fails_leaves_the_others_as_they_are(algo, config, what):
    rows = []
    for broken in ("", what):
        learners = [single(algo, config, seed, 0) for seed in (5, 6, 7)]
        if broken == "parameter":
            learners[1].actor[0].bias.data[:] = np.nan
        many = batch.BATCHED[type(learners[0])](learners, Breaks((0, 0, 0), 2, broken))
        rows.append([(many.collect(), many.update(), many.test(range(3))) for _ in range(3)])
        assert [i for i in range(3) if i in many.failures] == [1] * bool(broken)
    reason = "could not begin" if what == "step" else f"{what}.*not finite"
    assert re.search(reason, many.failures[1])
    for want, got in zip(*rows, strict=True):
        for each, mine in zip(want, got, strict=True):
            assert 1 not in mine or (what == "parameter" and got[0] is mine)
            for i in {*each} - {1}:
                assert mine[i] == pytest.approx(each[i], rel=1e-3, abs=1e-6, nan_ok=True)
    assert many.play_best({}, 2) == {}


def test_tests_are_as_many_as_asked_for(monkeypatch):
    monkeypatch.setattr(batch.rollout, "MAX_FAILURES", 2)
    learner = single("ppo", PPO_CONFIG, 5, 0)
    env, test_env = PointBatch((0,), 2), PointBatch((0,), 3)
    for many in (batch.BatchPPO([learner], test_env), batch.BatchPPO([learner], env, test_env)):
        env.reset = None  # tests have worlds of their own
        assert many.play_best({0: learner.key(2)}, 7)[0]["episodes"] == 7


@pytest.mark.parametrize(("algo", "config"), [("ppo", PPO_CONFIG), ("ddpg_her", HER_CONFIG)])
def test_what_is_saved_of_a_run_holds_no_other_run(algo, config):
    """Its networks are parts of the batch's tensors, its state is not."""
    learners = [single(algo, config, seed, n) for seed, n in ((5, 0), (6, 2))]
    many = batch.BATCHED[type(learners[0])](learners, PointBatch((0, 2), 2))
    many.collect(), many.update()
    for one in learners:
        state, weight = one.state_dict(), one.critic[0].weight
        assert weight.untyped_storage().nbytes() > 3 * weight.nbytes
        for part in ("actor", "critic"):
            moments = state[f"{part}_adam"]["state"].values()
            saved = [*state[part].values(), *(x for moment in moments for x in moment.values())]
            assert all(x.untyped_storage().nbytes() == x.nbytes for x in saved)
            assert all(x.is_contiguous() for x in saved)  # Adam takes numbers as they lie


def test_a_gradient_that_is_off_changes_nothing():
    mlp = single("ppo", PPO_CONFIG, 5, 0).actor
    networks = batch.Networks([(mlp, None)], torch.device("cpu"))
    before = networks.rows.clone()
    networks.flat.grad = torch.full_like(networks.flat, np.inf)
    networks.lr, networks.on = torch.ones(1, 1), torch.zeros(1, 1)
    networks.step()
    assert torch.equal(networks.rows, before)
