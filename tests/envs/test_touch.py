"""The skin rule against distances known by construction."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tactilerl import envs
from tactilerl.envs import hands, layouts, objects, scripted, touch
from tactilerl.envs.hands import Surface
from tactilerl.envs.state import Contacts
from tactilerl.envs.taxel_files import Point

import states


def state(taxels, link_poses, shape, position, rotation):
    """An object, and the links of taxels with their positions and rotations."""
    return states.scene(
        shape=shape, object_position=np.array(position), object_rotation=np.array(rotation),
        links=taxels.links, link_positions=link_poses[0], link_rotations=link_poses[1],
    )  # fmt: skip


R, L = 0.01, 0.04  # of the one phalanx of a hand made for these tests: its bone along z
PHALANX = Surface(
    "index", "distal", "a", (0.0, 0.0, L / 2), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0), R,
    bone=((0.0, 0.0, 0.0), (0.0, 0.0, L)),
)  # fmt: skip
PALM = Surface("index", "palm", "b", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))


def rule_at(surfaces, places):
    """Taxels in the middle of surfaces, each at (index of the surface, m along), and their rule."""
    points = []
    for index, row in places:
        position, normal = (tuple(v.tolist()) for v in surfaces[index].place(row, 0.0))
        points.append(Point(surfaces[index].link, position, normal, 1.5e-3, ""))
    index = np.array([index for index, _ in places])
    taxels = layouts.Taxels(tuple(points), index, np.zeros((len(places), 3)))
    hand = SimpleNamespace(surfaces=surfaces)  # all that the rule looks at of one
    return taxels, touch.SkinTouch(taxels, hand)


def read(surface, rows, shape, position, rotation):
    """What taxels `rows` m along a surface feel of an object that is placed as seen from their link."""
    turn, place = Rotation.random(rng=3).as_matrix(), np.array([0.3, 0.1, 0.2])
    taxels, rule = rule_at([surface], [(0, row) for row in rows])
    moved = turn @ np.array(position) + place, turn @ rotation
    return rule.read(state(taxels, (place[None], turn[None]), shape, *moved)).tolist()


@pytest.mark.parametrize("surface", [PHALANX, PALM])
@pytest.mark.parametrize(("gap", "on"), [(-5e-4, True), (4e-4, True), (6e-4, False), (1.4e-3, False)])
def test_a_taxel_feels_what_touches_its_skin_and_not_what_is_only_near(surface, gap, on):
    """A cube with its face to the palmar side; taxels in the middle of it and 5 mm beyond."""
    y = -surface.radius - gap - 0.02
    middle = [0.0, y, surface.centre[2]], np.eye(3)
    assert read(surface, [0.0, 0.025], objects.make("box", (0.04,)), *middle) == [on, False]


def test_a_taxel_reaches_as_far_as_its_radius_along_a_link_that_touches():
    """A face touches the base of a bone and leaves it at 0.1 rad: by 1.2 and 1.8 mm at the last."""
    tilt = Rotation.from_rotvec([0.1, 0.0, 0.0]).as_matrix()
    rows, box = np.array([0.0, 0.012, 0.018]) - L / 2, objects.make("box", (0.1,))
    assert read(PHALANX, rows, box, -(R + 0.05) * tilt[:, 1], tilt) == [True, True, False]


def test_a_link_that_does_not_touch_is_silent_whatever_another_feels():
    twin = dataclasses.replace(PHALANX, link="b")
    taxels, rule = rule_at([PHALANX, twin], [(0, 0.0), (1, 0.0)])
    poses = np.array([[0.0, 0.0, 0.0], [0.0, 1e-3, 0.0]]), np.tile(np.eye(3), (2, 1, 1))
    box, place = objects.make("box", (0.04,)), [0.0, -R - 0.02, L / 2]
    assert rule.read(state(taxels, poses, box, place, np.eye(3))).tolist() == [True, False]


@pytest.mark.parametrize(("gap", "on"), [(touch.SKIN - 1e-4, True), (touch.SKIN + 1e-4, False)])
def test_boxes_and_hulls_feel_what_is_within_their_skin(gap, on):
    """A cube has its face over each taxel of a gripper of boxes and meshes; links are far apart."""
    hand = hands.get(str(Path(__file__).parents[1] / "hands/gripper.toml"))
    taxels = layouts.load("5").place(hand)
    rule, cube, n = touch.SkinTouch(taxels, hand), objects.make("box", (0.04,)), len(taxels.links)
    poses = np.arange(3.0 * n).reshape(n, 3), np.tile(np.eye(3), (n, 1, 1))
    for index, normal in enumerate(taxels.normals):
        turn = np.linalg.svd(normal[None])[2].T[:, [1, 2, 0]]
        turn *= np.sign(np.linalg.det(turn))
        place = poses[0][taxels.link_index[index]] + taxels.positions[index] + (0.02 + gap) * normal
        assert rule.read(state(taxels, poses, cube, place, turn))[index] == on, taxels.names[index]


def test_skin_is_the_shape_that_the_simulators_collide(hand):
    """A phalanx is one capsule around its bone; the disc of a palm taxel lies on a box's face."""
    hand = hands.get(hand)
    model = hand.build(False, 1.0).compile()
    for surface in hand.surfaces:
        geoms = np.flatnonzero(model.geom_bodyid == model.body(surface.link).id)
        if surface.bone is not None:
            (geom,) = geoms
            assert model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE
            assert model.geom_size[geom, 0] == pytest.approx(surface.radius)
            axis = Rotation.from_quat(model.geom_quat[geom], scalar_first=True).as_matrix()[:, 2]
            ends = model.geom_pos[geom] + np.outer([-1, 1], model.geom_size[geom, 1] * axis)
            ends = ends[np.argsort(ends @ surface.along)]
            np.testing.assert_allclose(ends, surface.bone, atol=1e-8)
        else:
            across = np.array(surface.palmar) == 0
            room = model.geom_size[geoms] - np.abs(model.geom_pos[geoms] - surface.centre)
            on_face = np.abs(room[:, ~across]).ravel() < 1e-9
            assert (on_face & (room[:, across] >= hand.pitch.radius).all(axis=1)).any()


@pytest.fixture(params=objects.KINDS)
def solid(request):
    """A shape, and many points of the box around it that lie inside (n, 3)."""
    sizes = {"sphere": (0.04,), "cylinder": (0.04, 0.06), "capsule": (0.03, 0.04)}
    shape = objects.make(request.param, sizes.get(request.param, (0.02, 0.04, 0.06)))
    points = np.random.default_rng(0).uniform(-1, 1, (200_000, 3)) * shape.half_size
    return shape, points[shape.squared_distance(points) == 0]


def test_volume_is_that_of_the_points_inside(solid):
    shape, inside = solid
    share = len(inside) / 200_000
    assert share * np.prod(shape.half_size) * 8 == pytest.approx(shape.volume, rel=0.01)
    squares = (inside**2).mean(axis=0)
    np.testing.assert_allclose(shape.inertia, squares.sum() - squares, rtol=0.01)


def test_distance_to_a_shape_is_that_to_the_nearest_of_many_points_inside(solid):
    """Up to the gaps between them."""
    shape, inside = solid
    for point in np.random.default_rng(1).uniform(-0.08, 0.08, (20, 3)):
        nearest = np.linalg.norm(inside - point, axis=1).min()
        distance = np.sqrt(shape.squared_distance(point[None])[0])
        assert distance <= nearest + 1e-12
        assert nearest - distance < 3e-3


@pytest.mark.parametrize("axes", [(0.08, 0.03, 0.03), (0.08, 0.08, 0.01), (0.004, 0.08, 0.1)])
def test_distance_to_an_ellipsoid_of_odd_aspect(axes):
    """Points a known way out along the normals of points on it, both in NumPy and in PyTorch."""
    shape, rng = objects.make("ellipsoid", axes), np.random.default_rng(0)
    half = np.array(shape.half_size)
    on_ball = rng.standard_normal((1000, 3))
    on_ball /= np.linalg.norm(on_ball, axis=1)[:, None]
    normals = on_ball / half
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    away = rng.choice([1e-5, 1e-3, 0.05], (1000, 1))
    points = half * on_ball + away * normals
    many = objects.Shape("ellipsoid", tuple(torch.as_tensor(half).repeat(2, 1).T))
    in_torch = many.squared_distance(torch.as_tensor(points).reshape(2, -1, 3)).numpy()
    for found in (shape.squared_distance(points), in_torch.ravel()):
        np.testing.assert_allclose(np.sqrt(found), away[:, 0], rtol=0, atol=1e-8)
    assert not shape.squared_distance(0.999 * half * on_ball).any()


def test_half_height_is_that_of_the_lowest_point(solid):
    shape, inside = solid
    for turn in Rotation.random(5, rng=2):
        rotation = turn.as_matrix()
        lowest = -(inside @ rotation.T)[:, 2].min()
        assert lowest <= shape.half_height(rotation) + 1e-12
        assert shape.half_height(rotation) - lowest < 3e-3


class TestForce:
    """What a sensor that stands proud of the skin would carry, and a threshold on it."""

    def test_it_is_what_mujocos_sensor_reads_on_each_sensor_alone(self):
        """A cube is pressed on a flat palm, 10 mm beside its middle, and then on one sensor that
        stands 0.5 mm proud of it."""
        places = [(0.0, 0.0), (0.008, 0.0), (0.0, -0.01), (0.013, 0.012), (0.028, 0.0), (-0.012, 0.0)]
        points = tuple(Point("palm", (*place, 0.0), (0.0, 0.0, 1.0), 0.004, "") for place in places)
        palm = Surface("index", "palm", "palm", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
        taxels = layouts.Taxels(points, np.zeros(len(points), int), np.zeros((len(points), 3)))
        rule = touch.ForceRule(taxels, SimpleNamespace(surfaces=[palm]))
        readings = rule.read(pressed_on_palm(None)[1])
        carried = np.array([pressed_on_palm(place)[0] for place in places])
        assert carried.max() > 0.25
        np.testing.assert_allclose(readings, carried, rtol=0.2)

    def test_a_reading_does_not_depend_on_other_taxels(self, simulator):
        env = envs.make("mpl", simulator=simulator, layout="1", touch_rule="force")
        start = scripted.perturbed_start(env, 0, 0)
        for _ in scripted.hold_steps(env, scripted.grasp_for(env), start, 0.3):
            together, state = env.taxel_readings(), env.simulator.state()
            alone = [
                touch.ForceRule(env.taxels.take([i]), env.hand).read(state)[0]
                for i in np.flatnonzero(together)[:5]
            ]
            np.testing.assert_allclose(alone, together[together > 0][:5])
        assert len(alone) == 5
        assert together.max() <= state.contacts.forces.sum()

    def test_a_taxel_fires_from_its_threshold_up_until_less_than_its_release(self, monkeypatch):
        choices = dict(layout="5", taxel_threshold=0.5, taxel_release=0.4)
        env = envs.make("mpl", simulator="mujoco", **choices)
        felt, n = [0.0, 0.49, 0.5, 0.41, 0.39, 0.49], len(env.taxels)
        told = iter([(np.ones(n, bool), np.full(n, force)) for force in felt])
        monkeypatch.setattr(touch.ForceRule, "feel", lambda *_: next(told))
        fires = [set(env.taxel_readings().tolist()) for _ in felt]
        assert fires == [{False}, {False}, {True}, {True}, {False}, {False}]

    def test_an_episode_begins_without_what_fired_in_the_last(self):
        env = envs.make(scene="handover", taxel_threshold=0.1)

        def played():
            obs, _ = env.reset(seed=3)
            return [obs, *(env.step_to(env.hand.start_targets())[0] for _ in range(30))]

        twice = [[obs["observation"] for obs in played()] for _ in range(2)]
        np.testing.assert_array_equal(*twice)
        assert env.taxel_readings().any()

    @pytest.mark.pybullet
    def test_both_simulators_press_as_hard_and_twice_the_gain_twice_as_hard(self):
        pressed, in_bullet, stronger = (
            total_force(**choices) for choices in ({}, {"simulator": "pybullet"}, {"finger_gain": 2.0})
        )
        assert in_bullet == pytest.approx(pressed, rel=0.05)
        assert stronger == pytest.approx(2 * pressed, rel=0.35)

    def test_forces_have_no_upper_bound(self):
        env = envs.make("mpl", simulator="mujoco", touch_rule="force", layout="1")
        space = env.observation_space["observation"]
        assert np.isinf(space.high[-139:]).all()
        assert not space.low[-139:].any()


def pressed_on_palm(place):
    """What MuJoCo reads of a sensor at (x, y) m, or of none, under a pressed cube; and the state."""
    sensor = ""
    if place is not None:
        x, y = place
        sensor = f"""<geom type="cylinder" size="0.004 0.002" pos="{x} {y} -0.0015"/>
            <site name="taxel" type="sphere" size="0.005" pos="{x} {y} 0"/>"""
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option gravity="0 0 0" cone="elliptic"/>
        <worldbody><body name="palm"><geom type="box" size="0.03 0.03 0.01" pos="0 0 -0.01"/>{sensor}
        </body><body name="object" pos="0.01 0 0.0205"><freejoint/>
        <geom type="box" size="0.02 0.02 0.02" mass="0.04"/></body></worldbody>
        {'<sensor><touch site="taxel"/></sensor>' if sensor else ""}</mujoco>""")
    data, force = mujoco.MjData(model), np.zeros(6)
    for _ in range(2000):
        data.xfrc_applied[2, :3] = [0.0, 0.0, -0.3]
        data.qvel *= 0.98
        mujoco.mj_step(model, data)
    forces = []
    for index in range(data.ncon):
        mujoco.mj_contactForce(model, data, index, force)
        forces.append(force[0])
    figures = np.zeros(data.ncon, int), np.array(forces), np.tile([0.0, 0.0, 1.0], (data.ncon, 1))
    contacts = Contacts(data.contact.pos.copy(), *figures)
    now = states.scene(
        shape=objects.make("box", (0.04,)), object_position=data.xpos[2].copy(),
        object_rotation=data.xmat[2].reshape(3, 3), links=("palm",), contacts=contacts,
        link_positions=data.xpos[1:2].copy(), link_rotations=data.xmat[1:2].reshape(1, 3, 3).copy(),
    )  # fmt: skip
    return (data.sensordata[0] if sensor else 0.0), now


def total_force(simulator="mujoco", **choices):
    """All normal forces on the object in a scripted grasp of the MPL hand, N."""
    env = envs.make("mpl", simulator=simulator, **choices)
    start = scripted.perturbed_start(env, 0, 0)
    for _ in scripted.hold_steps(env, scripted.grasp_for(env), start, 0.3):
        pass
    return env.simulator.state().contacts.forces.sum()
