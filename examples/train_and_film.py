"""Train the Shadow Hand to lift a cube, then watch it try. Films need 'tactilerl[render]'.

Run it whole, or cell by cell in an editor that knows such cells.
"""

# %%
import argparse
import tempfile
from pathlib import Path

import tactilerl
from tactilerl.commands.cli import main as tactilerl_command

# %% The budget. A few hundred steps only show that it works: 50_000 are a start.
STEPS = 500

# %% Parse `--steps`, so that the script can be tried with another budget
parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=STEPS)
steps = parser.parse_known_args()[0].steps

# %% Train. The folder holds the learning curve, the policy and everything needed to go on.
folder = Path(tempfile.mkdtemp(prefix="tactilerl_"))
run = tactilerl.train(
    "shadow",
    algo="ppo",
    layout=4,  # taxels on all phalanges: figure 2 of the paper
    total_timesteps=steps,
    steps_per_epoch=min(1000, steps),
    hold_verdict="settled",  # holds are judged early, for speed
    out=folder / "run",
)

# %% How good is it?
policy = tactilerl.load_policy(run)
result = tactilerl.evaluate(policy, tactilerl.make("shadow", layout=4), episodes=3)
print(
    f"success rate {result['success_rate']:.2f}, interval {result['success_rate_ci']}"
)

# %% Watch it: taxels that fire light up
film = folder / "film.mp4"
tactilerl_command(["render", str(run), "--video", str(film)])
print(f"the run and its film are in {folder}")
