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

from ..envs import scripted
from ..envs.grasp import READS, GraspConfig, GraspEnv
from ..envs.hands import ScriptedGrasp
from ..envs.simulators import Camera, Simulator
from ..envs.vector import previously
from ..errors import InputError
from ..runs.files import MAKER, is_picture, replacing, require_ours
from .hand_map import TaxelMap, lettered, save_picture

Pose = Literal["start", "grasp"]
Follow = Literal["grasp", "hand", "nothing"]
FPS = 25  # at least: a picture stands for a whole number of timesteps
FILMS, PICTURES = (".mp4", ".mkv", ".mov"), (".png", ".jpg")
HOLD_SECONDS = 2.0  # of a hold test in a film: all there is to see in the whole
# Fragments of a second, each whole in itself: what is there can be played at any time.
PLAYABLE = ["-tune", "zerolatency", "-g", str(FPS), "-flush_packets", "1"]
PLAYABLE += ["-metadata", f"comment={MAKER}"]
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
    _writer("--out", out, PICTURES)
    with closing(GraspEnv(env_name, config, render_mode="rgb_array")) as env:
        env.reset(seed=0)
        if pose == "grasp":
            start = scripted.Offsets()
            for _ in scripted.hold_steps(env, grasp or scripted.grasp_for(env), start, seconds=0.5):
                pass
        with replacing(out, is_picture) as file:
            save_picture(_View(env, camera).picture(camera), file, out.suffix)
        return int((env.taxel_readings() > 0).sum())


class _View:
    """The scene, beside it what each taxel feels, which is hard to see in the hand's shade, and in the
    corner a word."""

    def __init__(self, env: GraspEnv, camera: Camera, label: str = "") -> None:
        self._env, self._label = env, label
        reads = env.config.touch in READS
        self._map = TaxelMap(env.hand, env.taxels, camera.height) if reads else None

    def picture(self, camera: Camera) -> np.ndarray:
        """What a camera sees now, RGB (height, width, 3) uint8."""
        found = self._env.picture(camera)
        if self._map is not None:
            found = np.hstack([found, self._map.picture(self._env.told_readings() > 0)])
        return lettered(found, [(self._label, 12, 8)], 22, "la") if self._label else found


class _Player:
    """Shows a run's policy in its own scene."""

    def __init__(
        self, run: Path, hold_seconds: float, camera: Camera, follow: Follow, label: str
    ) -> None:
        from ..runs import evaluation, policies

        config, policy, *_ = policies.read_run(run)
        if config.scene is None:
            raise InputError(
                f"{run}: found a run on {config.run.env!r}, allowed runs of grasping scenes"
            )
        self._threads, self._task = config.run.threads, evaluation.task(policy)
        scene = replace(config.scene, hold_seconds=hold_seconds)
        every = max(1, int(1 / FPS / scene.timestep + 1e-6))
        self.fps = 1 / (every * scene.timestep)
        self.env = replace(config, scene=scene).make_env(render_mode="rgb_array")
        self._view, self._camera, self._follow = _View(self.env, camera, label), camera, follow
        self._show: Callable[[], None] = lambda: None
        self.env.simulator = _Filmed(self.env.simulator, every, lambda: self._show())

    def play(self, number: int, write: Callable[[np.ndarray], None]) -> bool:
        """An episode's pictures, one after another; did it succeed?"""
        start: list[np.ndarray] = []

        def show() -> None:
            state, camera = self.env.simulator.state(), self._camera
            if self._follow != "grasp":
                palm = state.palm
                start[:] = start or [palm, (palm + state.object_position) / 2]
                moved = palm - start[0] if self._follow == "hand" else np.zeros(3)
                camera = replace(camera, lookat=tuple((start[1] + moved).tolist()))
            write(self._view.picture(camera))

        torch.set_num_threads(self._threads)  # as it was trained, to the last digit
        self._show = lambda: None
        previously(self._task, self.env, number)
        self._show = show
        played = self._task(self.env, number, lambda: True)
        for _ in range(END_PICTURES):
            show()
        return bool(played.success == 1.0)


def film(
    runs: Sequence[Path],
    episodes: int,
    hold_seconds: float,
    camera: Camera,
    follow: Follow,
    out: Path,
    tick: Callable[[], None],
) -> Iterator[list[bool]]:
    """Write a film of trained runs' policies, in real time, several side by side from the same starts;
    yields each one's success, episode by episode.

    A hold test is as long as `hold_seconds`, also for its verdict. The camera looks at what it is to
    `follow`. `tick` is called after every picture. A film that is cut off can be played as far as it
    got. InputError when a run's environment is not a grasping one.
    """
    imageio = _writer("--video", out, FILMS, "imageio_ffmpeg")
    camera = replace(camera, width=480, height=360, shadows=False)
    with ExitStack() as opened:
        players = []
        for run in runs:
            label = run.name if len(runs) > 1 else ""
            players.append(_Player(run, hold_seconds, camera, follow, label))
            opened.callback(players[-1].env.close)
        first, *others = players
        if any(other.fps != first.fps for other in others):
            raise InputError("render: found runs with different timesteps, allowed runs with the same")
        options = dict(fps=first.fps, macro_block_size=2, output_params=PLAYABLE)
        writer = opened.enter_context(imageio.get_writer(out, **options))
        for number in range(episodes):
            yield _episode(number, players, writer.append_data, tick)


def _episode(
    number: int,
    players: Sequence[_Player],
    append: Callable[[np.ndarray], None],
    tick: Callable[[], None],
) -> list[bool]:
    """The films of all beside each other; whose is shorter waits at its end. The first one's pictures
    are written as they come."""
    first, *others = players
    films: list[list[np.ndarray]] = [[] for _ in others]
    shown = [other.play(number, film.append) for other, film in zip(others, films, strict=True)]
    last, written = np.zeros(0), 0

    def write(picture: np.ndarray) -> None:
        nonlocal last, written
        append(np.hstack([picture, *(film[min(written, len(film) - 1)] for film in films)]))
        tick()
        last, written = picture, written + 1

    shown.insert(0, first.play(number, write))
    while written < max(map(len, films), default=0):
        write(last)
    return shown


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


def _writer(flag: str, out: Path, endings: tuple[str, ...], *modules: str) -> Any:
    """The extra's module, which may need `modules`; InputError where `out` cannot be written."""
    if out.suffix.lower() not in endings:
        raise InputError(f"{flag}: found {out.name!r}, allowed names that end in {', '.join(endings)}")
    if not out.parent.is_dir():
        raise InputError(f"{flag}: found no folder {out.parent}, allowed one that exists")
    require_ours(out, is_picture)
    try:
        *_, imageio = map(importlib.import_module, (*modules, "imageio.v2"))
        return imageio
    except ImportError as error:
        raise ImportError(
            "pictures need an extra that is not installed: pip install 'tactilerl[render]'"
        ) from error
