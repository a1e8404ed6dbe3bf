"""Goals that are drawn, and what a task may look at."""

import numpy as np
import pytest
from tactilerl import envs

BOTH = [("shadow", "mujoco"), ("mpl", "pybullet")]


@pytest.mark.parametrize(("hand", "simulator"), BOTH)
def test_goals_are_drawn_within_their_range_and_starts_stay(hand, simulator):
    choices = {"simulator": simulator, "task": "reach-goal", "goal_height": 0.1}
    fixed, drawn = envs.make(hand, **choices), envs.make(hand, **choices, goal_range=0.05)
    goals = []
    for seed in range(20):
        a, b = (env.reset(seed=seed)[0] for env in (fixed, drawn))
        np.testing.assert_array_equal(a["observation"], b["observation"])
        goals.append(b["desired_goal"] - a["desired_goal"])
        after = drawn.step(np.zeros(drawn.action_space.shape))[0]
        np.testing.assert_array_equal(after["desired_goal"], b["desired_goal"])
    again = drawn.reset(seed=0)[0]["desired_goal"] - a["desired_goal"]
    np.testing.assert_array_equal(again, goals[0])
    assert np.abs(goals).max() <= 0.05 + 1e-6
    assert (np.ptp(goals, axis=0) > 0.05).all()
    assert not np.array_equal(drawn.reset()[0]["desired_goal"], drawn.reset()[0]["desired_goal"])


def test_the_objects_velocity_is_what_its_poses_say(simulator):
    """Of a turned box that falls and spins in free space."""
    env = envs.make("mpl", simulator=simulator, object_size=(0.02, 0.03, 0.05))
    sim, dt = env.simulator, env.config.timestep
    assert not sim.state().object_velocity.any()
    sim.reset(env.hand.start_positions(), np.array([0.4, 0.4, 1.0]), 0.7)
    if simulator == "mujoco":
        sim.data.joint("object").qvel[3:] = [2.0, 1.0, 3.0]
    else:
        from tactilerl.envs.simulators.pybullet import pybullet

        pybullet.resetBaseVelocity(sim.object, [0, 0, 0], [1.5, 1.0, 3.0], physicsClientId=sim.client)
    targets, states = env.hand.start_targets(), []
    for _ in range(12):
        sim.step(targets, 1)
        states.append(sim.state())
    before, last = states[-2], states[-1]
    moved = (last.object_position - before.object_position) / dt
    np.testing.assert_allclose(last.object_velocity, moved, atol=1e-6)
    assert last.object_velocity[2] == pytest.approx(-9.81 * 12 * dt, rel=0.05)
    turned = last.object_rotation @ before.object_rotation.T
    spin = np.array([turned[2, 1], turned[0, 2], turned[1, 0]]) / dt
    np.testing.assert_allclose(last.object_angular_velocity, spin, rtol=0.02, atol=0.02)
