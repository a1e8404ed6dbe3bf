"""Somebody holds an object against the hand and lets go: giver, task, and the hand's few actions."""

import numpy as np
import pytest
from tactilerl import envs
from tactilerl.envs import objects, tasks
from tactilerl.envs.simulators import Giver
from tactilerl.scripted.reflexes import Reflex

STILL = {"jitter": False, "start_offset": objects.OFFSET}
LATE = tasks.Handover.waits[1] + tasks.Handover.stays + 1


def make(hand="mpl", simulator="mujoco", **choices):
    return envs.make(hand, scene="handover", simulator=simulator, **choices)


def heights(env, seed=0, steps=LATE):
    """Of the object's upper side over the palm's skin, m, after each step with the hand left open."""
    env.reset(seed=seed)
    found, done = [], False
    while not done and len(found) < steps:
        *_, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape))
        done = terminated or truncated
        top = env.simulator.state().object_position[2] + env.shape.half_size[2]
        found.append(top - env.palm_skin[2])
    return np.array(found)


class TestGiver:
    def test_a_damped_spring_of_little_force(self):
        giver = Giver(stiffness=100.0, damping=2.0, force=1.0)
        rest = np.array([0.004, 0.1, 0.0])
        pull = giver.pull(rest, np.zeros(3), np.array([0.0, 0.0, 0.2]))
        np.testing.assert_allclose(pull, [0.4, 1.0, -0.4])

    def test_moves_the_object_as_the_spring_would(self, simulator):
        """On its way, far from the hand, against the same spring stepped on its own."""
        env = make(simulator=simulator, object_size=(0.04,), **STILL)
        env.reset(seed=0)
        sim, giver, dt = env.simulator, env.task.giver, env.config.timestep / 8
        start, mass = sim.state().object_position, 400 * 0.04**3
        goal = start + np.array([0.0, 0.0, 0.05])
        sim.carry(goal)
        targets = env.hand.start_targets()
        position, velocity, rest = start.copy(), np.zeros(3), start.copy()
        for _ in range(40):
            sim.step(targets, 1)
            for _ in range(8):
                rest += np.clip(goal - rest, -giver.speed * dt, giver.speed * dt)
                velocity += dt * giver.pull(rest, position, velocity) / mass
                position += dt * velocity
            # A step of 4 ms:
            np.testing.assert_allclose(sim.state().object_position, position, atol=2.4e-3)
        assert position[2] - start[2] > 0.03

    def test_presses_with_as_much_as_is_asked_for(self):
        for force in (0.32, 1.5):
            env = make(giver_force=force, object_size=(0.04,), **STILL)
            env.reset(seed=0)
            for _ in range(env.task.sets_off + 8):
                env.step_to(env.hand.start_targets())
            pressed = env.simulator.state().contacts.forces.sum()
            assert pressed == pytest.approx(force, rel=0.15)  # the hand gives way a little

    def test_after_letting_go_the_object_falls_freely(self, simulator):
        env = make(simulator=simulator)
        env.reset(seed=0)
        sim, targets = env.simulator, env.hand.start_targets()
        sim.step(targets, 10)
        assert np.abs(sim.state().object_velocity).max() < 1e-3  # its weight is carried
        sim.let_go()
        sim.step(targets, 20)
        fallen = 9.81 * 20 * env.config.timestep
        assert sim.state().object_velocity[2] == pytest.approx(-fallen, rel=0.06)
        env.reset(seed=0)
        sim.step(targets, 10)
        assert np.abs(sim.state().object_velocity).max() < 1e-3  # and so it is in the next episode


class TestEpisode:
    @pytest.mark.parametrize(
        ("hand", "simulator"), [("mpl", "mujoco"), ("shadow", "pybullet"), ("allegro", "mujoco")]
    )
    def test_waits_arrives_and_falls(self, hand, simulator):
        env = make(hand, simulator)
        found = heights(env)
        sets_off = env.task.sets_off
        np.testing.assert_allclose(found[: sets_off - 1], -env.task.below, atol=1e-3)
        held_up = found[sets_off + 5 : sets_off + env.task.stays - 1]
        assert np.abs(held_up).max() < 0.01
        assert np.ptp(held_up) < 2e-3
        assert found[-1] < -env.task.fallen + 0.1

    def test_the_hand_hardly_notices_and_the_taxels_do(self):
        env = make(**STILL)
        env.reset(seed=0)
        positions, felt = [], []
        for _ in range(env.task.sets_off + env.task.stays - 1):
            env.step(np.zeros(1))
            positions.append(env.simulator.state().joint_positions.copy())
            felt.append(int(env.taxel_readings().sum()))
        before, after = positions[env.task.sets_off - 2], positions[-1]
        assert np.abs(after - before)[:3].max() < 1e-3  # m, of the slides
        assert np.abs(after - before)[3:].max() < 0.01  # rad
        assert felt[env.task.sets_off - 2] == 0
        assert felt[-1] > 0

    def test_times_are_drawn_and_the_same_whatever_is_sensed(self):
        both = make(), make(touch="off")
        drawn = []
        for seed in range(100):
            a, b = (env.reset(seed=seed) and env.task.sets_off for env in both)
            assert a == b
            drawn.append(a)
        assert (min(drawn), max(drawn)) == tasks.Handover.waits

    def test_an_episode_leaves_nothing_to_the_next(self, simulator):
        env = make(simulator=simulator)
        first = heights(env, seed=3)
        heights(env, seed=4, steps=20)  # cut off while somebody holds the object
        np.testing.assert_array_equal(heights(env, seed=3), first)

    def test_outcomes_and_rewards(self):
        env = make()
        env.reset(seed=0)
        total, done, info = 0.0, False, {}
        while not done:
            _, reward, terminated, truncated, info = env.step(np.zeros(1))
            total, done = total + reward, terminated or truncated
        assert (total, info["is_success"], terminated) == (-100.0, False, True)
        assert Reflex("touch", 1, 1.0).play(env, 0)
        goals = np.array([[value] for value in tasks.OUTCOMES.values()])
        rewards = dict(zip(tasks.OUTCOMES, env.compute_reward(goals, goals, {}), strict=True))
        assert (rewards["held"], rewards["missed"], rewards["undecided"]) == (1000.0, -100.0, 0.0)

    def test_where_it_is_held_is_drawn_from_a_range(self):
        still, env, moved = make(**STILL), make(**STILL, handover_reach="0.02..0.04"), []
        for seed in range(20):
            still.reset(seed=seed), env.reset(seed=seed)
            moved.append(still.state.object_position - env.state.object_position)
        across, reach, height = np.transpose(moved)
        np.testing.assert_allclose([across, height], 0.0, atol=1e-9)
        assert 0.02 <= reach.min() < 0.025 < 0.035 < reach.max() <= 0.04

    def test_a_hold_test_at_the_last_step_counts(self):
        short = make(max_episode_steps=tasks.Handover.waits[1] + 18)
        assert all(Reflex("touch", 1, 1.0).play(short, seed) for seed in range(4))


class TestActions:
    def test_grip_is_one_action_that_closes_the_whole_hand(self, hand):
        env = make(hand)
        assert env.action_space.shape == (1,)
        env.reset(seed=0)
        start = targets = env.hand.start_targets()
        for _ in range(4):
            targets = env.hand.action_map(np.ones(1), targets)
        closed = dict(zip(env.hand.actuators, targets, strict=True))
        assert {name: closed[name] for name in env.hand.closed} == pytest.approx(env.hand.closed)
        np.testing.assert_array_equal(targets[:3], start[:3])  # the arm stands still
        np.testing.assert_array_equal(env.hand.action_map(np.ones(1), targets), targets)
        for _ in range(4):
            targets = env.hand.action_map(-np.ones(1), targets)
        np.testing.assert_allclose(targets, start, atol=1e-12)  # it opens as far as it was at first

    def test_what_was_asked_for_is_observed(self):
        env = make()
        (at,) = env.observation_entries("targets")
        asked = [env.reset(seed=0)[0]["observation"][at]]
        for action in (1.0, 1.0, -0.4):
            asked.append(env.step(np.array([action]))[0]["observation"][at])
        np.testing.assert_allclose(asked, [0.0, 0.5, 1.0, 0.8], atol=1e-6)
