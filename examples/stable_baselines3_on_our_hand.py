"""Train on the Shadow Hand with another library: Stable-Baselines3 (pip install stable-baselines3)."""

# %%
import argparse

import gymnasium as gym
from stable_baselines3 import PPO

import tactilerl  # registers the environments

# %% The budget. Raise it to learn something.
STEPS = 500

# %% Parse `--steps`, so that the script can be tried with another budget
parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=STEPS)
steps = parser.parse_known_args()[0].steps

# %% Observations are a Dict; without the achieved goal, the true pose even where a scene hides it
print("tactilerl", tactilerl.__version__)
env = gym.make("tactilerl/Shadow-v0", layout=4, hold_verdict="settled")
env = gym.wrappers.FilterObservation(env, ["observation", "desired_goal"])
print(env.observation_space)

# %% Train with Stable-Baselines3's own PPO
model = PPO(
    "MultiInputPolicy", env, n_steps=min(500, steps), batch_size=50, verbose=1, seed=0
)
model.learn(steps)

# %% One episode of what it has learned
obs, info = env.reset(seed=1)
is_over, total = False, 0.0
while not is_over:
    action, _ = model.predict(obs, deterministic=True)
    obs, reward, terminated, truncated, info = env.step(action)
    is_over, total = terminated or truncated, total + float(reward)
print(f"return {total:.1f}, success: {info['is_success']}")
env.close()
