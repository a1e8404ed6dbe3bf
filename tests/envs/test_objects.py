"""Objects that differ between episodes: drawn, told, and simulated as if compiled for them. A soft skin
gives way as a silicone pad does, whatever it touches, and never adds energy."""

import numpy as np
import pytest
from benchmarks.physics import softness
from tactilerl import envs
from tactilerl.envs.grasp import setup
from tactilerl.envs.objects import make

from states import closing

VARIED = {
    "object_size": "0.025..0.033",  # capsules are half as long again
    "object_density": "400..800",
    "friction": "0.5..1",
}
SOLIDS = {"mujoco": "box,sphere,cylinder,capsule,ellipsoid", "pybullet": "box,sphere,cylinder,capsule"}
SKIN = softness.SKINS["Dragon Skin 10, 3 mm"]
BOTH = [("shadow", "mujoco"), ("mpl", "pybullet")]


def rollout(env, seed):
    """What is observed while a hand closes, and the last info."""
    seen, _, info = closing(env, seed, 6)
    return [obs["observation"] for obs in seen], info


@pytest.mark.parametrize(
    ("hand", "simulator", "skin"),
    [("mpl", "mujoco", SKIN), pytest.param("mpl", "pybullet", {}, marks=pytest.mark.slow)],
)
def test_an_episode_is_that_of_an_environment_made_for_its_object(hand, simulator, skin):
    """Bit for bit, whatever was in the scene before."""
    choices = dict(simulator=simulator, task="reach-goal", max_episode_steps=6, layout="1", **skin)
    varied = envs.make(hand, **choices, **VARIED, object=SOLIDS[simulator])
    kinds = set()
    for seed in range(12):
        told = varied.reset(seed=seed)[1]["object"]
        kinds.add(told["kind"])
        seen, info = rollout(varied, seed)
        assert info["object"] == told
        size = told["size"][1:] if told["kind"] == "cylinder" else told["size"][1:2]
        alike = envs.make(
            hand, **choices, object=told["kind"], object_size=tuple(size),
            object_density=told["density"], friction=told["friction"],
        )  # fmt: skip
        assert alike.reset(seed=seed)[1]["object"] == told
        np.testing.assert_array_equal(seen, rollout(alike, seed)[0])
    assert kinds == {*SOLIDS[simulator].split(",")}


@pytest.mark.parametrize(("hand", "simulator"), BOTH)
def test_objects_are_drawn_within_what_was_asked_for_and_starts_stay(hand, simulator):
    varied = envs.make(hand, simulator=simulator, **VARIED, object=SOLIDS[simulator])
    seen = [varied.reset(seed=seed)[1]["object"] for seed in range(40)]
    assert varied.reset(seed=7)[1]["object"] == seen[7]
    assert {item["kind"] for item in seen} == {*SOLIDS[simulator].split(",")}
    for name, low, high in (("density", 400, 800), ("friction", 0.5, 1)):
        values = [item[name] for item in seen]
        assert low <= min(values) < low + 0.2 * (high - low) < high - 0.2 * (high - low) < max(values)
    edges = np.array([item["size"][1:] for item in seen])
    assert 0.025 <= edges.min() < 0.026 < 0.032 < edges.max() <= 0.033
    for item in seen:
        shape = make(item["kind"], tuple(item["size"][1:2]))
        assert item["mass"] == pytest.approx(item["density"] * shape.volume)
    varied.reset(seed=3)
    height = varied.simulator.state().object_position[2]
    assert height == pytest.approx(seen[3]["size"][2] / 2)


@pytest.mark.parametrize(("hand", "simulator"), BOTH)
def test_starts_further_off_are_drawn_and_free_of_the_hand(hand, simulator):
    env = envs.make(hand, simulator=simulator, start_offset=0.02, start_yaw=1.5)
    places = []
    for seed in range(30):
        env.reset(seed=seed)
        assert not len(env.simulator.state().contacts.links)
        turn = env.state.object_rotation
        places.append([*env.state.object_position[:2], np.arctan2(turn[1, 0], turn[0, 0])])
        env.simulator.step(env.state.targets, 5)
        assert np.abs(env.simulator.state().object_velocity).max() < 0.05
    reached = np.abs(places).max(axis=0)
    assert (reached <= [0.02, 0.02, 1.5]).all()
    assert (reached > [0.015, 0.015, 1.2]).all()


@pytest.mark.parametrize(
    ("name", "mass"), [("Ecoflex 00-30, 3 mm", 0.1), ("Dragon Skin 10, 3 mm", 0.02)]
)
def test_a_fingertip_sinks_in_as_far_as_finite_elements_say(name, mass):
    skin = softness.SKINS[name]
    law = [softness.depth(force, **skin) for force in softness.FORCES]
    np.testing.assert_allclose(softness.pressed(mass, **skin), law, rtol=0.1)


@pytest.mark.parametrize("timestep", [0.25, 4])
@pytest.mark.parametrize("mass", [0.001, 0.1])
def test_a_sphere_leaves_the_palm_slower_than_it_came(mass, timestep):
    stiff = {"skin_thickness": 0.004, "skin_modulus": 1e6}
    for skin in (SKIN, stiff):
        assert softness.rebound(mass, timestep, **skin) < 0.9


@pytest.mark.parametrize("object_size", [(0.08, 0.08, 0.002), (0.004, 0.08, 0.1), 0.08, 0.01])
@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
def test_thin_and_large_objects_do_not_break_the_physics(kind, object_size):
    """Jerked at a timestep four times as long."""
    choices = dict(object=kind, object_size=object_size, task="reach-goal", max_episode_steps=15)
    timestep = setup("mpl").timestep
    slow = {"timestep": 4 * timestep, "control_dt": 8 * timestep, "simulator": "mujoco"}
    env, rng = envs.make("mpl", **choices, **slow, **SKIN), np.random.default_rng(0)
    env.reset(seed=0)
    for _ in range(15):
        *_, info = env.step(rng.choice([-1.0, 1.0], 7))
        assert not info["diverged"], info["error"]
        assert not info["warnings"]
