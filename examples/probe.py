"""What can a layout know? Play grasps once and ask several layouts. Needs 'tactilerl[probe]'."""

# %%
import argparse
import json
import tempfile
from pathlib import Path

from tactilerl.commands.cli import main as tactilerl_command

# %% The budget: grasps to play. 2_000 give useful intervals.
STEPS = 60

# %% Parse `--steps`, so that the script can be tried with another budget
parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=STEPS)
grasps = parser.parse_known_args()[0].steps

# %% Scripted grasps of cubes that lie somewhat differently each time. They are kept: ask them again
# about other layouts with `--from`, without playing any.
out = Path(tempfile.mkdtemp(prefix="tactilerl_"))
flags = [
    "--grasps",
    str(grasps),
    "--layout",
    "1",
    "4",
    "--folds",
    "2",
    "--joint-noise",
    "0",
]
tactilerl_command(
    ["probe", *flags, "--resamples", "200", "--shuffles", "2", "--out", str(out)]
)

# %% The answers as data, and the figures beside them
answers = json.loads((out / "probe.json").read_text())
print(*answers, sep=", ")
print(*sorted(path.name for path in out.iterdir()), sep="\n")
