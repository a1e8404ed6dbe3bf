"""Where should a hand's few taxels go? Let the library choose, and play with them."""

# %%
import argparse

import tactilerl

# %% The budget: starts to choose from and to judge on. 200 are a start.
STEPS = 10

# %% Parse `--steps`, so that the script can be tried with another budget
parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=STEPS)
starts = parser.parse_known_args()[0].steps

# %% Two taxels for objects that somebody holds against the palm, from one recording of a dense skin
layout = tactilerl.design(
    scene="handover", taxels=2, skin="8mm", starts=starts, test_starts=starts, beside=()
)
print(layout)

# %% It goes wherever a layout goes
env = tactilerl.make(scene="handover", layout=layout)
print(env.reset(seed=0)[0]["observation"].shape)
env.close()
