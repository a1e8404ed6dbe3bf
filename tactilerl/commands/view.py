"""`tactilerl view`: a hand or a trained run in MuJoCo's own viewer."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro

from ..envs.grasp import GraspConfig, GraspEnv, setup
from ..envs.simulators import SimulationError
from ..envs.vector import LocalPlayer
from ..errors import InputError, input_errors
from ..pictures.render import staged
from ..terminal import flags
from ..terminal.console import console
from ..terminal.help import About
from .scene import read_scene

ABOUT = About(
    "Watch a hand or a trained run in MuJoCo's viewer. Taxels that fire light up.",
    first=("layout", "touch_rule", "object"),
    examples=(
        "tactilerl view examples/policies/handover_touch --speed 0.25",
        "tactilerl view --env shadow --layout 1",
    ),
)
KEYS = "space pauses, - and = change the speed; drag the object with Ctrl and the right mouse button"


@dataclass(frozen=True)
class ViewFlags:
    """Flags of `tactilerl view`, besides the scene's."""

    run: tyro.conf.Positional[str] = ""
    """Run folder whose policy is played in the run's own scene, with hold tests of 2 s. Without one, a
    hand waits open."""
    env: str = "shadow"
    """The hand."""
    speed: Annotated[float, "[0.015625, 1]"] = 1.0
    """Speed of the scene's time; 1: real time."""


def main(args: list[str]) -> int:
    """`tactilerl view RUN`, `tactilerl view --env HAND`"""
    read, scene = read_scene(ViewFlags, args, "tactilerl view", ABOUT)
    if not read.run:
        env, play = _waiting(read.env, scene)
    elif flags.peek(args, "--scene", "") or scene != setup(read.env):
        raise InputError(
            "view RUN: found scene flags, allowed none: a run keeps its scene"
        )
    else:
        env, play = _playing(Path(read.run))
    from ..envs.simulators.viewer import ClosedError, Viewed  # imports the viewer

    with closing(env):
        if (found := env.config.simulator) != "mujoco":
            raise InputError(
                f"view: found the simulator {found}, allowed mujoco, whose viewer it is"
            )
        simulator: Any = env.simulator
        try:
            viewed = Viewed(simulator, env.spheres, read.speed)
        except OSError as error:
            raise InputError(f"view: {error}") from error
        env.simulator = viewed  # type: ignore[assignment]
        console.print(KEYS)
        with suppress(ClosedError):
            for number in itertools.count():
                play(number)
    return 0


def _waiting(hand: str, scene: GraspConfig) -> tuple[GraspEnv, Callable[[int], None]]:
    """A hand that stays open, in an episode without end."""
    with input_errors():
        env = GraspEnv(hand, scene, render_mode="rgb_array")

    def play(number: int) -> None:
        env.reset(seed=number)
        targets = env.hand.start_targets()
        with suppress(SimulationError):  # pulled too hard: it begins anew
            for step in itertools.count(1):
                env.task.before_step(env.simulator, step)
                env.simulator.step(targets, env.config.n_substeps)

    return env, play


def _playing(run: Path) -> tuple[GraspEnv, Callable[[int], Any]]:
    """The policy of a run, in the episodes that `evaluate` plays."""
    env, task, _ = staged(run)
    return env, partial(LocalPlayer(env).play, task, is_wanted=lambda: True)
