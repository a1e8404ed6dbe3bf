"""A soft skin gives way as a silicone pad does, whatever it touches, and never adds energy."""

import numpy as np
import pytest
from benchmarks.physics import softness
from tactilerl import envs
from tactilerl.envs.grasp import setup

SKIN = softness.SKINS["Dragon Skin 10, 3 mm"]


@pytest.mark.parametrize("name", list(softness.SKINS)[1:])
def test_a_fingertip_sinks_in_as_far_as_finite_elements_say(name):
    skin = softness.SKINS[name]
    law = [softness.depth(force, **skin) for force in softness.FORCES]
    light, heavy = (softness.pressed(mass, **skin) for mass in (0.02, 0.1))
    np.testing.assert_allclose(heavy, law, rtol=0.1)
    np.testing.assert_allclose(light, heavy, rtol=0.02)


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
