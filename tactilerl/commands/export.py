"""`tactilerl export`: a trained policy as a file that a real hand's control loop runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from ..files import require_new
from ..runs.export import export
from ..terminal import flags
from ..terminal.console import console

ABOUT = """\
Write the policy of a run as an ONNX graph (extra: export). Its inputs are sensors by name,
its outputs the action and the hand's joint targets. See docs/guides/real_hand.md.

examples:
  tactilerl export runs/X
  tactilerl export runs/X --out policy.onnx"""


@dataclass(frozen=True)
class ExportFlags:
    """Flags of `tactilerl export`."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    out: Path = Path("policy.onnx")
    """File of the graph."""
    overwrite: bool = False
    """Replace a file that is there."""


def main(args: list[str]) -> int:
    """Run `tactilerl export RUN`."""
    read = flags.parse(ExportFlags, args, "tactilerl export", ABOUT)
    require_new(read.out, read.overwrite, ".onnx")
    export(read.run, read.out)
    console.print(f"{read.out}: docs/guides/real_hand.md says what to feed it")
    return 0
