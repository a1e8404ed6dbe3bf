"""Pictures of a scene with its taxels drawn, those that fire in yellow."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from .envs import scripted
from .envs.grasp import GraspConfig, GraspEnv
from .envs.simulators import Camera

Pose = Literal["start", "grasp"]


def picture(env_name: str, config: GraspConfig, pose: Pose, camera: Camera, out: Path) -> int:
    """Write a picture of the start or of a scripted grasp; how many taxels fire in it."""
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError(
            "pictures need an extra that is not installed: pip install 'tactilerl[render]'"
        ) from error
    env = GraspEnv(env_name, config, render_mode="rgb_array")
    try:
        env.reset(seed=0)
        if pose == "grasp":
            start = scripted.Start(np.zeros(2), 0.0, np.zeros(len(env.hand.joints)))
            for _ in scripted.hold_steps(env, scripted.grasp_for(env), start, seconds=0.5):
                pass
        Image.fromarray(env.picture(camera)).save(out)
        return int(env.taxel_readings().sum())
    finally:
        env.close()
