"""Reference pages of the docs, made from the code while mkdocs builds the site.

The pages in docs/reference are complete in a repository's browser; the site adds what would go stale if
it were written by hand: the flags of every command, and signatures and docstrings.
"""

from __future__ import annotations

import contextlib
import io
import os
from typing import Any

import tactilerl
from tactilerl.commands import cli
from tactilerl.commands.study import PARTS as STUDY

os.environ["NO_COLOR"] = "1"  # of help texts
SEVERAL = {  # commands whose flags depend on what follows them
    "train": ("train", "train --algo ddpg_her"),
    "study": tuple(f"study {part}" for part in STUDY),
}
# Documented besides what `tactilerl` exports.
PYTHON = (
    "tactilerl.envs.make",
    "tactilerl.envs.grasp.GraspConfig",
    "tactilerl.envs.objects.ObjectConfig",
    "tactilerl.envs.observations.ObservationConfig",
    "tactilerl.envs.observations.SensorConfig",
    "tactilerl.envs.tasks.TaskConfig",
    "tactilerl.envs.grasp.GraspEnv",
    "tactilerl.runs.config.RunOptions",
    "tactilerl.algos.ppo.PPOConfig",
    "tactilerl.algos.ddpg_her.DDPGHERConfig",
    "tactilerl.statistics",
)


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Called by mkdocs with the text of each page."""
    if page.file.src_uri == "reference/command-line.md":
        calls = [call for name in cli.COMMANDS for call in SEVERAL.get(name, (name,))]
        return markdown + "".join(map(flags, calls))
    if page.file.src_uri == "reference/python.md":
        return f"{markdown}\n## Entries\n\n" + "".join(f"::: {name}\n\n" for name in python())
    return markdown


def flags(command: str) -> str:
    """A section with the help of one command."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.suppress(SystemExit):
        cli.main([*command.split(), "--help-all"])
    return f"\n## tactilerl {command}\n\n```text\n{output.getvalue()}```\n"


def python() -> list[str]:
    """Full names of what is documented: what the package exports, then PYTHON."""
    exported = [getattr(tactilerl, name) for name in tactilerl.__all__]
    names = [f"{each.__module__}.{each.__qualname__}" for each in exported]
    return list(dict.fromkeys([*names, *PYTHON]))
