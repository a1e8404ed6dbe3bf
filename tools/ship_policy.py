"""Keep of a run what `evaluate` and `render` need: its configuration, its curve, and its policy.

    python tools/ship_policy.py RUN FOLDER

The run cannot be resumed from there: optimisers, critics and experience stay behind.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tactilerl import algos, files
from tactilerl.errors import InputError
from tactilerl.runs import store
from tactilerl.runs.config import LAYOUT_COPY
from tactilerl.runs.store import RunDir


def ship(run: Path, folder: Path) -> None:
    """Write `folder`, anew where it holds such a policy; InputError where it holds anything else."""
    source, target = RunDir(run), RunDir(folder)
    config = source.read_config()
    data = source.read_checkpoint()
    parts = (*algos.get(config.run.algo)[1].policy_parts, "env_steps")
    state = {name: data["ranks"][0][name] for name in parts}
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.iterdir()):
        shipped = target.read_checkpoint()
        if "critic" in shipped["ranks"][0]:
            raise InputError(
                f"{folder}: found a whole run, allowed a new folder or a policy's"
            )
    content = data | {"ranks": [state], "experience": []}
    store.write_tensors(target.checkpoint_file, content)
    for name in (source.config_file.name, source.table.name, LAYOUT_COPY):
        if (run / name).exists():
            with files.replacing(folder / name) as file:
                file.write((run / name).read_bytes())


def main() -> int:
    """Both folders from the command line."""
    flags = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    flags.add_argument("run", type=Path)
    flags.add_argument("folder", type=Path)
    try:
        ship(**vars(flags.parse_args()))
    except (InputError, OSError) as error:
        print(f"ship_policy.py: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
