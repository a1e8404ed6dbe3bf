"""What somebody else adds to the library: a simulator, a task, a sensor stage and a learner."""

from dataclasses import dataclass

import numpy as np
from tactilerl.algos.ppo import PPO, PPOConfig
from tactilerl.envs.simulators.mujoco import MujocoSimulator
from tactilerl.envs.tasks import ReachGoal


class Saturn(MujocoSimulator):
    """A little heavier than on Earth."""

    def __init__(self, scene):
        super().__init__(scene)
        self.model.opt.gravity[2] *= 1.06


class Nudge(ReachGoal):
    """Any place will do that is not the first."""

    def is_success(self, achieved_goal, desired_goal):
        return ~super().is_success(achieved_goal, desired_goal)


class Inverted:
    """What was on is off."""

    def begin(self, rng):
        pass

    def __call__(self, reading):
        return 1.0 - reading


@dataclass(frozen=True)
class BraveConfig(PPOConfig):
    """PPO's, and one of its own."""

    courage: float = 2.0
    """How much more it explores."""


class Brave(PPO):
    """Explores more."""

    def __init__(self, config, *args):
        super().__init__(config, *args)
        self.explored = np.float64(config.courage)
