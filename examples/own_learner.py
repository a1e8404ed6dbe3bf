"""A learner of your own: the cross-entropy method (Rubinstein 1999), which needs no gradients.

The command line imports it:

cd examples
tactilerl train --import own_learner --algo cem --env lqr --total-timesteps 100000 --out runs/cem
tactilerl evaluate --import own_learner runs/cem
"""

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tactilerl.algos import ALGORITHMS, Count, LearnerSpec, Positive32, rollout
from tactilerl.algos.learner import Learner, LearnerConfig, restore
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.networks import MLP
from tactilerl.algos.policy import (
    FlatInputs,
    Noise,
    Policy,
    Spaces,
    input_stats,
    new_actor,
)
from tactilerl.algos.rollout import PlayEpisode, summary
from torch.nn.utils import parameters_to_vector, vector_to_parameters


@dataclass(frozen=True)
class CEMConfig(LearnerConfig):
    """Hyperparameters; each is a flag of `tactilerl train`, whose range is in its type."""

    hidden: tuple[int, ...] = (8,)
    """Units of each hidden layer of the policy."""
    population: Count = 40
    """Candidates per epoch."""
    n_elite: Count = 8
    """Candidates that the next ones are drawn around."""
    n_episodes: Count = 2
    """Episodes that each candidate plays."""
    std: Positive32 = 0.5
    """Standard deviation of the first candidates' weights."""

    def validate(self) -> None:
        """Raise ValueError where values do not go together."""
        if not 2 <= self.n_elite <= self.population:
            raise ValueError(
                f"n_elite: found {self.n_elite}, allowed 2 to {self.population}"
            )


class CEM(Learner):
    """Draw candidates around the mean of the best ones so far, with their standard deviations."""

    policy_parts = saved = ("actor",)
    plain = ("env_steps", "epochs", "spread")

    def build(self, generator: torch.Generator) -> None:
        """Make the mean policy, and the spread of its weights."""
        self.actor = new_actor(self.config.hidden, self.spaces, generator)
        mean = parameters_to_vector(self.actor.parameters())
        self.spread = {"std": torch.full_like(mean, self.config.std).detach()}
        self.epochs = 0

    def describe(self) -> str:
        """Return in words what the configuration amounts to."""
        n_weights = len(self.spread["std"])
        return f"{self.config.population} candidates of {n_weights} weights per epoch"

    def policy(self) -> Policy:
        """Return the mean of the candidates."""
        return greedy(self.spaces, self.actor)

    def collect(self) -> dict[str, float]:
        """Let all candidates play the same episodes."""
        config = self.config
        rng = np.random.default_rng([self.seed, 0, rollout.LEARN, self.epochs])
        mean = parameters_to_vector(self.actor.parameters()).detach()
        noise = rng.standard_normal((config.population, len(mean)), dtype=np.float32)
        self.candidates = mean + self.spread["std"] * torch.from_numpy(noise)
        key = (self.seed, 0, rollout.TRAIN, self.epochs)
        mine = []  # of several MPI ranks, each plays a part of the candidates
        for weights in self.candidates[self.comm.rank :: self.comm.size]:
            actor = copy.deepcopy(self.actor)
            vector_to_parameters(weights, actor.parameters())
            job = PlayEpisode(greedy(self.spaces, actor), key)
            mine.append([*self.workers.play(job, range(config.n_episodes))])
        parts, size = self.comm.all_gather(mine), self.comm.size
        played = [parts[i % size][i // size] for i in range(config.population)]
        self.returns = [value(each) for each in played]
        episodes = [episode for each in played for episode in each]
        self.epochs += 1
        stats = summary(episodes)
        self.env_steps += int(stats.pop("steps"))
        return stats

    def update(self) -> dict[str, float]:
        """Move to the best candidates."""
        best = np.argsort(self.returns)[-self.config.n_elite :].copy()
        elite = self.candidates[torch.from_numpy(best)]
        vector_to_parameters(elite.mean(dim=0), self.actor.parameters())
        self.spread = {"std": elite.std(dim=0)}
        return {"weight_std": float(self.spread["std"].mean())}

    @staticmethod
    def saved_policy(config: Any, spaces: Spaces, saved: dict[str, Any]) -> Policy:
        """Return the policy of a checkpoint."""
        actor = new_actor(config.hidden, spaces, torch.Generator())
        restore({"actor": actor}, saved)
        return greedy(spaces, actor)


def value(episodes: list[rollout.Episode]) -> float:
    """Return what a candidate reached: its mean return, or the worst where the physics failed."""
    if any(episode.faults["diverged"] for episode in episodes):
        return -np.inf
    return float(np.mean([sum(episode.rewards) for episode in episodes]))


def greedy(spaces: Spaces, actor: MLP) -> Policy:
    """Return a policy that acts as a network says, from observations as they are."""
    stats = input_stats(spaces.observation, Communicator(), 5.0, False, "none")
    return Policy(actor, FlatInputs(stats.scaling()), no_noise, spaces)


def no_noise(rng: np.random.Generator) -> Noise:
    """Return the exploration of an episode: none, as candidates differ from each other."""
    return np.copy


ALGORITHMS["cem"] = LearnerSpec(
    "CEMConfig", "CEM", 100_000, "handover", module=__name__
)
