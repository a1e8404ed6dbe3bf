"""Hindsight: new goals come from the future of the same episode, with HER's distribution."""

import numpy as np
import pytest
from scipy import stats
from tactilerl.algos.ddpg_her import GoalInputs
from tactilerl.algos.replay import Replay
from tactilerl.algos.rollout import Episode

MAX_STEPS = 8


def reward(achieved, desired):
    return -np.abs(achieved - desired).sum(axis=-1)


def episode(number, length=MAX_STEPS, terminated=False):
    """Every entry says which episode and step it is of; goals to reach are negative."""
    parts = [([number, t, t % 2], [-number, -t, 0], [number, t, 0]) for t in range(length + 1)]
    obs = [*np.array(parts, np.float32).reshape(length + 1, 9)]
    actions = [np.array([number, t], np.float32) for t in range(length)]
    return Episode(obs, actions, [0.0] * length, terminated)


def make_replay(slots=10, seed=0):
    replay = Replay(slots * MAX_STEPS, MAX_STEPS, (3, 3, 2), reward)
    replay.rng = np.random.default_rng(seed)
    return replay


def filled(numbers, slots=10, lengths=None):
    replay = make_replay(slots)
    replay.store([episode(n, (lengths or {}).get(n, MAX_STEPS)) for n in numbers])
    return replay


class TestRelabelling:
    def test_transitions_hang_together(self):
        batch = filled(range(1, 6), lengths={2: 3, 4: 1}).sample(5000, 0.8)
        number, t = batch.obs[:, 0], batch.obs[:, 1]
        np.testing.assert_array_equal(batch.next_obs[:, 0], number)
        np.testing.assert_array_equal(batch.next_obs[:, 1], t + 1)
        np.testing.assert_array_equal(batch.action, np.stack([number, t], axis=1))
        np.testing.assert_array_equal(batch.obs[:, 2], t % 2)
        assert (t < np.where(number == 2, 3, np.where(number == 4, 1, MAX_STEPS))).all()

    def test_goals_are_achieved_later_in_the_same_episode_or_the_own(self):
        batch = filled(range(1, 6), lengths={2: 3}).sample(20_000, 0.8)
        number, t = batch.obs[:, 0], batch.obs[:, 1]
        is_new = batch.goal[:, 0] > 0
        assert stats.binomtest(int(is_new.sum()), is_new.size, 0.8).pvalue > 1e-3
        np.testing.assert_array_equal(batch.goal[is_new, 0], number[is_new])
        assert (batch.goal[is_new, 1] > t[is_new]).all()
        assert (batch.goal[is_new, 1] <= np.where(number == 2, 3, MAX_STEPS)[is_new]).all()
        own = np.stack([-number, -t, 0 * t], axis=1)
        np.testing.assert_array_equal(batch.goal[~is_new], own[~is_new])

    def test_each_later_step_is_equally_likely(self):
        batch = filled([3], lengths={3: 5}).sample(100_000, 0.8)
        for t in range(4):
            chosen = batch.goal[(batch.obs[:, 1] == t) & (batch.goal[:, 0] > 0), 1].astype(int)
            counts = np.bincount(chosen, minlength=6)
            assert counts[: t + 1].sum() == 0
            assert stats.chisquare(counts[t + 1 :]).pvalue > 1e-3

    def test_transitions_are_uniform_whatever_the_episodes_lengths(self):
        batch = filled([1, 2, 3], lengths={1: 2, 3: 5}).sample(60_000, 0.8)
        which = batch.obs[:, 0] * 100 + batch.obs[:, 1]
        _, counts = np.unique(which, return_counts=True)
        assert len(counts) == 2 + MAX_STEPS + 5
        assert stats.chisquare(counts).pvalue > 1e-3

    def test_reward_is_compute_reward_of_the_next_achieved_goal(self):
        batch = filled([1, 2]).sample(1000, 0.8)
        achieved = np.stack([batch.obs[:, 0], batch.obs[:, 1] + 1, 0 * batch.obs[:, 1]], axis=1)
        np.testing.assert_array_equal(batch.reward, reward(achieved, batch.goal))

    def test_only_the_last_transition_of_a_terminated_episode_is_terminal(self):
        replay = make_replay()
        replay.store([episode(1, 4, terminated=True), episode(2, 4)])
        batch = replay.sample(2000, 0.8)
        is_last = (batch.obs[:, 0] == 1) & (batch.obs[:, 1] == 3)
        np.testing.assert_array_equal(batch.terminal, is_last)

    @pytest.mark.parametrize("says", [True, False])
    @pytest.mark.parametrize("at_goal", [True, False])
    def test_a_new_goal_ends_the_episode_where_it_should(self, says, at_goal):
        """The environment says it, or ends that all were at the goal, and only these."""
        replay, first, second = make_replay(), episode(1, 4, terminated=True), episode(2, 4)
        if at_goal:
            for obs in first.obs:
                obs[3:6] = first.obs[-1][6:]

        def ends(achieved, desired):
            return (achieved == desired).all(axis=-1) if says else None

        replay.compute_terminated = ends
        replay.store([first, second])
        batch = replay.sample(2000, 0.8)
        is_new = batch.goal[:, 0] > 0
        is_there = is_new & (batch.goal[:, 1] == batch.obs[:, 1] + 1)
        was_end = (batch.obs[:, 0] == 1) & (batch.obs[:, 1] == 3)
        assert is_there.sum() > 100
        expected = was_end | is_there if says or at_goal else was_end
        np.testing.assert_array_equal(batch.terminal, expected)


class TestStoring:
    def test_full_buffer_overwrites_random_slots(self):
        replay = filled(range(1, 11))
        replay.store([episode(n) for n in range(11, 16)])
        numbers = set(replay.sample(5000, 0.8).obs[:, 0])
        assert len(replay) == 10 * MAX_STEPS
        assert numbers & {11, 12, 13, 14, 15}
        assert 15 in numbers
        assert len(numbers) == 10
        # not first in, first out
        assert {n for n in numbers if n <= 10} != {6, 7, 8, 9, 10}

    def test_a_shorter_episode_hides_what_its_slot_held(self):
        replay = make_replay(slots=1)
        replay.store([episode(1)])
        replay.store([episode(2, length=3)])
        batch = replay.sample(1000, 0.8)
        assert set(batch.obs[:, 0]) == {2}
        assert batch.obs[:, 1].max() == 2
        assert batch.goal[:, 1].max() == 3

    def test_too_small(self):
        with pytest.raises(ValueError, match="buffer_size: found 7, allowed 8"):
            Replay(7, 8, (3, 3, 2), reward)


def test_goal_observation_copies():
    names = ("observation", "desired_goal", "achieved_goal")
    obs = {name: np.full(2, i, np.float64) for i, name in enumerate(names)}
    read = GoalInputs(None).read(obs)
    obs["achieved_goal"][:] = 7.0
    assert read.dtype == np.float32
    assert read.tolist() == [0.0, 0.0, 1.0, 1.0, 2.0, 2.0]
