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
from ..envs.grasp import GraspConfig, GraspEnv
from ..envs.hands import ScriptedGrasp
from ..envs.simulators import Camera, Simulator
from ..errors import InputError
from .hand_map import TaxelMap, lettered

Pose = Literal["start", "grasp"]
Follow = Literal["grasp", "hand", "nothing"]
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
        self._threads = config.run.threads
        scene = replace(config.scene, hold_seconds=hold_seconds)
        every = max(1, int(1 / FPS / scene.timestep + 1e-6))
        self.fps = 1 / (every * scene.timestep)
        self.env = replace(config, scene=scene).make_env(render_mode="rgb_array")
        self._task, self._label = evaluation.task(policy), label
        self._camera, self._follow = camera, follow
        self._map = _map_of(self.env, camera)
        self._show: Callable[[], None] = lambda: None
        self.env.simulator = _Filmed(self.env.simulator, every, lambda: self._show())

    def play(self, number: int, write: Callable[[np.ndarray], None]) -> bool:
        """An episode's pictures, one after another; did it succeed?"""
        start: list[np.ndarray] = []

        def show() -> None:
            simulator, camera = self.env.simulator, self._camera
            if self._follow != "grasp":
                palm = simulator.link_positions()[0]
                start[:] = start or [palm, (palm + simulator.object_state().position) / 2]
                moved = palm - start[0] if self._follow == "hand" else np.zeros(3)
                camera = replace(camera, lookat=tuple((start[1] + moved).tolist()))
            write(_labelled(_with_map(self.env, camera, self._map), self._label))

        self._show = show
        torch.set_num_threads(self._threads)  # as it was trained, to the last digit
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
    _require_writable("--video", out, FILMS)
    imageio = _imageio("imageio.v2", "imageio_ffmpeg")
    camera = replace(camera, width=480, height=360, shadows=False)
    with ExitStack() as opened:
        players = []
        for run in runs:
            label = run.name if len(runs) > 1 else ""
            players.append(_Player(run, hold_seconds, camera, follow, label))
            opened.callback(players[-1].env.close)
        first, *others = players
        if any(other.fps != first.fps for other in others):
            raise InputError("render: found runs of several timesteps, allowed runs of the same one")
        options = dict(fps=first.fps, macro_block_size=2, output_params=PLAYABLE)
        writer = opened.enter_context(imageio.get_writer(out, **options))
        for number in range(episodes):
            row = _Row(len(others), writer.append_data, tick)
            shown = [
                other.play(number, pictures.append)
                for other, pictures in zip(others, row.beside, strict=True)
            ]
            shown.insert(0, first.play(number, row.write))
            row.finish()
            yield shown


class _Row:
    """Pictures beside those of films that are there already; the shorter film waits at its end."""

    def __init__(
        self, n_beside: int, write: Callable[[np.ndarray], None], tick: Callable[[], None]
    ) -> None:
        self.beside: list[list[np.ndarray]] = [[] for _ in range(n_beside)]
        self._write, self._tick, self._written, self._last = write, tick, 0, np.zeros(0)

    def write(self, picture: np.ndarray) -> None:
        """The next moment."""
        others = (film[min(self._written, len(film) - 1)] for film in self.beside)
        self._write(np.hstack([picture, *others]))
        self._tick()
        self._last, self._written = picture, self._written + 1

    def finish(self) -> None:
        """What the others show after the end."""
        while self._written < max(map(len, self.beside), default=0):
            self.write(self._last)


def _labelled(picture: np.ndarray, label: str) -> np.ndarray:
    """With a word in its corner."""
    return lettered(picture, [(label, 12, 8)], 22, "la") if label else picture


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
