"""Keep of a run what `evaluate` and `render` need: its configuration, its curve, and its policy.

    python tools/ship_policy.py RUN FOLDER

The run cannot be resumed from there: optimisers, critics and experience stay behind.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from tactilerl import algos
from tactilerl.runs import checkpoint, sealed
from tactilerl.runs.run_dir import RunDir

FILES = ("config.json", "progress.csv", "layout.toml")


def ship(run: Path, folder: Path) -> None:
    """Write `folder` anew."""
    run_dir = RunDir(run)
    config, _ = run_dir.read_config()
    data = checkpoint.read(run_dir, config)
    parts = (*algos.get(config.run.algo)[1].policy_parts, "env_steps")
    state = {name: data["ranks"][0][name] for name in parts}
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name in FILES:
        if (run / name).exists():
            shutil.copy(run / name, folder)
    sealed.write(RunDir(folder).checkpoint_file, data | {"ranks": [state], "experience": []})


if __name__ == "__main__":
    ship(*map(Path, sys.argv[1:]))
