"""The viewer: one line where there is no display, and in a display of its own what is felt."""

import os
import shutil
import subprocess
import sys

import pytest

from one_line import fails_with, python

DRAG = """
import threading, time
import mujoco
import tactilerl.envs
from tactilerl.envs.simulators.viewer import ClosedError, Viewed

env = tactilerl.envs.make("shadow", layout="1", render_mode="rgb_array")
env.reset(seed=0)
viewed = env.simulator = Viewed(env.simulator, env.spheres)
pull, targets = viewed._viewer.perturb, env.hand.start_targets()
with viewed._viewer.lock():
    pull.localmass, pull.scale = viewed.model.body("object").mass[0], 1.0
    pull.refpos[:] = pull.refselpos[:] = viewed.data.body("object").xpos
    pull.active = int(mujoco.mjtPertBit.mjPERT_TRANSLATE)
for _ in range(80):
    pull.refpos[2] += 0.002
    pull.refselpos[2] += 0.002
    viewed.step(targets, 10)
print("felt", bool(env.taxel_readings().any()), "left", bool(viewed.data.xfrc_applied.any()))
lit = [sphere for sphere in env.spheres() if sphere.colour[0] > 0.9]
print("lit", len(lit) == env.taxel_readings().sum())
viewed._pressed(ord(" "))
threading.Timer(0.5, viewed._pressed, [ord(" ")]).start()
begin = time.monotonic()
viewed.step(targets, 1)
print("paused", time.monotonic() - begin > 0.4)
viewed._pressed(ord("-"))
viewed._pressed(ord("-"))
begin = time.monotonic()
viewed.step(targets, 50)  # 0.2 s
print("slow", time.monotonic() - begin > 0.6)
viewed._viewer.close()
try:
    viewed.step(targets, 1)
except ClosedError:
    print("closed")
env.close()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is a display")
def test_without_a_display_one_line():
    done = python("-m", "tactilerl", "view", "--env", "shadow")
    assert done.returncode == 2
    assert done.stderr.startswith("tactilerl: error: view: no window")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("args", "named"),
    [
        (["--env", "lqr"], "found 'lqr'"),
        (["nowhere"], "not a run folder"),
        (["examples/policies/handover_touch", "--layout", "1"], "a run keeps its scene"),
        (["--speed", "2"], "--speed: found 2"),
        pytest.param(["--simulator", "pybullet"], "allowed mujoco", marks=pytest.mark.pybullet),
    ],
)
def test_bad_input(args, named, capsys):
    fails_with(capsys, ["view", *args], named)


@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="needs xvfb-run")
def test_the_mouse_is_felt_and_time_stands_still_or_slows_down():
    display = ["xvfb-run", "-a", "-s", "-screen 0 640x480x24"]
    command = [*display, sys.executable, "-c", DRAG]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[:5] == [
        "felt True left False", "lit True", "paused True", "slow True", "closed"
    ]  # fmt: skip
