"""`tactilerl train`: flags in, run folder out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..algos import mpi
from ..errors import InputError, input_errors
from ..runs import arguments
from ..runs.config import RunConfig
from ..runs.files import pasted
from ..runs.run_dir import RunDir
from ..runs.training import train
from ..terminal import flags
from ..terminal.console import console, paragraph
from .scene import layout_notes

SETTLED_NOTE = "hold_verdict=settled decides holds early; how often it is wrong: docs/concepts/tasks.md"


def main(args: list[str]) -> int:
    """`tactilerl train`"""
    resume = flags.peek(args, "--resume", "")
    env = flags.peek(args, "--env", "")
    saved = RunDir(Path(resume)).read_config(env, "--trust" in args)[0] if resume else None
    recipe, scene = flags.peek(args, "--recipe", ""), flags.peek(args, "--scene", "")
    base = saved.with_recipe(recipe) if saved and recipe else saved
    config, options = arguments.read(args, arguments.defaults(args) if scene or base is None else base)
    for name in ("any_ranks", "trust"):
        if getattr(options, name) and not resume:
            raise InputError(f"{flags.of_field(name)}: found without --resume, allowed with it")
    if resume and any(arg.partition("=")[0] == "--out" for arg in args):
        raise InputError("--out: a resumed run stays in its folder; leave it out")
    with input_errors():
        comm = mpi.world()
        # A resumed run has its layout's own copy: the file may be gone.
        notes = layout_notes(config.run.env, config.scene.layout) if config.scene and not resume else []
        summary = _summary(config, comm.size, notes)
    path = train(config, comm, options.any_ranks, summary)
    if comm.rank == 0:
        console.print(
            f"\nThe run is in {path}: progress.csv (learning curve), checkpoint.pt, config.json.\n"
            f"  tactilerl evaluate {pasted(path)}{config.again}"
        )
    return 0


def _short(value: Any) -> str:
    """Tuples without spaces, where lines would be broken."""
    return str(value).replace(" ", "") if isinstance(value, tuple) else str(value)


def _summary(config: RunConfig, ranks: int, notes: list[str]) -> str:
    """What the run resolved to, a paragraph per part."""
    several = f"{ranks} processes" if ranks > 1 else "1 process (mpirun -n 2 tactilerl ... for two)"
    lines = [f"tactilerl train: {several}"]
    for part, values in config.as_dict().items():
        if values:
            pairs = "  ".join(f"{name}={_short(value)}" for name, value in values.items())
            lines.append(paragraph(part, pairs))
    if config.scene is not None and config.scene.hold_verdict == "settled":
        notes = [SETTLED_NOTE, *notes]
    lines += [paragraph("note", note) for note in notes]
    return "\n".join(lines)
