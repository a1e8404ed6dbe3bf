"""What does a trained hand lose when taxels break? One policy, more and more dead taxels."""

# %%
import argparse

import tactilerl

# %% The budgets. A hand that has learned nothing has nothing to lose: 50_000 steps are a start,
# and 100 episodes tell rates apart that lie 0.15 from each other.
STEPS = 500
EPISODES = 2

# %% Parse `--steps` and `--run`: a run folder of yours to look at instead
parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=STEPS)
parser.add_argument("--run", help="folder of a run on shadow with layout 4")
options = parser.parse_known_args()[0]

# %% A policy: from a run, or trained here
if options.run:
    policy = tactilerl.load_policy(options.run)
else:
    env = tactilerl.make("shadow", layout=4, hold_verdict="settled")
    ppo = tactilerl.PPO(env, seed=0, steps_per_epoch=min(1000, options.steps))
    policy = ppo.learn(options.steps, progress=True).policy()

# %% The same episodes with more and more dead taxels. Other faults: taxel_stuck, taxel_false_on,
# taxel_false_off, taxel_delay. Lifted objects are judged early, for speed; without `hold_verdict`
# each hold lasts 20 s.
for share in (0.0, 0.2, 0.5):
    hand = tactilerl.make(
        "shadow", layout=4, taxel_dead=share, hold_verdict="settled", hand_seed=0
    )
    result = tactilerl.evaluate(policy, hand, episodes=EPISODES)
    low, high = result["success_rate_ci"]
    print(
        f"{share:4.0%} dead: success rate {result['success_rate']:.2f} ({low:.2f} to {high:.2f})"
    )
    hand.close()
