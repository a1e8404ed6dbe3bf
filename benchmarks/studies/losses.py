"""What does a learned policy lose with a taxel, by whether taxels were placed to survive a loss?

Plays the policies of the study `losses` intact and with each taxel dead, and writes JSON:

    python -m benchmarks losses --runs studies/losses --out docs/data/losses.json
"""

from __future__ import annotations

from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import tactilerl
from tactilerl.runs.store import RunDir
from tactilerl.study import records

from benchmarks.command import count, data, earlier, markdown, parser, processes, write
from benchmarks.studies.study_tables import mean

KINDS = {
    "placed for any loss": "anywhere_8_survives_taxel",
    "placed for success": "anywhere_8_waiting_0.3",
}
N_TAXELS = 8
Rates = dict[str, dict[str, Any]]
"""Success of each run intact and with each taxel dead, by the run's name."""


def without(env: gym.Env[Any, Any], taxel: int | None) -> gym.Env[Any, Any]:
    """Return an environment in which one taxel reads 0, now and in the readings of earlier steps."""
    if taxel is None:
        return env
    space: Any = env.observation_space
    names = space["observation"].names
    readings = [i for i, name in enumerate(names) if name.startswith("taxel ")]
    lost = readings[taxel::N_TAXELS]

    def lose(obs: dict[str, Any]) -> dict[str, Any]:
        sensed = obs["observation"].copy()
        sensed[lost] = 0
        return {**obs, "observation": sensed}

    return gym.wrappers.TransformObservation(env, lose, space)


def play(folder: Path, episodes: int) -> dict[str, Any]:
    """Return what the policy of a run reaches, intact and with each of its taxels dead."""
    make_env = RunDir(folder).read_config().make_env
    policy = tactilerl.load_policy(folder)
    rates = []
    for taxel in (None, *range(N_TAXELS)):
        env = without(make_env(), taxel)
        rates.append(tactilerl.evaluate(policy, env, episodes=episodes)["success_rate"])
        env.close()
    return {"intact": rates[0], "dead": rates[1:]}


def show(rates: Rates) -> None:
    """Print success intact and with the worst taxel dead, and the difference within pairs."""
    by_kind: dict[str, dict[str, tuple[float, float]]] = defaultdict(dict)
    for name, rate in rates.items():
        kind = next(kind for kind, file in KINDS.items() if f"{file}.toml" in name)
        by_kind[kind][name.rsplit("_s", 1)[1]] = rate["intact"], min(rate["dead"])
    rows = []
    for kind, pairs in by_kind.items():
        intact, worst = np.array([*pairs.values()]).T
        rows.append((kind, len(pairs), mean(intact), mean(worst)))
    treatment, control = (by_kind.get(kind, {}) for kind in KINDS)
    both = sorted(treatment.keys() & control.keys())
    gains = np.array([np.subtract(treatment[seed], control[seed]) for seed in both])
    rows.append(("difference within pairs", len(both), *(mean(gain, "+.2f") for gain in gains.T)))
    markdown("| eight taxels, PPO | runs | intact | with the worst taxel dead |", rows)


TABLES = {"losses": lambda: show(data("losses"))}


def main() -> None:
    """Play the finished runs that have not been played, then print the table."""
    flags = parser(__doc__)
    flags.add_argument("--runs", type=Path, required=True, help="folder of the study")
    flags.add_argument("--episodes", type=count, default=100)
    options = flags.parse_args()
    rates: Rates = earlier(options.out)
    _, runs = records.load(options.runs)
    names = [record.run.name for record in runs if record.is_finished]
    folders = [options.runs / "runs" / name for name in names if name not in rates]
    with processes(2) as pool:
        played = pool.map(partial(play, episodes=options.episodes), folders)
        for folder, result in zip(folders, played, strict=True):
            rates[folder.name] = result
            write(options.out, rates)
    show(rates)
