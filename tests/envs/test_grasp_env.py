"""GraspEnv: Gymnasium's contract, determinism, rewards, run types, faults."""

import copy
import dataclasses
import pickle
import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from tactilerl import envs
from tactilerl.envs import hold, scripted, tasks
from tactilerl.envs.objects import Shape
from tactilerl.envs.simulators import SimulationError
from tactilerl.envs.simulators import mujoco as mujoco_simulator

BOTH = [("shadow", "mujoco"), ("mpl", "pybullet")]
TASKS = [("lift-and-hold", "allegro", "mujoco"), ("reach-goal", "mpl", "pybullet")]
REWARDS = [("lift-and-hold", "staged"), ("reach-goal", "sparse"), ("reach-goal", "dense")]


def make(**choices):
    return envs.make("shadow", **{"hold_seconds": 0.4, **choices})


def rollout(env, seed, n=30, scale=1.0):
    obs, _ = env.reset(seed=seed)
    rng, seen = np.random.default_rng(seed), [obs["observation"]]
    for _ in range(n):
        action = scale * rng.uniform(-1, 1, env.action_space.shape)
        obs, reward, terminated, truncated, _ = env.step(action)
        seen.append(np.append(obs["observation"], reward))
        if terminated or truncated:
            break
    return np.concatenate(seen)


@pytest.mark.parametrize(("task", "hand", "simulator"), TASKS)
def test_gymnasium_accepts_it(task, hand, simulator):
    env = envs.make(hand, hold_seconds=0.4, task=task, simulator=simulator)
    assert env.task.goal_size == {"reach-goal": 3, "lift-and-hold": 1 + 4 + 1}[task]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*(infinity|render|values are equal).*")
        check_env(env, skip_render_check=True)


@pytest.mark.parametrize(("task", "hand", "simulator"), TASKS)
def test_same_seed_same_trajectory_after_every_reset(task, hand, simulator):
    choices = dict(hold_seconds=0.4, task=task, simulator=simulator, layout="1")
    env, again = (envs.make(hand, **choices) for _ in range(2))
    first = rollout(env, 5)
    other = rollout(env, 6)
    assert np.array_equal(first, rollout(env, 5))
    assert np.array_equal(first, rollout(again, 5))
    assert not np.array_equal(first[:50], other[:50])


@pytest.mark.parametrize(("hand", "simulator"), BOTH)
def test_jitter_stays_within_the_joints_ranges(hand, simulator):
    env, starts = envs.make(hand, simulator=simulator), []
    model = env.simulator.model
    for seed in range(10):
        env.reset(seed=seed)
        starts.append(env.simulator.state().joint_positions)
    n_at_limit = 0
    for joint, seen in zip(env.hand.joints[3:], np.array(starts).T[3:], strict=True):
        low, high = model.joint(joint).range
        assert low <= seen.min() <= seen.max() <= high
        assert np.ptp(seen) > 0.005
        n_at_limit += (seen == low).any() or (seen == high).any()
    assert n_at_limit == 3  # there are starts at a limit


@pytest.mark.parametrize(
    ("name", "layout", "size"),
    [
        ("Shadow", 5, 61 + 19),
        pytest.param("MPL", np.int64(5), 12 + 19, marks=pytest.mark.pybullet),
        ("Allegro", "5", 45 + 15),
    ],
)
def test_registered_and_a_layouts_number_is_its_name(name, layout, size):
    env = gym.make(f"tactilerl/{name}-v0", layout=layout)
    assert env.unwrapped.config.layout == "5"
    assert env.reset(seed=0)[0]["observation"].shape == (size,)


def test_observation_is_what_its_names_say():
    env = make(layout="1", task="reach-goal")
    names = env.observation_names()
    obs = env.reset(seed=0)[0]["observation"]
    assert len(names) == len(set(names)) == len(obs) == 27 + 27 + 3 + 4 + 139
    at = dict(zip(names, obs, strict=True))
    data = env.simulator.data
    assert at["position of robot0:FFJ1"] == pytest.approx(data.joint("robot0:FFJ1").qpos[0])
    assert at["object z"] == pytest.approx(0.025)
    quaternion = [at[f"object quaternion {axis}"] for axis in "wxyz"]
    np.testing.assert_allclose(quaternion, data.joint("object").qpos[3:], atol=1e-6)
    assert obs.dtype == np.float32


def test_touch_on_off_and_absent():
    sizes = {kind: make(touch=kind, layout="2") for kind in ("on", "off", "absent")}
    observed = {kind: env.reset(seed=3)[0]["observation"] for kind, env in sizes.items()}
    assert observed["on"].shape == observed["off"].shape
    assert len(observed["absent"]) == len(observed["on"]) - 79
    assert not observed["off"][-79:].any()
    np.testing.assert_array_equal(observed["absent"], observed["off"][:-79])


def test_physics_does_not_depend_on_what_is_felt():
    def trajectory(**choices):
        env = make(task="reach-goal", **choices)
        env.reset(seed=2)
        rng = np.random.default_rng(0)
        for _ in range(15):
            env.step(rng.uniform(-1, 1, 23))
        return env.simulator.data.qpos.copy()

    reference = trajectory(layout="1", touch="absent")
    for choices in (
        dict(layout="1"),
        dict(layout="6", touch="off"),
        dict(layout="1", touch_rule="contact"),
        dict(layout="smarthand"),
    ):
        assert np.array_equal(reference, trajectory(**choices)), choices


def test_absolute_actions_are_the_papers_linear_map():
    env = make(task="reach-goal")
    env.reset(seed=0)
    action = np.random.default_rng(0).uniform(-1, 1, 23)
    env.step(action)
    model, ctrl = env.simulator.model, env.simulator.data.ctrl
    for value, name in zip(action[3:], env.hand.action_names[3:], strict=True):
        low, high = model.actuator(name).ctrlrange
        target = ctrl[model.actuator(name).id]
        assert target == pytest.approx((low + high) / 2 + value * (high - low) / 2)


@pytest.mark.parametrize(("hand", "simulator"), BOTH)
def test_huge_actions_are_those_at_the_limit_and_what_is_none_changes_nothing(hand, simulator):
    env, seen = envs.make(hand, simulator=simulator, task="reach-goal"), []
    size = env.action_space.shape[0]
    none = [np.where(np.arange(size) == 4, bad, 0.0) for bad in (np.nan, np.inf, -np.inf)]
    for largest, refused in ((1.0, []), (7.0, [*none, np.zeros(size - 1)]), (1e30, [])):
        env.reset(seed=0)
        for action in refused:
            with pytest.raises(ValueError, match="action: found"):
                env.step(action)
        seen.append([env.step(np.full(size, largest))[0]["observation"] for _ in range(2)])
    np.testing.assert_array_equal(seen[1:], [seen[0], seen[0]])


class TestRewards:
    def test_reach_goal(self):
        goal = np.array([0.0, 0.0, 0.1])
        achieved = np.array([[0.0, 0.0, 0.1], [0.0, 0.03, 0.1], [0.0, 0.04, 0.1]])
        config = tasks.TaskConfig(goal_height=0.08, goal_tolerance=0.03)
        hand = make().hand
        shape = Shape("box", (0.02, 0.02, 0.02))
        sparse = tasks.ReachGoal(config, hand, 0.004, shape)
        assert sparse.compute_reward(achieved, goal).tolist() == [0.0, 0.0, -1.0]
        dense = tasks.ReachGoal(dataclasses.replace(config, reward="dense"), hand, 0.004, shape)
        np.testing.assert_allclose(dense.compute_reward(achieved, goal), [0.0, -0.3, -0.4])
        assert sparse.is_success(achieved, goal).tolist() == [True, True, False]

    def test_lift_and_hold_stages(self):
        task = make().task
        distances = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
        closeness = np.exp(-0.01) + 0.2 * np.exp(-(distances[1:] ** 2)).sum()
        goals = np.stack([np.append(distances, value) for value in tasks.OUTCOMES.values()])
        rewards = dict(zip(tasks.OUTCOMES, task.compute_reward(goals, task.only_goal), strict=True))
        assert (rewards["timed_out"], rewards["held"]) == (-100.0, 1000.0)
        assert rewards["undecided"] == pytest.approx(closeness)
        assert rewards["fell_back"] == rewards["dropped"] == pytest.approx(closeness + 5)

    @pytest.mark.parametrize(("task", "reward"), REWARDS)
    def test_compute_reward_is_the_reward_of_the_step_and_vectorised(self, task, reward):
        env = make(task=task, reward=reward, max_episode_steps=12)
        env.reset(seed=1)
        achieved, desired, rewards = [], [], []
        rng, done = np.random.default_rng(0), False
        while not done:
            obs, reward, terminated, truncated, _ = env.step(rng.uniform(-1, 1, 23))
            done = terminated or truncated
            achieved.append(obs["achieved_goal"])
            desired.append(obs["desired_goal"])
            rewards.append(reward)
        got = env.compute_reward(np.stack(achieved), np.stack(desired), {})
        np.testing.assert_allclose(got, rewards, rtol=1e-6)
        assert got.shape == (len(rewards),)


class TestFaults:
    def test_nan_from_the_simulator_truncates_and_says_so(self, simulator, request):
        env = envs.make("mpl", simulator=simulator)
        before, _ = env.reset(seed=0)
        if simulator == "mujoco":
            env.simulator.data.qpos[5] = np.nan
        else:
            bullet, nowhere = request.getfixturevalue("bullet"), ((np.nan, 0, 0), (0, 0, 0, 1))
            bullet.resetBasePositionAndOrientation(env.simulator.object, *nowhere, env.simulator.client)
        obs, reward, terminated, truncated, info = env.step(np.zeros(7))
        assert info["diverged"]
        assert "not finite" in info["error"]
        assert (reward, terminated, truncated) == (0.0, False, True)
        assert np.array_equal(obs["observation"], before["observation"])
        assert np.array_equal(env.reset(seed=0)[0]["observation"], before["observation"])
        assert not env.step(np.zeros(7))[-1]["diverged"]

    @pytest.mark.parametrize(("poison", "resets_itself"), [("qvel", False), ("qfrc_applied", True)])
    def test_a_huge_state_that_no_observation_shows_is_divergence(self, poison, resets_itself, in_tmp):
        """Also where MuJoCo puts everything back to the start of the episode and goes on."""
        env = envs.make("mpl", simulator="mujoco", task="reach-goal")
        env.reset(seed=0)
        env.step(np.zeros(7))
        model, data = env.simulator.model, env.simulator.data
        if resets_itself:
            model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        getattr(data, poison)[model.joint("middle_DIP").dofadr] = 1e11
        *_, truncated, info = env.step(np.zeros(7))
        assert truncated
        assert info["diverged"]
        assert info["warnings"] >= 1
        assert (data.time < 0.15) == resets_itself  # of 0.2 s

    @pytest.mark.parametrize("rule", ["skin", "contact"])
    def test_a_step_without_memory_diverges_and_the_next_is_whole(self, rule, monkeypatch, in_tmp):
        """Too little for the constraints of a pressed object; MuJoCo writes a log where it runs."""
        build = mujoco_simulator.build_spec

        def small(scene):
            spec = build(scene)
            spec.memory = 2**16
            return spec

        monkeypatch.setattr(mujoco_simulator, "build_spec", small)
        env, rng = make(touch_rule=rule), np.random.default_rng(0)
        first, info = rollout(env, 5, 3, scale=0.1), {}
        while "mj_stackAlloc" not in info.get("error", ""):
            *_, done, info = env.step(rng.uniform(-1, 1, 23) - 2 * np.eye(23)[2])
            if done and not info["diverged"]:
                env.reset()
        assert not env.simulator.model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        assert np.array_equal(first, rollout(env, 5, 3, scale=0.1))

    @pytest.mark.parametrize(("speed", "ejected"), [(8.0, False), (12.0, True), (2e6, True)])
    def test_ejected_object_counts_as_divergence(self, speed, ejected):
        """A thrown one does not."""
        env = make(task="reach-goal")
        before, _ = env.reset(seed=0)
        thing = env.simulator.data.joint("object")
        thing.qpos[2] += 0.5
        env.state = dataclasses.replace(env.state, object_position=thing.qpos[:3].copy())
        thing.qvel[0] = speed
        obs, _, _, truncated, info = env.step(np.zeros(23))
        assert info["diverged"] is truncated is ejected
        assert ejected == ("ejected" in info.get("error", ""))
        assert ejected == np.array_equal(obs["observation"], before["observation"])
        assert not (env.reset(seed=1), env.step(np.zeros(23)))[1][-1]["diverged"]

    def test_an_episode_that_cannot_begin_is_one_clear_error(self, simulator, monkeypatch):
        env = envs.make("mpl", simulator=simulator)
        monkeypatch.setitem(env.hand.start, env.hand.joints[5], np.nan)
        with pytest.raises(SimulationError, match=r"an episode cannot begin: .* is not finite"):
            env.reset(seed=0)


@pytest.mark.parametrize("friction", [0.3, 2.5])
def test_friction_is_the_objects_against_everything(friction):
    env = make(friction=friction, task="reach-goal")
    env.reset(seed=0)
    thing, seen = env.simulator.model.geom("object").id, set()
    for _ in range(4):
        env.step(np.zeros(23))
        for contact in env.simulator.data.contact:
            if thing in (contact.geom1, contact.geom2):
                assert contact.friction[0] == friction
                seen |= {contact.geom1, contact.geom2}
    assert len(seen) > 2  # ground and hand


class TestHoldTest:
    """The verdict of the hold, on a grasp that holds and on one that cannot."""

    def verdict(self, env, close, verdict="full", seconds=4.0, test=None):
        grasp = scripted.grasp_for(env)
        start = scripted.Offsets()
        for _ in scripted.hold_steps(env, grasp, start, 0.5):
            pass
        targets = scripted.legs(env, grasp, scripted.period(env.config.timestep))[-1][-1]
        if not close:
            targets[3:] = env.hand.start_targets()[3:]
        test = dataclasses.replace(test or env.task.hold, seconds=seconds, verdict=verdict)
        return test.run(env.simulator, dataclasses.replace(env.simulator.state(), targets=targets))

    def test_grasped_object_is_held_at_one_metre(self):
        env = make()
        assert self.verdict(env, close=True)
        assert env.simulator.state().palm[2] == pytest.approx(1.0, abs=0.02)
        assert env.simulator.state().object_position[2] > 0.85
        assert self.verdict(env, close=True, verdict="settled")  # which is called on the way up
        assert env.simulator.state().palm[2] < 0.9

    @pytest.mark.parametrize(("hand", "timestep"), [("shadow", 0.004), ("mpl", 1 / 240)])
    def test_is_5000_of_the_set_ups_own_timesteps_whatever_the_timestep(self, hand, timestep):
        """Looked at every 25 of them."""
        times = np.array([5000, 25]) * timestep
        for choice in ({}, {"timestep": timestep / 2}):
            test = envs.make(hand, simulator="mujoco", **choice).task.hold
            assert [test.seconds, test.look_every] == pytest.approx(times)

    @pytest.mark.parametrize("verdict", ["full", "settled"])
    def test_opened_hand_drops_it(self, verdict):
        assert not self.verdict(make(), close=False, verdict=verdict)

    def test_settled_foresees_a_drop_in_the_far_future(self, monkeypatch):
        """With friction this soft the cube is in the hand for 16 s, and leaves it after that."""
        monkeypatch.setattr(mujoco_simulator, "FRICTION_TO_NORMAL_IMPEDANCE", 1.0)
        env = make()
        assert self.verdict(env, close=True)
        env = make()
        assert not self.verdict(env, close=True, verdict="settled", seconds=20.0)

    def test_settled_waits_while_the_object_stands_on_the_ground(self):
        """A hand that is too weak to rise keeps still, and so does what is in it."""
        env = make(hold_seconds=20.0, hold_verdict="settled")
        env.reset(seed=0)
        env.simulator.model.actuator("slide_z").forcerange = 0.0
        rises, began = env.task.hold.height / hold.RAISE_SPEED, env.simulator.data.time
        env.task.hold.run(env.simulator, env.state)
        assert env.simulator.state().object_position[2] < 0.03
        assert env.simulator.data.time - began > 0.8 * rises

    def test_settled_ends_at_the_top_when_the_compressed_time_is_up(self):
        """Nothing is ever at rest here. 2.7 s to grasp, 2.7 s of shaking; 1.2 s are compressed."""
        env = make()
        test = dataclasses.replace(env.task.hold, settle_distance=0.0, shake_seconds=2.7)
        assert self.verdict(env, close=True, verdict="settled", test=test, seconds=20.0)
        assert env.simulator.state().palm[2] > 0.9
        assert env.simulator.data.time == pytest.approx(2.7 + 2.7 + 1.2, abs=0.25)

    def test_what_was_thrown_up_is_not_held_while_it_flies(self):
        env = make(hold_seconds=0.2)
        env.reset(seed=0)
        thing = env.simulator.data.joint("object")
        thing.qpos[2], thing.qvel[2] = 0.5, 40.0
        assert not env.task.hold.run(env.simulator, env.simulator.state())
        assert env.simulator.state().object_position[2] > 1.0


def test_a_copy_goes_on_as_the_environment_and_on_its_own():
    env = make()
    env.reset(seed=0)
    env.step(np.zeros(23))
    twin = copy.deepcopy(env)
    rng = np.random.default_rng(0)
    for action in rng.uniform(-1, 1, (3, 23)):
        there, here = twin.step(action)[0], env.step(action)[0]
        assert np.array_equal(here["observation"], there["observation"])


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_pybullet_environment_says_that_it_cannot_be_copied(copied):
    """A copy would step the original's world."""
    pytest.importorskip("pybullet")
    env = envs.make("mpl")
    with pytest.raises(TypeError, match="cannot be copied or pickled: make another"):
        copied(env)
    env.reset(seed=0)


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
