"""How a command ends: with what it prints, or with one line where it was given what is not allowed."""

import os
import subprocess
import sys

from tactilerl.commands.cli import main

TOY = ["train", "--env", "lqr", "--hidden", "8", "--steps-per-epoch", "60", "--n-passes", "1"]
# Learners that learn next to nothing, in no time; and what shortens the episodes of a hand.
PPO = ["--algo", "ppo", "--hidden", "8", "--steps-per-epoch", "16", "--n-passes", "1"]
HER = ["--algo", "ddpg_her", "--hidden", "8", "--batch-size", "8", "--n-cycles", "1"]
HER += ["--n-batches", "1", "--n-rollouts", "1", "--n-test-rollouts", "1"]
REACH = ["--task", "reach-goal", "--max-episode-steps", "6", "--workers", "1"]


def printed(capsys, args, code=0):
    """What a command prints that ends with this exit code."""
    capsys.readouterr()
    assert main([*map(str, args)]) == code
    return capsys.readouterr().out


def fails_with(capsys, args, *words, code=2):
    """An exit code and one line of ours, or tyro's box about a flag; with all the words. Returned
    in one line."""
    capsys.readouterr()
    assert main([*map(str, args)]) == code
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    if "For full helptext" not in err:
        assert err.startswith(("tactilerl: error: ", "tactilerl: stopped: "))
        assert err.count("\n") == 1
        assert len(err) < 1200  # there are about sixty names of flags
    line = " ".join(err.translate(dict.fromkeys(map(ord, "╭╮╰╯│─"), " ")).split())
    for word in words:
        assert word in line, line
    return line


def python(*args, **environment):
    """A Python of its own, without a display, that finds what this one does: how it ended."""
    screens = ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")
    kept = {name: value for name, value in os.environ.items() if name not in screens}
    environment = {**kept, "PYTHONPATH": os.pathsep.join(sys.path), **environment}
    return subprocess.run([sys.executable, *args], env=environment, capture_output=True, text=True)
