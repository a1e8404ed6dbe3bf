"""Layouts as MuJoCo's own tactile sensors, which also judge the skin rule."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from tactilerl.envs import hands, layouts, objects, touch

import states
import tactile_sensors

GRIPPER = str(Path(__file__).parents[1] / "hands" / "gripper.toml")
BALL, DEEP = 0.03, 1e-4  # m: radius, and how far it is in the hand


def pressed(hand, taxels, kind, half, gap=-DEEP):
    """For each taxel, in turn in the middle of where an object presses, or is a gap away (m): what the
    sensors say, and what the rule says."""
    spec = tactile_sensors.spec(hand, taxels)
    body = spec.worldbody.add_body(name="thing", mocap=True)
    geom = mujoco.mjtGeom.mjGEOM_SPHERE if kind == "sphere" else mujoco.mjtGeom.mjGEOM_BOX
    body.add_geom(name="thing", type=geom, size=half)
    model = spec.compile()
    data, rule = mujoco.MjData(model), touch.SkinTouch(taxels, hand)
    mujoco.mj_kinematics(model, data)
    links = [data.body(link) for link in taxels.links]
    positions = np.array([link.xpos for link in links])
    rotations = np.array([link.xmat.reshape(3, 3) for link in links])
    shape = objects.Shape(kind, half)
    for index, link in enumerate(taxels.link_index):
        place = positions[link] + rotations[link] @ taxels.positions[index]
        normal = rotations[link] @ taxels.normals[index]
        turn = np.eye(3)
        if kind == "box":  # its face on the taxel
            turn = np.linalg.svd(normal[None])[2].T[:, [1, 2, 0]]
            turn *= np.sign(np.linalg.det(turn))
        at = place + (half[2] + gap) * normal
        data.mocap_pos[0] = at
        mujoco.mju_mat2Quat(data.mocap_quat[0], turn.ravel())
        mujoco.mj_forward(model, data)
        felt = np.zeros(len(taxels))
        for number, name in enumerate(taxels.links):
            own = taxels.link_index == number
            felt[own] = data.sensor(tactile_sensors.NAME + name).data[: own.sum()]
        state = states.scene(
            shape=shape, object_position=at, object_rotation=turn, links=taxels.links,
            link_positions=positions, link_rotations=rotations,
        )  # fmt: skip
        yield index, felt > 0, rule.read(state)


@pytest.mark.parametrize(("kind", "half"), [("sphere", (BALL,) * 3), ("box", (0.02, 0.015, 0.01))])
@pytest.mark.parametrize("name", ["shadow", GRIPPER])
def test_the_skin_rule_is_what_mujocos_sensor_says(name, kind, half):
    """A taxel of which a point of its sphere is in the object, and whose link touches that."""
    hand = hands.get(name)
    taxels = layouts.load("1").place(hand)
    taxels = taxels.take(range(0, len(taxels), 2))
    alike, felt = [], 0
    for index, sensor, rule in pressed(hand, taxels, kind, half):
        assert sensor[index]
        assert rule[index]
        assert not (sensor & ~rule).any()
        alike.append(sensor == rule)
        felt += sensor.sum()
    assert felt > 1.5 * len(taxels)  # neighbours too
    assert np.mean(alike) > 0.97


@pytest.mark.parametrize(("gap", "on"), [(touch.SKIN - 1e-4, True), (touch.SKIN + 1e-4, False)])
def test_boxes_and_hulls_feel_what_is_within_their_skin(gap, on):
    hand = hands.get(GRIPPER)
    taxels = layouts.load("5").place(hand)
    for index, _, rule in pressed(hand, taxels, "box", (0.02,) * 3, gap):
        assert rule[index] == on, taxels.names[index]
