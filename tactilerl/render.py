"""Pictures of a scene with its taxels drawn, those that fire in yellow."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .envs import scripted
from .envs.grasp import GraspConfig, GraspEnv


def grasp_picture(env_name: str, config: GraspConfig, out: Path, seconds: float) -> int:
    """Write a picture of a scripted grasp `seconds` into its hold; how many taxels fire."""
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError(
            "pictures need an extra that is not installed: pip install 'tactilerl[render]'"
        ) from error
    env = GraspEnv(env_name, config, render_mode="rgb_array")
    try:
        n_joints = len(env.hand.joints)
        start = scripted.Start(np.zeros(2), 0.0, np.zeros(n_joints))
        for _ in scripted.hold_steps(env, scripted.grasp_for(env), start, seconds):
            pass
        picture = env.render()
        assert picture is not None
        Image.fromarray(picture).save(out)
        return int(env.taxel_readings().sum())
    finally:
        env.close()
