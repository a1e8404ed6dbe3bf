"""A soft skin gives way as a silicone pad does, whatever it touches, and never adds energy."""

import numpy as np
import pytest
from benchmarks.physics import softness
from tactilerl import envs
from tactilerl.envs.grasp import GraspEnv, setup

SKIN = softness.SKINS["Dragon Skin 10, 3 mm"]


@pytest.mark.parametrize("name", list(softness.SKINS)[1:])
def test_a_fingertip_sinks_in_as_far_as_finite_elements_say(name):
    skin = softness.SKINS[name]
    law = [softness.depth(force, **skin) for force in softness.FORCES]
    light, heavy = (softness.pressed(mass, **skin) for mass in (0.02, 0.1))
    np.testing.assert_allclose(heavy, law, rtol=0.1)
    np.testing.assert_allclose(light, heavy, rtol=0.02)


def test_the_law_is_hertzs_in_a_thick_pad():
    """F = 16/9 E R^0.5 d^1.5 where nothing is felt of the base."""
    assert softness.law(1e-7, 0.004, 1e5) == pytest.approx(
        16 / 9 * 1e5 * 0.008**0.5 * 1e-7**1.5, rel=0.02
    )


@pytest.mark.parametrize("timestep", [0.25, 1, 4])
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
    shipped = setup("mpl")
    slow = {"timestep": 4 * shipped.timestep, "control_dt": 8 * shipped.timestep}
    config = setup("mpl", simulator="mujoco", **choices, **slow, **SKIN)
    env, rng = GraspEnv("mpl", config), np.random.default_rng(0)
    for seed in range(2):
        env.reset(seed=seed)
        for _ in range(15):
            *_, info = env.step(rng.choice([-1.0, 1.0], 7))
            assert not info["diverged"], info["error"]
            assert not info["warnings"]


@pytest.mark.parametrize(
    ("choices", "error"),
    [
        ({"skin_thickness": 0.001}, r"skin_thickness: found 0.001, allowed \[0.002, 0.004\]"),
        ({"skin_modulus": 5e4}, "skin_modulus: found 50000.0, allowed only with skin_thickness"),
        (
            {"skin_thickness": 0.003, "simulator": "pybullet"},
            "skin_thickness: found 0.003, allowed only with",
        ),
        (
            {"object": "ellipsoid", "simulator": "pybullet"},
            "object: found ellipsoid, allowed only with",
        ),
        (
            {"object": "mug.stl"},
            "object: found 'mug.stl', allowed: box, sphere, cylinder, capsule, ellipsoid",
        ),
        (
            {"object": "capsule", "object_size": (0.03, 0.03, 0.05)},
            "found 3 numbers, allowed for a capsule",
        ),
    ],
)
def test_what_a_skin_and_an_object_cannot_be(choices, error):
    with pytest.raises(ValueError, match=error):
        envs.make("mpl", **{"simulator": "mujoco", **choices})
