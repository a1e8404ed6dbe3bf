"""The skin rule against distances known by construction."""

import dataclasses
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tactilerl import envs
from tactilerl.envs import hands, layouts, objects, scripted, touch
from tactilerl.envs.hands import Surface
from tactilerl.envs.state import Contacts, State
from tactilerl.envs.taxel_files import Point


def state(taxels, link_poses, shape, position, rotation):
    """An object, and the links of taxels with their positions and rotations."""
    return State(shape, np.array(position), np.array(rotation), taxels.links, *link_poses)


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
    """What taxels `rows` m along a surface feel, their link turned anyhow in the world, the object as
    seen from it."""
    turn, place = Rotation.random(rng=3).as_matrix(), np.array([0.3, 0.1, 0.2])
    taxels, rule = rule_at([surface], [(0, row) for row in rows])
    moved = turn @ np.array(position) + place, turn @ rotation
    return rule.read(state(taxels, (place[None], turn[None]), shape, *moved)).tolist()


@pytest.mark.parametrize("surface", [PHALANX, PALM])
@pytest.mark.parametrize(("gap", "on"), [(-5e-4, True), (4e-4, True), (6e-4, False), (1.4e-3, False)])
def test_a_taxel_feels_what_touches_its_skin_and_not_what_is_only_near(surface, gap, on):
    """A cube with its face to the palmar side; taxels in the middle of it and 5 mm beyond."""
    y = -(surface.radius or 0.0) - gap - 0.02
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
    sizes = {"box": (0.02, 0.04, 0.06), "sphere": (0.04,), "cylinder": (0.04, 0.06)}
    shape = objects.make(request.param, sizes[request.param])
    points = np.random.default_rng(0).uniform(-1, 1, (200_000, 3)) * shape.half_size
    return shape, points[shape.squared_distance(points) == 0]


def test_volume_is_that_of_the_points_inside(solid):
    shape, inside = solid
    share = len(inside) / 200_000
    assert share * np.prod(shape.half_size) * 8 == pytest.approx(shape.volume, rel=0.01)


def test_distance_to_a_shape_is_that_to_the_nearest_of_many_points_inside(solid):
    """Up to the gaps between them."""
    shape, inside = solid
    for point in np.random.default_rng(1).uniform(-0.08, 0.08, (20, 3)):
        nearest = np.linalg.norm(inside - point, axis=1).min()
        distance = np.sqrt(shape.squared_distance(point[None])[0])
        assert distance <= nearest + 1e-12
        assert nearest - distance < 3e-3


def test_half_height_is_that_of_the_lowest_point(solid):
    shape, inside = solid
    for turn in Rotation.random(5, rng=2):
        rotation = turn.as_matrix()
        lowest = -(inside @ rotation.T)[:, 2].min()
        assert lowest <= shape.half_height(rotation) + 1e-12
        assert shape.half_height(rotation) - lowest < 3e-3


class TestForce:
    """Rule "force": what the object is pressed with, shared and felt once."""

    @pytest.mark.parametrize("hand", ["shadow", "mpl"])
    def test_taxels_that_touch_share_the_forces_on_their_links(self, hand, simulator):
        env, skin = (
            envs.make(hand, simulator=simulator, layout="1", touch_rule=rule)
            for rule in ("force", "skin")
        )
        starts = scripted.perturbed_starts(env, 0, 1)
        n_felt = 0
        for _ in scripted.hold_steps(env, scripted.grasp_for(env), next(starts), 0.3):
            force = env.taxel_readings()
            now = env.simulator.state()
            on, contacts = skin._touch.read(now), now.contacts
            links = np.array(env.taxels.links)[env.taxels.link_index]
            assert (on[force > 0]).all()
            for link in set(links):
                pressed = contacts.forces[contacts.links == now.links.index(link)].sum()
                expected = pressed if on[links == link].any() else 0.0
                assert force[links == link].sum() == pytest.approx(expected, rel=1e-6)
                n_felt += expected > 0
        assert n_felt >= 4

    def test_the_near_taxel_takes_more(self):
        env = envs.make("shadow", simulator="mujoco", layout="2", touch_rule="force")
        now, mine = env.simulator.state(), np.flatnonzero(env.taxels.link_index == 0)
        at = touch.taxel_points(env.taxels).world(now)[mine]
        link = now.links.index(env.taxels.links[0])
        around = dataclasses.replace(
            now, shape=objects.make("box", (0.3,)), object_position=at.mean(axis=0),
            contacts=Contacts(at[:1], np.array([link]), np.array([2.0])),
        )  # fmt: skip
        force = env._touch.read(around)
        assert force.sum() == pytest.approx(2.0)
        assert not np.delete(force, mine).any()
        assert np.argmax(force) == mine[0]
        assert (force[mine] > 0).all()

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


def total_force(simulator="mujoco", **choices):
    """All normal forces on the object in a scripted grasp of the MPL hand, N."""
    env = envs.make("mpl", simulator=simulator, **choices)
    start = next(iter(scripted.perturbed_starts(env, 0, 1)))
    for _ in scripted.hold_steps(env, scripted.grasp_for(env), start, 0.3):
        pass
    force = env.simulator.state().contacts.forces.sum()
    return force
