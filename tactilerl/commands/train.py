"""`tactilerl train`: flags in, run folder out."""

from __future__ import annotations

from ..algos import mpi
from ..errors import InputError, input_errors
from ..files import pasted
from ..runs import arguments
from ..runs.config import RunConfig
from ..runs.training import train
from ..terminal import flags
from ..terminal.console import console, paragraph
from .scene import layout_notes

SETTLED_NOTE = "hold_verdict=settled decides holds early; how often it is wrong: docs/concepts/tasks.md"


def main(args: list[str]) -> int:
    """`tactilerl train`"""
    usual = arguments.defaults(args)
    config, options = arguments.read(args, usual)
    if options.trust and not options.resume:
        raise InputError("--trust: found without --resume, allowed only with it")
    if options.resume and flags.peek(args, "--out"):
        raise InputError("--out: a resumed run stays in its folder; leave it out")
    notes = []
    with input_errors():
        comm = mpi.world()
        if (
            config.scene and not options.resume
        ):  # which has its layout's own copy: the file may be gone
            notes = layout_notes(config.run.env, config.scene.layout)
    summary = _summary(config, usual, comm.size, notes)
    path = train(config, comm, summary)
    if comm.rank == 0:
        console.print(
            f"\nThe run is in {path}: progress.csv (learning curve), checkpoint.pt, "
            "config.json (all settings).\n"
            f"  tactilerl evaluate {pasted(path)}{config.again}"
        )
    return 0


def _summary(config: RunConfig, usual: RunConfig, ranks: int, notes: list[str]) -> str:
    """What matters first and what is not as usual, a paragraph per part; config.json has the rest."""
    lines = [f"tactilerl train: {ranks} process{'es' * (ranks > 1)}"]
    before = usual.as_dict()
    for part, values in config.as_dict().items():
        pairs = "  ".join(
            f"{name}={value}".replace(", ", ",")  # tuples stay on one line
            for name, value in (values or {}).items()
            if name in arguments.TRAIN.first or value != before[part][name]
        )
        if pairs:
            lines.append(paragraph(part, pairs))
    if config.scene is not None and config.scene.hold_verdict == "settled":
        notes = [SETTLED_NOTE, *notes]
    lines += [paragraph("note", note) for note in notes]
    return "\n".join(lines)
