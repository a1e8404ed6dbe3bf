"""Pictures and films of a scene with its taxels drawn, those that fire in yellow."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from .envs import scripted
from .envs.grasp import GraspConfig, GraspEnv
from .envs.hands import ScriptedGrasp
from .envs.simulators import Camera, Simulator
from .errors import InputError
from .hand_map import TaxelMap
from .run_dir import RunDir

Pose = Literal["start", "grasp"]
FPS = 25  # at least: a picture stands for a whole number of timesteps
FILMS, PICTURES = (".mp4", ".mkv", ".mov"), (".png", ".jpg")
HOLD_SECONDS = 2.0  # of a hold test in a film: all there is to see in the whole
# Fragments of a second, each whole in itself: what is there can be played at any time.
PLAYABLE = ["-tune", "zerolatency", "-g", str(FPS), "-flush_packets", "1"]
PLAYABLE += ["-movflags", "frag_keyframe+empty_moov+default_base_moof"]
END_PICTURES = FPS // 2  # of the last moment, repeated: so one sees how it ended


def picture(
    env_name: str,
    config: GraspConfig,
    pose: Pose,
    camera: Camera,
    out: Path,
    grasp: ScriptedGrasp | None = None,
) -> int:
    """Write a picture of the start or of a scripted grasp (`grasp`: instead of the hand's own), beside
    it the hand unrolled; how many taxels fire in it."""
    _require_writable("--out", out, PICTURES)
    imageio = _imageio("imageio.v2")
    env = GraspEnv(env_name, config, render_mode="rgb_array")
    with closing(env):
        env.reset(seed=0)
        if pose == "grasp":
            start = scripted.Start(np.zeros(2), 0.0, np.zeros(len(env.hand.joints)))
            for _ in scripted.hold_steps(env, grasp or scripted.grasp_for(env), start, seconds=0.5):
                pass
        imageio.imwrite(out, _with_map(env, camera, _map_of(env, camera)))
        return int((env.taxel_readings() > 0).sum())


def film(
    run: Path, episodes: int, hold_seconds: float, camera: Camera, out: Path, tick: Callable[[], None]
) -> Iterator[bool]:
    """Write a film of a trained run's policy, in real time; yields the success of each episode.

    A hold test is as long as `hold_seconds`, also for its verdict. `tick` is called after every
    picture. A film that is cut off can be played as far as it got. InputError when the run's
    environment is not a grasping one.
    """
    from . import evaluation, policies

    _require_writable("--video", out, FILMS)
    imageio = _imageio("imageio.v2", "imageio_ffmpeg")
    saved, _ = RunDir(run).read_config()
    if saved.scene is None:
        raise InputError(f"{run}: found a run on {saved.run.env!r}, allowed one of a grasping scene")
    config, policy, *_ = policies.read_run(run)
    torch.set_num_threads(config.run.threads)  # as it was trained, to the last digit
    assert config.scene is not None
    config = replace(config, scene=replace(config.scene, hold_seconds=hold_seconds))
    assert config.scene is not None
    camera = replace(camera, width=480, height=360, shadows=False)
    every = max(1, int(1 / FPS / config.scene.timestep + 1e-6))
    fps = 1 / (every * config.scene.timestep)
    options = dict(fps=fps, macro_block_size=2, output_params=PLAYABLE)
    env = config.make_env(render_mode="rgb_array")
    taxel_map = _map_of(env, camera)
    with closing(env), imageio.get_writer(out, **options) as writer:

        def show() -> None:
            writer.append_data(_with_map(env, camera, taxel_map))
            tick()

        env.simulator = _Filmed(env.simulator, every, show)
        play = evaluation.task(policy)
        for number in range(episodes):
            played = play(env, number, lambda: True)
            for _ in range(END_PICTURES):
                show()
            yield played.success == 1.0


def _map_of(env: GraspEnv, camera: Camera) -> TaxelMap | None:
    """As high as the camera's pictures; None where nothing is felt."""
    feels = env.config.run_type == "main"
    return TaxelMap(env.hand, env.taxels, camera.height) if feels else None


def _with_map(env: GraspEnv, camera: Camera, taxel_map: TaxelMap | None) -> np.ndarray:
    """The scene, and beside it what each taxel feels: in the hand's shade they are hard to see."""
    picture = env.picture(camera)
    if taxel_map is None:
        return picture
    return np.hstack([picture, taxel_map.picture(env.taxel_readings() > 0)])


def _require_writable(flag: str, out: Path, endings: tuple[str, ...]) -> None:
    if out.suffix.lower() not in endings:
        raise InputError(f"{flag}: found {out.name!r}, allowed names that end in {', '.join(endings)}")
    if not out.parent.is_dir():
        raise InputError(f"{flag}: found no folder {out.parent}, allowed one that exists")


class _Filmed:
    """A simulator that calls `show` after every `every` timesteps."""

    def __init__(self, simulator: Simulator, every: int, show: Callable[[], None]) -> None:
        self._inner, self._every, self._show = simulator, every, show
        self._since = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def step(self, joint_targets: np.ndarray, n_substeps: int) -> None:
        """The same steps in smaller portions."""
        while n_substeps > 0:
            portion = min(n_substeps, self._every - self._since)
            self._inner.step(joint_targets, portion)
            n_substeps -= portion
            self._since = (self._since + portion) % self._every
            if self._since == 0:
                self._show()


def _imageio(*modules: str) -> Any:
    """The extra's modules, once all are found: the first."""
    try:
        first, *_ = [importlib.import_module(module) for module in modules]
        return first
    except ImportError as error:
        raise ImportError(
            "pictures need an extra that is not installed: pip install 'tactilerl[render]'"
        ) from error
