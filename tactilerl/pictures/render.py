"""Pictures and films of a scene with its taxels drawn, those that fire in yellow."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from ..algos.rollout import Episode
from ..envs import scripted
from ..envs.grasp import GraspConfig, GraspEnv
from ..envs.hands import ScriptedGrasp
from ..envs.simulators import Camera, Simulator
from ..envs.vector import Job
from ..errors import InputError
from ..files import MAKER, is_picture, replacing, require_ours
from ..style import ROLES
from .hand_map import PAPER, TaxelMap, lettered, save_picture

Pose = Literal["start", "grasp"]
FPS = 25  # at least: a picture stands for a whole number of timesteps
FILMS, PICTURES = (".mp4", ".mkv", ".mov"), (".png", ".jpg")
HOLD_SECONDS = 2.0  # of a hold test in a film: all there is to see in the whole
# Fragments of a second, each whole in itself: what is there can be played at any time.
PLAYABLE = ["-tune", "zerolatency", "-g", str(FPS), "-flush_packets", "1"]
PLAYABLE += ["-metadata", f"comment={MAKER}"]
PLAYABLE += ["-movflags", "frag_keyframe+empty_moov+default_base_moof"]
END_PICTURES = FPS  # of the last moment, repeated: so one sees how it ended
# Pixels: of the scene, of the lines above it and their letters, of the hand unrolled in a corner.
SIDE, LINES, LETTERS, UNROLLED = 480, 88, (40, 26), 190
RED, GREEN = (248, 180, 172), (178, 226, 178)


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
    _writer("--out", out, PICTURES, "PIL")
    with closing(GraspEnv(env_name, config, render_mode="rgb_array")) as env:
        env.reset(seed=0)
        if pose == "grasp":
            start = scripted.Offsets()
            for _ in scripted.hold_steps(
                env, grasp or scripted.grasp_for(env), start, seconds=0.5
            ):
                pass
        with replacing(out, is_picture) as file:
            save_picture(_beside(env, camera), file, out.suffix)
        return int((env.taxel_readings() > 0).sum())


def _beside(env: GraspEnv, camera: Camera) -> np.ndarray:
    """The scene, and beside it what each taxel feels, which is hard to see in the hand's shade."""
    found = env.picture(camera)
    if env.config.touch != "on":
        return found
    felt = env.taxel_readings() > 0
    drawn = TaxelMap(env.hand, env.taxels, camera.height).picture(felt)
    return np.hstack([found, drawn])


def staged(
    run: Path, hold_seconds: float = HOLD_SECONDS
) -> tuple[GraspEnv, Job[Episode[Any]], int]:
    """A run's own scene, with hold tests of so many seconds, who plays its policy there, and with how
    many threads; InputError when that is no grasping scene."""
    from ..runs import evaluation, policies

    config, policy, *_ = policies.read_run(run)
    if config.scene is None:
        raise InputError(
            f"{run}: found a run on {config.run.env!r}, allowed runs of grasping scenes"
        )
    scene = replace(config.scene, hold_seconds=hold_seconds)
    env: GraspEnv = replace(config, scene=scene).make_env(render_mode="rgb_array")
    return env, evaluation.task(policy), config.run.threads


class _Player:
    """Shows a run's policy in its own scene, with a line above: who plays, which start, what came of
    it."""

    def __init__(self, run: Path, hold_seconds: float, camera: Camera) -> None:
        self.env, self._task, self._threads = staged(run, hold_seconds)
        scene = self.env.config
        self.name, self.label = run.name, ROLES.get(scene.touch, scene.touch)
        every = max(1, int(1 / FPS / scene.timestep + 1e-6))
        self.fps = 1 / (every * scene.timestep)
        self._map = (
            TaxelMap(self.env.hand, self.env.taxels, UNROLLED)
            if scene.touch == "on"
            else None
        )
        self._camera, self._successes = camera, 0
        self._show: Callable[[], None] = lambda: None
        filmed: Any = _Filmed(self.env.simulator, every, lambda: self._show())
        self.env.simulator = filmed

    def play(
        self, number: int, tick: Callable[[], None]
    ) -> tuple[list[np.ndarray], bool]:
        """An episode's pictures; did it succeed?"""
        pictures: list[np.ndarray] = []
        beside: list[np.ndarray] = []  # where the camera looks, from the palm; m

        def show(outcome: str = "", colour: tuple[int, int, int] = PAPER) -> None:
            state = self.env.simulator.state()
            beside[:] = beside or [(state.object_position - state.palm) / 3]
            camera = replace(
                self._camera, lookat=tuple((state.palm + beside[0]).tolist())
            )
            lines = (
                f"{self.label}{outcome}",
                f"start {number + 1}, successes so far: {self._successes}",
            )
            pictures.append(self._picture(camera, lines, colour))
            tick()

        torch.set_num_threads(self._threads)  # as it was trained, to the last digit
        self._show = show
        success = bool(self._task(self.env, number, lambda: True).success == 1.0)
        self._successes += success
        show(*((": success", GREEN) if success else (": failure", RED)))
        return pictures + pictures[-1:] * END_PICTURES, success

    def _picture(
        self, camera: Camera, lines: Sequence[str], colour: Sequence[int]
    ) -> np.ndarray:
        """The scene, two lines above it, in a corner the hand unrolled, with what its taxels feel."""
        found = self.env.picture(camera)
        if self._map is not None:
            drawn = self._map.picture(self.env.taxel_readings() > 0)
            found[-drawn.shape[0] :, -drawn.shape[1] :] = drawn
        head = np.full((LINES, camera.width, 3), colour, np.uint8)
        for text, size, y in zip(lines, LETTERS, (LINES / 2, LINES - 10), strict=True):
            head = lettered(head, [(text, 14, y)], size, "ls")
        return np.vstack([head, found])


def film(
    runs: Sequence[Path],
    episodes: int,
    hold_seconds: float,
    camera: Camera,
    out: Path,
    tick: Callable[[], None],
) -> Iterator[list[bool]]:
    """Write a film of trained runs' policies, in real time, side by side from the same starts; yields
    each one's success, episode by episode.

    A hold test is as long as `hold_seconds`, also for its verdict. The camera follows the hand. `tick`
    is called after every picture. InputError when a run's environment is not a grasping one.
    """
    ffmpeg = _writer("--video", out, FILMS, "imageio_ffmpeg")
    camera = replace(camera, width=SIDE, height=SIDE, shadows=False)
    with ExitStack() as opened:
        players = [_Player(run, hold_seconds, camera) for run in runs]
        for player in players:
            opened.callback(player.env.close)
        if len({player.label for player in players}) < len(players):
            for player in players:
                player.label = player.name
        if len({player.fps for player in players}) > 1:
            raise InputError(
                "render: found runs with different timesteps, allowed runs with the same"
            )
        size = SIDE * len(runs), SIDE + LINES
        options = {
            "fps": players[0].fps,
            "macro_block_size": 2,
            "output_params": PLAYABLE,
        }
        writer = ffmpeg.write_frames(out, size, **options)
        opened.enter_context(closing(writer)).send(None)
        for number in range(episodes):
            films, successes = zip(
                *(player.play(number, tick) for player in players), strict=True
            )
            for index in range(
                max(map(len, films))
            ):  # whose film is shorter waits at its end
                beside = np.hstack([film[min(index, len(film) - 1)] for film in films])
                writer.send(np.ascontiguousarray(beside))
            yield [*successes]


class _Filmed:
    """A simulator that calls `show` after every `every` timesteps."""

    def __init__(
        self, simulator: Simulator, every: int, show: Callable[[], None]
    ) -> None:
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


def _writer(flag: str, out: Path, endings: tuple[str, ...], module: str) -> Any:
    """The extra's module that writes it; InputError where `out` cannot be written."""
    if out.suffix.lower() not in endings:
        raise InputError(
            f"{flag}: found {out.name!r}, allowed names that end in {', '.join(endings)}"
        )
    if not out.parent.is_dir():
        raise InputError(
            f"{flag}: found no folder {out.parent}, allowed one that exists"
        )
    require_ours(out, is_picture)
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            "pictures need an extra that is not installed: pip install 'tactilerl[render]'"
        ) from error
