"""PPO on an environment of your own: any Gymnasium environment will do."""

# %%
import argparse
from typing import Any

import gymnasium as gym
import numpy as np

import tactilerl

# %% The budget
STEPS = 20_000

# %% Parse `--steps`, so that the script can be tried with another budget
parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=STEPS)
steps = parser.parse_known_args()[0].steps


# %% The environment: push a cart to the origin, and keep it there
class Cart(gym.Env[np.ndarray, np.ndarray]):
    """Position and velocity are seen, the force is the action."""

    observation_space = gym.spaces.Box(-10.0, 10.0, (2,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: Any = None
    ) -> tuple[np.ndarray, dict]:
        """Put the point somewhere, at rest."""
        super().reset(seed=seed)
        self.state = np.array([self.np_random.uniform(-1.0, 1.0), 0.0])
        return self.state.astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Move the point for a tenth of a second."""
        position, velocity = self.state
        velocity += 0.1 * float(action[0])
        self.state = np.clip([position + 0.1 * velocity, velocity], -10.0, 10.0)
        return (
            self.state.astype(np.float32),
            -abs(float(self.state[0])),
            False,
            False,
            {},
        )


# %% Episodes have to end: Gymnasium's own wrapper sees to it. Wrap as you like.
env = gym.wrappers.TimeLimit(Cart(), max_episode_steps=50)

# %% Learn, and follow each epoch
ppo = tactilerl.PPO(env, seed=0, hidden=[64, 64], n_passes=20)
before = tactilerl.evaluate(ppo.policy(), env, episodes=20)
ppo.learn(
    steps,
    callback=lambda row: print(
        f"{row['env_steps']:6} steps: {row['mean_return']:6.1f}"
    ),
)

# %% Compare
after = tactilerl.evaluate(ppo.policy(), env, episodes=20)
print(
    f"mean return: {before['mean_return']:.1f} before, {after['mean_return']:.1f} after"
)

# %% Act: for one observation, or for many at once
policy = ppo.policy()
print(policy.act([0.5, 0.0]), policy.act([[0.5, 0.0], [-0.5, 0.0]]).shape)
