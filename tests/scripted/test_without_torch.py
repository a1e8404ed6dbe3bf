"""What is asked before any training does not need PyTorch, which takes seconds to import."""

from pathlib import Path

import pytest

from one_line import python

GRIPPER = Path(__file__).parents[1] / "hands" / "gripper.xml"
COMMANDS = f"""
import sys

from tactilerl.commands.cli import main
from tactilerl.scripted import grasp_search, reflexes, taxels

grasp_search.ROUNDS, grasp_search.GROUNDS, grasp_search.OTHERS = (1,), (0.0,), 1
for sense, (handed, lifted) in reflexes.SENSES.items():
    reflexes.SENSES[sense] = handed[:1], lifted[:1]
check = taxels.check
taxels.check = lambda hand, scene, n=1, seconds=0.1: check(hand, scene, 1, 0.1)
few = ["--starts", "2", "--workers", "1"]
design = ["design", "--scene", "handover", "--skin", "20mm", "--beside", "2", "--test-starts", "2"]
print(main([*design, *few, "--out", "designed"]))
print(main(["gate", "--scene", "handover", *few, "--search", "1"]))
print(main(["env", "--env", "mpl", "--layout", "5", "--check"]) in (0, 1))
print(main(["hand", {str(GRIPPER)!r}, "--out", "mine.toml"]) in (0, 1))
print("torch" not in sys.modules)
"""


def test_their_modules():
    code = "import sys; from tactilerl.commands import design, env, gate, hand"
    done = python("-c", f"{code}; assert 'torch' not in sys.modules")
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_design_gate_env_and_hand(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = python("-c", COMMANDS)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    said = done.stdout.split("\n")
    assert [said.count(word) for word in ("0", "True")] == [2, 3], done.stdout + done.stderr
