"""Put taxels where you want them, see which ones feel a grasp, and train with them."""

# %%
import argparse
import tempfile
from pathlib import Path

import tactilerl

# %% The budget. Raise it to learn something: 50_000 are a start.
STEPS = 300

# %% Parse `--steps`, so that the script can be tried with another budget
parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=STEPS)
steps = parser.parse_known_args()[0].steps

# %% A layout is a file: patches of taxels, each on some segments of some digits.
# Offsets are rows towards the fingertip and columns towards the little finger, in millimetres.
layout = Path(tempfile.mkdtemp(prefix="tactilerl_")) / "fingertips.toml"
layout.write_text("""
description = "Two taxels on the tips of thumb, index and middle finger."

[[patch]]
digits = ["thumb", "index", "middle"]
segments = ["distal"]
offsets_mm = [[0, 0], [8, 0]]
radius_mm = 3.0
""")

# %% The observation now has one entry for each of them
env = tactilerl.make("shadow", layout=layout)
names = env.get_wrapper_attr("observation_names")()
print("taxels:", *(name for name in names if "taxel" in name), sep="\n  ")

# %% Train with them, in the environment as it is
ppo = tactilerl.PPO(env, seed=0, steps_per_epoch=min(1000, steps))
ppo.learn(steps, progress=True)

# %% Would other taxels have done better? Ask before training: see design.py
print(f"learned from {ppo.env_steps} steps with {layout}")
