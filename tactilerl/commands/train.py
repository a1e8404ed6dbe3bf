"""`tactilerl train`: flags in, run folder out."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import gymnasium as gym

from ..algos import mpi
from ..envs import TOYS, hands
from ..envs.validation import nearest
from ..errors import input_errors
from ..files import pasted
from ..runs.config import RunConfig
from ..runs.store import resolve
from ..runs.training import train
from ..terminal import flags
from ..terminal.console import console, paragraph
from .scene import SceneFlag, layout_notes, require_hand, sensor_notes

ABOUT = """\
Train a policy. --scene, --algo, --env and --recipe decide which other flags exist, and their
defaults. Without a scene and a recipe, these are the paper's.

examples:
  tactilerl train --scene handover
  tactilerl train --scene handover --touch off
  tactilerl train --algo ddpg_her --layout 4 --total-timesteps 26000
  tactilerl train --resume runs/X --total-timesteps 1000000"""
ALWAYS_SHOWN = {"algo", "env", "layout", "touch", "task", "total_timesteps", "seed"}


@dataclass(frozen=True)
class TrainFlags(SceneFlag):
    """Flags that set the defaults of the other flags."""

    recipe: str = ""
    """A set of hyperparameters (paper, steady, ...); default: the scene's, or paper."""
    resume: str = ""
    """Folder of a run to continue from its last full epoch."""


def main(args: list[str]) -> int:
    """Run `tactilerl train`."""
    given = flags.peek(args, "algo", "env", "recipe", "scene", "resume", "out")
    if nearest(given["env"], hands.HANDS):  # its flags would all be unknown
        require_hand(given["env"], *TOYS, *gym.registry)
    usual = resolve(**given)
    parts = {"start": TrainFlags(), **usual.parts}
    read = vars(flags.parse_parts(parts, args, "tactilerl train", ABOUT))
    config = dataclasses.replace(usual, **{name: read[name] for name in usual.parts})
    notes = []
    with input_errors():
        comm = mpi.world()
        if config.scene and not given["resume"]:  # its layout's file may be gone
            notes = layout_notes(config.run.env, config.scene.layout)
            notes += sensor_notes(config.run.env, config.scene)
    path = train(config, comm, _summary(config, usual, comm.size, notes))
    if comm.rank == 0:
        lines = [
            f"\nThe run is in {path}: progress.csv (learning curve), checkpoint.pt, config.json (all "
            "settings).",
            f"  tactilerl evaluate {pasted(path)}{config.again}",
        ]
        if config.scene:
            film = f"tactilerl render {pasted(path)} --video film.mp4{config.again}"
            lines.append(f"  {film}")
        console.print("\n".join(lines))
    return 0


def _summary(config: RunConfig, usual: RunConfig, ranks: int, notes: list[str]) -> str:
    """Return a paragraph for each part: what matters first, and what is not as usual."""
    lines = [f"tactilerl train: {ranks} process{'es' if ranks > 1 else ''}"]
    before = usual.as_dict()
    for part, values in config.as_dict().items():
        pairs = "  ".join(
            f"{name}={value}".replace(", ", ",")  # tuples stay on one line
            for name, value in (values or {}).items()
            if name in ALWAYS_SHOWN or value != before[part][name]
        )
        if pairs:
            lines.append(paragraph(part, pairs))
    lines += [paragraph("note", note) for note in notes]
    return "\n".join(lines)
