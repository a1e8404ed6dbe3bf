"""What the site of the docs has from the code, while mkdocs builds it.

The pages in docs are complete in a repository's browser; the site adds what would go stale if it were
written by hand: the flags of every command, signatures and docstrings, the hyperparameters of each
learner, a page on each environment, the version, and a link to the repository that the checkout was
cloned from.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

from docstring_parser import parse_from_object

sys.path.insert(
    0, str(Path(__file__).resolve().parents[1])
)  # for benchmarks, which is not installed

from tactilerl.algos.ddpg_her import DDPGHERConfig
from tactilerl.algos.ppo import PPOConfig

import tactilerl
from benchmarks import environments
from tactilerl.commands import cli
from tactilerl.commands.study import PARTS as STUDY

ROOT = Path(__file__).resolve().parents[1]
WIDTH = 78  # of help texts: what a page shows without scrolling
os.environ |= {"COLUMNS": str(WIDTH), "NO_COLOR": "1"}
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


LEARNERS = {"tactilerl.api.PPO": PPOConfig, "tactilerl.api.DDPGHER": DDPGHERConfig}


def on_config(config: Any) -> Any:
    """Add version, repository and pages of environments to mkdocs' configuration."""
    config.site_name = f"tactilerl {tactilerl.__version__}"
    config.copyright = f"tactilerl {tactilerl.__version__}, MIT licence"
    config.repo_url = config.repo_url or repository()
    if config.repo_url:
        config.repo_name = "Repository"
    (section,) = (each for each in config.nav if "Environments" in each)
    pages = [
        {environments.title(name): f"environments/{name}.md"}
        for name in environments.names()
    ]
    section["Environments"] = [{"Overview": "environments/README.md"}, *pages]
    return config


def repository() -> str:
    """Return the web page that the checkout was cloned from, or ""."""
    command = ["git", "remote", "get-url", "origin"]
    url = subprocess.run(command, capture_output=True, text=True).stdout.strip()
    address = re.sub(r"^(?:ssh://)?git@([^:/]+)[:/]", r"https://\1/", url).removesuffix(
        ".git"
    )
    return address if address.startswith("https://") and "@" not in address else ""


def on_files(files: Any, *, config: Any) -> Any:
    """Add the README and the pages that come from code to the files of the site."""
    from mkdocs.structure.files import File  # only where a site is built

    pages = {
        f"environments/{name}.md": environments.page(name)
        for name in environments.names()
    }
    calls = [call for name in cli.COMMANDS for call in SEVERAL.get(name, (name,))]
    pages["flags.md"] = "# Every flag\n" + "".join(map(flags, calls))
    pages["api.md"] = "# Every name in Python\n\n" + "".join(map(entry, python()))
    for path, text in {"index.md": home(), **pages}.items():
        files.append(File.generated(config, path, content=text))
    return files


def home() -> str:
    """Return the README with links as the site has them; files outside docs/ have no link."""
    text = (ROOT / "README.md").read_text(encoding="utf-8").replace("](docs/", "](")
    outside = "|".join(
        re.escape(path.name) for path in ROOT.iterdir() if path.is_file()
    )
    return re.sub(rf"\[([^\]]*)\]\((?:{outside})\)", r"\1", text)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Return a page without links to code, which the site has not."""
    return re.sub(r"\[([^\]]*)\]\((?:\.\./)+[\w/]+\.py\)", r"\1", markdown)


def entry(name: str) -> str:
    """Return the entry of a name, with all hyperparameters of a learner."""
    text = f"::: {name}\n\n"
    if name not in LEARNERS:
        return text
    text += "Hyperparameters, with the paper's values:\n\n| keyword | default | |\n|---|---|---|\n"
    config, defaults = LEARNERS[name], LEARNERS[name]()
    for field in parse_from_object(config).params:
        about = " ".join((field.description or "").split()).replace("|", "\\|")
        text += f"| `{field.arg_name}` | `{getattr(defaults, field.arg_name)!r}` | {about} |\n"
    return f"{text}\n"


def flags(command: str) -> str:
    """Return a section with the help of one command."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.suppress(SystemExit):
        cli.main([*command.split(), "--help"])
    lines = output.getvalue().splitlines()
    text = "\n".join(
        textwrap.fill(line, WIDTH, drop_whitespace=False) for line in lines
    )
    return f"\n## tactilerl {command}\n\n```text\n{text}\n```\n"


def python() -> list[str]:
    """Return full names of what is documented: what the package exports, then PYTHON."""
    exported = [getattr(tactilerl, name) for name in tactilerl.__all__]
    names = [f"{each.__module__}.{each.__qualname__}" for each in exported]
    return list(dict.fromkeys([*names, *PYTHON]))
