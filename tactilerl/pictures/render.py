"""Pictures and films of a scene with its taxels drawn, those that fire in yellow."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..envs import scripted
from ..envs.grasp import GraspConfig, GraspEnv
from ..envs.hands import Hand
from ..envs.simulators import Camera
from ..envs.state import Array
from ..errors import InputError, extra
from ..files import replacing
from ..scripted import reflexes
from .hand_map import LETTER, PAPER, TaxelMap

Pose = Literal["start", "grasp"]
Colour = tuple[int, int, int]
FPS = 25  # at least: a picture stands for a whole number of timesteps
HOLD_SECONDS = 2.0  # of a hold test in a film: all there is to see in the whole
END_PICTURES = FPS  # of the last moment, repeated: so one sees how it ended
ABOVE_GROUND = 0.01  # m, where a camera stays: through the ground all is grey
CLOSES = 4  # actions before the giver lets go at which a hand closes, and as many after
FARTHER = 1.2  # than the distance of pictures: a hand is not cut while it opens
SIDE, LINE, LETTERS = 480, 48, 26
"""Pixels of a film: height of the scene, of the line above it, and of its letters."""
RED, GREEN = (248, 180, 172), (178, 226, 178)
MAX_REACHES = 0.6  # of the hand: an object that is nearer to the palm is looked at


def picture(
    env_name: str, config: GraspConfig, pose: Pose, camera: Camera, out: Path
) -> int:
    """Write a picture of the start or of a scripted grasp; return how many taxels fire in it.

    Beside it is the hand unrolled. In a handover the hand closes around what its giver
    holds.
    """
    with extra("render"):
        from PIL import Image
    with closing(GraspEnv(env_name, config, render_mode="rgb_array")) as env:
        env.reset(seed=0)
        if pose == "grasp" and env.task.giver is not None:
            take(env)
        elif pose == "grasp":
            grasp, start = scripted.grasp_for(env), scripted.Offsets()
            for _ in scripted.hold_steps(env, grasp, start, seconds=0.5):
                pass
        image = _Artist(env, camera).draw()
        with replacing(out) as file:
            Image.fromarray(image).save(file, "PNG")
        return int((env.taxel_readings() > 0).sum())


def take(env: Any) -> None:
    """Have the hand of a handover that has just been reset close around the object."""
    [opened], [closed] = reflexes.parts(env, 1.0, np.zeros(2))
    let_go = env.task.sets_off + env.task.stays
    for step in range(let_go + CLOSES):
        env.step_to(opened if step < let_go - CLOSES else closed)


class _Artist:
    """Draw the hand of an environment, and beside it what its taxels feel, where it has taxels."""

    def __init__(self, env: GraspEnv, camera: Camera) -> None:
        self.env = env
        size = env.hand.reach / Hand.reach
        self._camera = replace(camera, distance=size * camera.distance)
        self._map: TaxelMap | None = None
        if env.config.touch != "absent":
            self._map = TaxelMap(env.hand, env.taxels, camera.height)

    def draw(self) -> Array:
        """Return an RGB picture (height, width, 3) uint8 with the hand in its middle."""
        env = self.env
        state = env.simulator.state()
        hand = (state.palm + state.fingertips.mean(axis=0)) / 2
        towards = state.object_position - hand
        share = min(1.0, MAX_REACHES * env.hand.reach / float(np.linalg.norm(towards)))
        middle = hand + share * towards / 2
        camera = self._camera
        below = np.clip((middle[2] - ABOVE_GROUND) / camera.distance, -1.0, 1.0)
        elevation = min(camera.elevation, float(np.degrees(np.arcsin(below))))
        lookat = tuple(middle.tolist())
        image = env.picture(replace(camera, elevation=elevation, lookat=lookat))
        if self._map is None:
            return image
        felt = env.taxel_readings() * (env.config.touch == "on")
        return np.hstack([image, self._map.picture(felt > 0)])


class _Player:
    """Film a run's policy in its own scene, under a line: who plays, which start, what came of it."""

    def __init__(self, run: Path, hold_seconds: float | None, camera: Camera) -> None:
        from ..runs import evaluation, policies  # import PyTorch

        config, policy, *_ = policies.read_run(run)
        if config.scene is None:
            raise InputError(
                f"{run}: found a run on {config.run.env!r}, allowed runs of grasping scenes"
            )
        if hold_seconds is not None:
            scene = replace(config.scene, hold_seconds=hold_seconds)
            config = replace(config, scene=scene)
        self.env = config.make_env(render_mode="rgb_array")
        self._task = evaluation.task(policy)
        timestep = self.env.config.timestep
        self._every = max(1, int(1 / FPS / timestep + 1e-6))
        self.fps = 1 / (self._every * timestep)
        self._name, self._number, self._since = run.name, 0, 0
        self._artist = _Artist(self.env, camera)
        self._pictures: list[Array] = []
        simulator: Any = self.env.simulator
        self._step, simulator.step = simulator.step, self._filmed_step

    def film(self, number: int) -> tuple[list[Array], bool]:
        """Return an episode's pictures, and whether it succeeds."""
        import torch

        torch.set_num_threads(1)  # as trained, to the last digit
        self._number, self._pictures = number, []
        success = self._task(self.env, number, lambda: True).success == 1.0
        self._show(*(("success", GREEN) if success else ("failure", RED)))
        return self._pictures + self._pictures[-1:] * END_PICTURES, success

    def _filmed_step(self, joint_targets: Array, n_substeps: int) -> None:
        """Do a simulator's step in portions, so that there is a picture after every few timesteps."""
        while n_substeps > 0:
            portion = min(n_substeps, self._every - self._since)
            self._step(joint_targets, portion)
            n_substeps -= portion
            self._since = (self._since + portion) % self._every
            if self._since == 0:
                self._show()

    def _show(self, outcome: str = "", colour: Colour = PAPER) -> None:
        """Add a picture, with a line above it."""
        from PIL import Image, ImageDraw

        image = self._artist.draw()
        head = Image.new("RGB", (image.shape[1], LINE), colour)
        line = f"{self._name}, start {self._number}  {outcome}"
        place = 14, LINE / 2
        ImageDraw.Draw(head).text(place, line, LETTER, font_size=LETTERS, anchor="lm")
        self._pictures.append(np.vstack([np.array(head), image]))


def film(
    runs: Sequence[Path],
    numbers: Sequence[int],
    hold_seconds: float | None,
    camera: Camera,
    out: Path,
) -> Iterator[list[bool]]:
    """Write a film of trained runs' policies, in real time, side by side from the same starts.

    Yield the success of each, episode by episode, those of `numbers`. A hold test is as
    long as `hold_seconds`, also for its verdict; None: as in the run's scene. The
    camera follows the hand. InputError when a run's environment is not a grasping one.
    """
    with extra("render"):
        import imageio.v2 as imageio
    distance = FARTHER * camera.distance
    camera = replace(camera, distance=distance, width=SIDE, height=SIDE, shadows=False)
    with ExitStack() as opened:
        players = [_Player(run, hold_seconds, camera) for run in runs]
        for player in players:
            opened.callback(player.env.close)
        fps = players[0].fps
        file: Any = opened.enter_context(replacing(out))
        writer: Any = imageio.get_writer(file, ".mp4", fps=fps, macro_block_size=2)
        opened.enter_context(writer)
        for number in numbers:
            played = [player.film(number) for player in players]
            films, successes = zip(*played, strict=True)
            for i in range(max(map(len, films))):  # a shorter film waits at its end
                images = [film[min(i, len(film) - 1)] for film in films]
                writer.append_data(np.hstack(images))
            yield [*successes]
