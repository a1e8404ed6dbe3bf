"""Gymnasium's render mode "human": MuJoCo's viewer, which changes nothing of what is simulated."""

import os
import shutil
import subprocess
import sys

import pytest
import tactilerl

from one_line import python

SHOWN = """
import time
import numpy as np
import tactilerl.envs

env = tactilerl.envs.make("shadow", layout="1", render_mode="human")
blind = tactilerl.envs.make("shadow", layout="1")
action = np.full(blind.action_space.shape, 0.3, np.float32)
env.reset(seed=3), blind.reset(seed=3)
begin = time.monotonic()
for _ in range(3):
    seen, unseen = env.step(action)[0], blind.step(action)[0]
print(time.monotonic() - begin > 0.9 * 3 * env.unwrapped.config.control_dt)
print(np.array_equal(seen["observation"], unseen["observation"]))
window = env.unwrapped.simulator._window
print(window.viewer.user_scn.ngeom == len(env.unwrapped.taxels))
window.viewer.close()
env.step(action)
env.close()
"""


@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="needs xvfb-run")
def test_what_is_shown_is_what_is_simulated_in_real_time():
    display = ["xvfb-run", "-a", "-s", "-screen 0 640x480x24"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [*display, sys.executable, "-c", SHOWN]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["True"] * 3


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is a display")
def test_where_there_is_no_window():
    made = "import tactilerl; tactilerl.make('shadow', render_mode='human').reset(seed=0)"
    said = python("-c", made).stderr.splitlines()[-1]
    assert said.startswith("OSError: render_mode human: no window opens here (no display)")
    with pytest.raises(ValueError, match="render_mode: found 'human', allowed with simulator mujoco"):
        tactilerl.make("shadow", simulator="pybullet", render_mode="human").reset(seed=0)
