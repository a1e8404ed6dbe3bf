"""Both hands in both simulators: the same mechanism, repeatable runs, clean ends."""

import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from tactilerl import envs
from tactilerl.envs import hands, objects, scripted, simulators
from tactilerl.envs.grasp import GraspEnv, setup

from one_line import fails_with

GRIPPER = str(Path(__file__).parents[1] / "hands" / "gripper.toml")
PAIRS = [("shadow", "mujoco"), ("mpl", "pybullet"), ("allegro", "mujoco")]
BIG = [("sphere", (0.08,)), ("box", (0.0501,)), ("box", (0.08, 0.08, 0.01)), ("cylinder", (0.08, 0.15))]


def made(simulator, hand):
    box, figures = objects.make("box", (0.05,)), dict(mass=0.1, friction=1.0, timestep=1 / 240)
    scene = simulators.Scene(hand=hands.get(hand), shape=box, finger_gain=1.0, **figures)
    return simulators.make(simulator, scene)


@pytest.fixture
def pair(hand):
    """The same scene in MuJoCo and in PyBullet."""
    return [made(name, hand) for name in ("mujoco", "pybullet")]


def bodies(model):
    return tuple(model.body(i).name for i in range(1, model.nbody) if model.body(i).name != "object")


def gap(env):
    """Least distance between hand and object now, m; negative where they overlap."""
    simulator = env.simulator
    if env.config.simulator == "pybullet":
        from tactilerl.envs.simulators.pybullet import pybullet

        bodies = simulator.hand, simulator.object
        points = pybullet.getClosestPoints(*bodies, 1.0, physicsClientId=simulator.client)
        return min(point[8] for point in points)
    model, data = simulator.model, simulator.data
    thing, ground = model.geom("object").id, model.geom("ground").id
    touching = model.geom_contype | model.geom_conaffinity
    hand = [g for g in range(model.ngeom) if touching[g] and g not in (thing, ground)]
    return min(mujoco.mj_geomDistance(model, data, g, thing, 1.0, None) for g in hand)


@pytest.mark.pybullet
class TestKinematics:
    def test_same_angles_same_poses(self, pair):
        mj, _ = pair
        hand, rng = mj.scene.hand, np.random.default_rng(0)
        for _ in range(20):
            positions = rng.uniform(-0.5, 1.0, len(hand.joints))
            for simulator in pair:
                simulator.reset(positions, np.array([0.1, 0.2, 1.0]), 0.4)
            for a, b in zip(*(s.state().poses(bodies(mj.model)) for s in pair), strict=True):
                assert np.abs(a - b).max() < 1e-6
            one, other = (s.state() for s in pair)
            for name, atol in (("palm", 1e-6), ("fingertips", 1e-6), ("joint_positions", 1e-12),
                               ("object_rotation", 1e-7), ("object_orientation", 1e-7)):  # fmt: skip
                np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=atol)

    def test_same_masses_and_limits(self, pair, bullet):
        mj, other = pair
        for name in bodies(mj.model):
            index, body = other._links[name], mj.model.body(name).id
            info = bullet.getDynamicsInfo(other.hand, index, physicsClientId=other.client)
            assert info[0] == pytest.approx(mj.model.body_mass[body], rel=1e-12)
            expected = mj.model.body_inertia[body] + mj.scene.hand.file.added_inertia
            np.testing.assert_allclose(info[2], expected, rtol=1e-6)
        for name in mj.scene.hand.joints[3:]:
            joint = other._joint_index[name]
            info = bullet.getJointInfo(other.hand, joint, physicsClientId=other.client)
            np.testing.assert_allclose(info[8:10], mj.model.joint(name).range, rtol=1e-12)


def jacobian_error(simulator):
    """How far accelerations differ between a sparse and a dense Jacobian, as a share of the largest."""
    found, model = [], simulator.model
    for kind in (mujoco.mjtJacobian.mjJAC_DENSE, mujoco.mjtJacobian.mjJAC_SPARSE):
        data = mujoco.MjData(model)
        mujoco.mj_copyData(data, model, simulator.data)
        data.qacc_warmstart[:] = 0.0  # or both begin at the solution
        model.opt.jacobian = kind
        mujoco.mj_forward(model, data)
        found.append(data.qacc)
    return np.abs(found[0] - found[1]).max() / np.abs(found[0]).max()


class TestPhysics:
    @pytest.mark.parametrize("hand", [*hands.HANDS, GRIPPER])
    def test_scripted_grasps_hold_and_the_taxels_feel_them(self, simulator, hand):
        env = GraspEnv(hand, setup(hand, simulator=simulator, layout="1"))
        start = scripted.perturbed_start(env, 3, 0)
        held, bits = [], []
        for is_up in scripted.hold_steps(env, scripted.grasp_for(env), start, 0.5):
            held.append(is_up)
            bits.append(env.taxel_readings().sum())
        assert held[-1]
        assert np.mean(bits) >= 2.0
        if simulator == "mujoco":  # 4.0.0 solves some trees wrongly: google-deepmind/mujoco#3767
            assert jacobian_error(env.simulator) < 1e-9

    @pytest.mark.parametrize(
        ("kind", "size", "volume"),
        [
            ("box", (0.05,), 125e-6),
            ("box", (0.02, 0.03, 0.05), 30e-6),
            ("sphere", (0.04,), 4 / 3 * np.pi * 8e-6),
            ("cylinder", (0.03, 0.05), np.pi * 0.015**2 * 0.05),
        ],
    )
    def test_objects_weigh_what_they_should_and_rest_on_the_ground(self, simulator, kind, size, volume):
        env = envs.make("mpl", simulator=simulator, object=kind, object_size=size, jitter=False)
        assert env.simulator.scene.mass == pytest.approx(800 * volume)
        env.reset(seed=0)
        env.simulator.step(env.hand.start_targets(), 120)
        position = env.simulator.state().object_position
        np.testing.assert_allclose(position, [0, 0, size[-1] / 2], atol=1e-3)

    @pytest.mark.parametrize(("kind", "size"), BIG)
    @pytest.mark.parametrize(("hand", "simulator"), PAIRS)
    def test_over_a_wider_object_the_hand_starts_free_of_it(self, hand, simulator, kind, size):
        env = envs.make(hand, simulator=simulator, object=kind, object_size=size)
        for seed in range(10):
            env.reset(seed=seed)
            assert gap(env) > 5e-3


@pytest.mark.pybullet
class TestPyBullet:
    def test_a_motor_takes_its_error_back_at_the_rate_of_the_models_servo(self):
        env = GraspEnv("mpl", setup("mpl", task="reach-goal"))
        env.reset(seed=0)
        simulator, hand = env.simulator, env.hand
        servo, joint = (getattr(simulator.model, kind)("slide_y") for kind in ("actuator", "joint"))
        rate = servo.gainprm[0] / joint.damping[0]
        targets = hand.start_targets()
        targets[1] += 0.01
        left = []
        for _ in range(3):
            simulator.step(targets, round(0.05 / env.config.timestep))
            left.append(targets[1] - simulator.state().joint_positions[1])
        np.testing.assert_allclose(np.diff(np.log(left)) / 0.05, -rate, rtol=0.05)

    @pytest.mark.slow
    def test_a_held_cube_does_not_creep(self):
        env = GraspEnv("mpl", setup("mpl", layout="1"))
        drifts = []
        for number in range(3):
            places, start = [], scripted.perturbed_start(env, 4, number)
            for is_up in scripted.hold_steps(env, scripted.grasp_for(env), start, 3.0):
                (palm,), (frame,) = env.simulator.state().poses((env.hand.palm,))
                places.append(frame.T @ (env.simulator.state().object_position - palm))
                assert is_up
            drifts.append(np.linalg.norm(places[-1] - places[0]))
        assert np.median(drifts) < 1e-3  # m; without friction anchors several times that

    def test_each_environment_has_its_own_client_and_releases_it(self, bullet):
        first, second = (envs.make("mpl") for _ in range(2))
        a, b = first.simulator.client, second.simulator.client
        assert a != b
        first.reset(seed=0)
        second.reset(seed=0)
        state = second.simulator.state().object_position
        first.step(np.ones(7))
        np.testing.assert_array_equal(second.simulator.state().object_position, state)
        first.close()
        assert not bullet.isConnected(a)
        del second  # without close
        assert not bullet.isConnected(b)

    def test_a_dead_client_is_an_error_that_names_it(self, bullet):
        env = envs.make("mpl", task="reach-goal")
        env.reset(seed=0)
        bullet.disconnect(env.simulator.client)
        *_, truncated, info = env.step(np.zeros(7))
        assert truncated
        assert info["diverged"]
        assert "PyBullet" in info["error"]
        with pytest.raises(FloatingPointError, match="PyBullet"):
            env.reset()

    def test_without_the_package_the_message_names_the_extra(self, tmp_path, monkeypatch, capsys):
        monkeypatch.setitem(sys.modules, "pybullet", None)  # as where a package is not there
        monkeypatch.delitem(sys.modules, "tactilerl.envs.simulators.pybullet", raising=False)
        args = ["train", "--env", "mpl", "--out", tmp_path / "never"]
        fails_with(capsys, args, "pip install 'tactilerl[pybullet]'")


class TestMPL:
    def test_actions_are_increments_within_limits(self):
        hand = hands.get("mpl")
        action, start = hand.action_map, hand.start_targets()
        names = list(hand.actuated)
        np.testing.assert_allclose(action(np.zeros(7), start), start, atol=1e-15)
        closed = start
        for _ in range(20):
            closed = action(np.ones(7), closed)
        assert closed[names.index("index_MCP")] == pytest.approx(1.57)
        assert closed[names.index("thumb_ABD")] == pytest.approx(1.95)
        assert closed[:3].tolist() == action.slide_limits[:, 1].tolist()
        one = action(np.eye(7)[3], start) - start  # thumb and little finger move together
        moved = {name.partition("_")[0] for name, by in zip(names, one, strict=True) if abs(by) > 1e-12}
        assert moved == {"thumb", "little"}


@pytest.mark.parametrize("simulator", ["mujoco", pytest.param("pybullet", marks=pytest.mark.slow)])
def test_every_picture_has_the_size_of_its_camera(simulator):
    env = envs.make("shadow", layout="1", simulator=simulator, render_mode="rgb_array")
    env.reset(seed=0)
    for height, width in ((60, 80), (90, 40), (60, 80)):
        try:
            drawn = env.unwrapped.picture(simulators.Camera(width=width, height=height))
        except OSError as error:  # of MuJoCo, without a display, EGL and OSMesa
            pytest.skip(str(error))
        assert (drawn.shape, drawn.dtype) == ((height, width, 3), np.uint8)
        assert len(np.unique(drawn)) > 10
    env.close()
