"""Print what recipe "robust" reaches, there and elsewhere, and what the scale of the taxels does.

python -m benchmarks learner_tables
"""

from __future__ import annotations

import math

import numpy as np
from tactilerl.statistics import Array
from tactilerl.study.records import Record

from benchmarks.command import markdown
from benchmarks.studies.study_tables import in_common, load, mean, title

DEAD = 0.05  # a run whose second half is below learned nothing
THRESHOLD = 0.7
WINDOW = 3000  # steps over which success is averaged before it counts as reached
HANDS = {"mpl": "MPL hand", "shadow": "Shadow Hand", "allegro": "Allegro"}
SETUPS = {
    **{f"ppo_{hand}": f"{name}, PPO, layout 1" for hand, name in HANDS.items()},
    **{f"ppo_{hand}_eight": f"{name}, PPO, 8 chosen" for hand, name in HANDS.items()},
    **{f"ddpg_her {hand}": f"{name}, DDPG+HER, layout 1" for hand, name in HANDS.items()},
    "ddpg_her_handover": "MPL hand, DDPG+HER, `handover`",
    "make_train on": "`make train`, touch",
    "make_train off": "`make train`, no touch",
}
"""Groups of runs of the pilot, as its table calls them."""
ELSEWHERE = {
    "lift_shadow_ppo": "lift, Shadow Hand, PPO",
    "lift_shadow_ppo_quiet": "the same, robust with `--action-variance 0.05`",
    "lift_mpl_ppo": "lift, MPL hand, PPO",
    "lift_shadow_ddpg_her": "lift, Shadow Hand, DDPG+HER",
    "lift_mpl_ddpg_her": "lift, MPL hand, DDPG+HER",
    "pendulum": "Pendulum-v1, PPO, return",
    "reacher": "Reacher-v5, PPO, return",
    "panda_reach": "PandaReach-v3, DDPG+HER",
    "panda_push": "PandaPush-v3, DDPG+HER",
}
"""Tasks that the recipe was not made for; their score is success, or the return where they say so."""


def group_of(record: Record) -> str:
    """Return the name of a run's group in `SETUPS`."""
    flags = record.run.flags
    more = {"ddpg_her": flags.get("env"), "make_train": flags.get("touch")}
    return f"{record.run.setup} {more.get(record.run.setup) or ''}".strip()


def grouped(name: str, key=group_of) -> dict[str, list[Record]]:
    """Return the finished runs of a study by group, in order of the seeds."""
    _, runs = load(name)
    groups: dict[str, list[Record]] = {}
    for record in runs:
        if record.is_finished:
            groups.setdefault(key(record), []).append(record)
    return groups


def part(record: Record, begin: float, column: str = "success_rate", end: float = 1.0) -> float:
    """Return the mean of a column between two fractions of a run's steps, by steps.

    A row is of the steps up to its own.
    """
    steps, values = record.column("env_steps"), record.column(column)
    before = np.r_[0.0, steps[:-1]]
    until, since = np.minimum(steps, end * steps[-1]), np.maximum(before, begin * steps[-1])
    weights = np.clip(until - since, 0.0, None)
    return float(np.average(values, weights=weights))


def smooth(record: Record) -> tuple[Array, Array]:
    """Return steps, and mean success over the `WINDOW` steps before each of them."""
    steps, rates = record.curve
    means = [rates[(steps > step - WINDOW) & (steps <= step)].mean() for step in steps]
    whole = steps >= WINDOW
    return steps[whole], np.array(means)[whole]


def steps_to(record: Record) -> float:
    """Return the steps after which `THRESHOLD` is first reached; infinity where it never is."""
    steps, rates = smooth(record)
    reached = steps[rates >= THRESHOLD]
    return float(reached[0]) if len(reached) else math.inf


def reached(name: str = "robust") -> None:
    """Print what each group of the pilot's runs reached."""
    rows = []
    groups = grouped(name)
    for key, label in SETUPS.items():
        runs = groups.get(key, [])
        if not runs:
            continue
        length = f"{runs[0].run.flags.get('total_timesteps', 30_000):,}"
        dead = sum(part(record, 0.5) < DEAD for record in runs)
        steps = [steps_to(record) for record in runs]
        never = sum(map(math.isinf, steps))
        arrived = [step for step in steps if math.isfinite(step)]
        to_threshold = f"{np.mean(arrived):,.0f}" if arrived else "–"
        to_threshold += f" ({never} never)" if never and arrived else ""
        tests = [record.column("test_success_rate") for record in runs]
        last_tests = [test[-1] for test in tests if np.isfinite(test[-1])]
        row = (
            *(label, length, len(runs), dead),
            mean(part(record, 0.0) for record in runs),
            mean(part(record, 0.8) for record in runs),
            *(to_threshold, mean(last_tests) if last_tests else ""),
        )
        rows.append(row)
    head = "| runs | steps | seeds | ended at 0 | mean success | last fifth | to 0.7 | last test |"
    markdown(head, rows)


def scale_of(record: Record) -> str:
    """Return set-up, layout and scale of the taxels of a run."""
    flags = record.run.flags
    return f"{record.run.setup.removesuffix('_each')} {flags['layout']} {flags['taxel_scale']}"


def scales(setup: str, name: str = "taxel_scale") -> None:
    """Print mean success over the run by layout and by scale of the taxels."""
    groups = {k: v for k, v in grouped(name, scale_of).items() if k.startswith(f"{setup} ")}
    layouts, kinds = ([*dict.fromkeys(k.split()[i] for k in groups)] for i in (1, 2))
    rows = []
    for layout in layouts:
        cells = [groups.get(f"{setup} {layout} {kind}", []) for kind in kinds]
        rows.append((title(layout), *(mean(part(one, 0.0) for one in cell) for cell in cells)))
    columns = " | ".join("as they are" if kind == "none" else kind for kind in kinds)
    markdown(f"| taxels | {columns} |", rows)


def gap(name: str = "taxel_scale") -> None:
    """Print how far layout 1 is ahead of layout 5 with each scale, in pairs of one seed."""
    groups, rows = grouped(name, scale_of), []
    for setup, label in {"paper": "the paper's PPO, MPL hand", "ppo": "`robust`, Allegro Hand"}.items():
        runs = [groups.get(f"{setup} {n} {kind}", []) for kind in ("none", "block") for n in (1, 5)]
        seeds, (many, few, many_block, few_block) = in_common(
            [{record.run.seed: part(record, 0.0) for record in group} for group in runs]
        )
        if len(seeds):
            as_they_are, block = many - few, many_block - few_block
            cells = (mean(one, "+.2f") for one in (as_they_are, block, as_they_are - block))
            rows.append((label, len(seeds), *cells))
    markdown("| layout 1 − layout 5 | seeds | as they are | block | as they are − block |", rows)


def elsewhere(name: str = "elsewhere") -> None:
    """Print recipe robust against steady in other tasks, in pairs of one seed."""
    runs, rows = [record for record in load(name)[1] if record.state == "done"], []
    for setup, label in ELSEWHERE.items():
        column, form = ("mean_return", ".1f") if "return" in label else ("success_rate", ".2f")
        robust, steady = (
            {
                r.run.seed: part(r, 0.0, column)
                for r in runs
                if (r.run.setup, r.run.flags["recipe"]) == (of, recipe)
            }
            for of, recipe in ((setup, "robust"), (setup.removesuffix("_quiet"), "steady"))
        )
        _, (a, b) = in_common([robust, steady])
        if len(a):
            rows.append((label, len(a), mean(b, form), mean(a, form), mean(a - b, f"+{form}")))
    markdown("| task | pairs | steady | robust | robust − steady |", rows)


TABLES = {
    "robust reached": reached,
    "elsewhere": elsewhere,
    "taxel scale ppo": lambda: scales("ppo"),
    "taxel scale ddpg_her": lambda: scales("ddpg_her"),
    "taxel scale paper": lambda: scales("paper"),
    "taxel scale gap": gap,
}
"""What prints each table of the docs."""
