"""Where do taxels go? What `design` reaches, beside other ways to choose, and carried elsewhere.

    python -m benchmarks design --out docs/data/design.json

Designs with a seed that nothing else uses, and judges on starts that nothing was chosen from. SSPOC is
`python-sensors` (extra: dev); without it the row is left out.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from contextlib import closing
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np
from tactilerl import statistics, style
from tactilerl.envs import hands, layouts, scenes, toml_files, vector
from tactilerl.envs.grasp import GraspEnv, setup
from tactilerl.envs.layouts import Layout
from tactilerl.probe import candidates, cover, design, gate, timing
from tactilerl.probe.cover import Aim, Starts
from tactilerl.probe.recording import Skin, record
from tactilerl.runs.cores import free_cores

from benchmarks.command import DATA, ROOT, data, run_parts
from benchmarks.printing import interval, markdown
from benchmarks.studies import design_study, gates, importance, study_tables

SEED = 46
GOALS = (("handover_anywhere", 4, 500), ("handover", 1, 200), ("handover_fingers", 5, 200))
"""Scene, taxels, and starts to judge on."""
ANYWHERE, BESIDE = "handover_anywhere", "1"
CHOICE, TEST, PYBULLET = 200, 300, 60  # starts; PyBullet is several times as slow
WAYS = (1, 2, 4, 8, 14)
WAITS = (0.1, 0.2, 0.3, 0.4, 0.5)  # how far the hand is closed while it waits
DENSE = DATA / "chosen" / "anywhere_skin.toml"
JUDGED = 2_000_000 * SEED + timing.TEST  # the first start to judge on
Row = dict[str, Any]


def chosen(scene: str, n: int, test: int = 2, **choices: Any) -> candidates.Design:
    """The library's choice of `n` taxels."""
    flags = candidates.DesignFlags((scene,), taxels=str(n), starts=CHOICE, test_starts=test, seed=SEED,
                               beside=(BESIDE,), **choices)  # fmt: skip
    return design.design(flags, free_cores())


def reflexes(env: str, scene: str, layout: str, n: int) -> tuple[gate.Found, np.ndarray]:
    """The gate's scripted hand with touch and a layout, and in which of the starts it succeeds (n,)."""
    config = setup(env, **{**scenes.load(scene).on(env), "layout": layout})
    workers = free_cores()
    (found,) = gate.examine(env, config, n, 20, SEED, workers, senses=("touch",))
    with closing(vector.start(partial(GraspEnv, env, config), workers)) as played_in:
        first = 2 * gate.SEARCH * SEED
        held = list(played_in.play(found.reflex.play, range(first, first + n)))
    return found, np.array(held, float)


def goals() -> dict[str, Any]:
    """Few taxels in each handover, on unseen starts, and what the gate says of them."""
    rows = []
    for scene, n, test in GOALS:
        made = chosen(scene, n, test)
        row = next(row for row in made.result["rows"] if row["layout"] == "chosen")
        env = made.result["env"]
        found, held = reflexes(env, scene, str(made.layout(n)), test)
        other, others = reflexes(env, scene, BESIDE, test)
        counts = statistics.resample(np.random.default_rng(0), test, 10_000)
        gained = list(statistics.mean(held - others, counts))
        rows.append({"scene": scene, **row, "layout": made.layout(n).toml(), "starts": test})
        rows[-1]["gate"] = {"rate": found.rate, "interval": list(found.interval), "beside": other.rate,
                            "difference": gained}  # fmt: skip
    return {"rows": rows}


def show_goals(result: dict[str, Any]) -> None:
    """As Markdown."""
    print("\n### Chosen taxels, in unseen starts\n")
    signed = partial(interval, form="+.2f", to=" to ")
    head = "| scene | taxels | felt | − layout 1 | scripted hand with touch | − layout 1 |"
    markdown(
        head,
        (
            (row["scene"], row["taxels"], interval(row["felt"], *row["felt_interval"]),
             signed(*row["difference"]["felt"]),
             interval(row["gate"]["rate"], *row["gate"]["interval"]),
             signed(*row["gate"]["difference"]))
            for row in result["rows"]
        ),
    )  # fmt: skip


def recorded(n: int, first: int, env: str = "mpl", **choices: Any) -> tuple[Skin, Starts]:
    """Starts of `ANYWHERE` with a dense skin."""
    hand = hands.get(env)
    skin = Skin.of([candidates.candidates(candidates.DesignFlags(), hand)])
    config = setup(env, **{**scenes.load(ANYWHERE).on(env), **choices})
    first += 2 * gate.SEARCH * SEED
    return skin, record(env, config, skin, range(first, first + n), free_cores())


def ways() -> dict[str, Any]:
    """Ways to choose from the same recording."""
    skin, starts = recorded(CHOICE, timing.CHOICE)
    _, judge = recorded(TEST, timing.TEST)
    every = list(range(len(skin.taxels)))
    features, arrived = moments(starts)
    asked: dict[str, Callable[[int], Iterable[int]]] = {
        "design": lambda k: cover.choose(starts, k).taxels,
        "greedy": lambda k: cover.greedy(starts, k, rounds=0),
        "L1 logistic regression": lambda k: by_l1(features, arrived, k),
    }
    if find_spec("pysensors"):
        asked["SSPOC"] = lambda k: by_sspoc(features, arrived, k)
    worth = importance.of_policy(ANYWHERE, str(DENSE), SEED)
    asked["importance to a trained policy"] = lambda k: np.argsort(-worth, kind="stable")[:k].tolist()
    rows = [{"way": way, **{str(k): cover.value(judge, [*choose(k)]) for k in WAYS}}
            for way, choose in asked.items()]  # fmt: skip
    rng = np.random.default_rng(SEED)
    drawn = {str(k): float(np.mean([cover.value(judge, rng.choice(every, k, False).tolist())
                                    for _ in range(50)])) for k in WAYS}  # fmt: skip
    return {
        "rows": [*rows, {"way": "random sets, mean", **drawn}],
        "whole skin": cover.value(judge, every),
    }


def moments(choice: Starts) -> tuple[np.ndarray, np.ndarray]:
    """What a classifier is given: which taxels have fired after each action from before the object sets
    off until it is let go, and whether it has arrived, which is when any taxel has fired."""
    x = [
        choice.fires[i] <= step
        for i, (start, end) in enumerate(zip(choice.sets_off, choice.lets_go, strict=True))
        for step in range(start - 1, end)
    ]
    features = np.array(x, float)
    return features, features.any(axis=1)


def by_l1(features: np.ndarray, arrived: np.ndarray, k: int) -> list[int]:
    """The `k` largest weights at the strongest penalty that leaves as many."""
    from sklearn.linear_model import LogisticRegression

    for strength in np.geomspace(1e-3, 10.0, 25):
        model = LogisticRegression(l1_ratio=1.0, C=strength, solver="liblinear", random_state=0)
        weights = np.abs(model.fit(features, arrived).coef_[0])
        if (weights > 0).sum() >= k:
            break
    return np.argsort(-weights, kind="stable")[:k].tolist()


def by_sspoc(features: np.ndarray, arrived: np.ndarray, k: int) -> list[int]:
    """Sparse sensor placement for classification (Brunton et al. 2016)."""
    import pysensors

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = pysensors.classification.SSPOC(n_sensors=k).fit(
            features, arrived.astype(int), quiet=True
        )
    return [int(i) for i in model.selected_sensors[:k]]


def show_ways(result: dict[str, Any]) -> None:
    """As Markdown."""
    print(f"\n### Success at the first touch, in unseen starts of {ANYWHERE}\n")
    head = f"| way | {' | '.join(map(str, WAYS))} |"
    markdown(head, ((row["way"], *(f"{row[str(k)]:.2f}" for k in WAYS)) for row in result["rows"]))
    print(f"\nall candidates: {result['whole skin']:.2f}")


def judged(
    sets: dict[str, Layout], env: str, n: int, first: int = JUDGED, **choices: Any
) -> dict[str, Any]:
    """Success and share felt of layouts in the same unseen starts."""
    hand = hands.get(env)
    placed = {name: layout.place(hand) for name, layout in sets.items()}
    skin = Skin.of(placed.values())
    config = setup(env, **{**scenes.load(ANYWHERE).on(env), **choices})
    found = record(env, config, skin, range(first, first + n), free_cores())
    result = {}
    for name, taxels in placed.items():
        columns = skin.columns(taxels)
        starts = found.take(columns)
        held = cover.scores(starts, np.arange(len(columns))[None], Aim())[:, 0]
        one_dead = [cover.value(starts, [*range(i), *range(i + 1, len(columns))])
                    for i in range(len(columns))] if len(columns) < 20 else []  # fmt: skip
        result[name] = {
            "taxels": len(columns), "success": float(held.mean()),
            "interval": list(statistics.wilson_interval(int(held.sum()), n)),
            "felt": float(found.felt(columns).mean()),
            "one dead": [float(np.mean(one_dead)), min(one_dead)] if one_dead else None,
        }  # fmt: skip
    return result


def transfers() -> dict[str, Any]:
    """Designed in one place and judged in another."""
    four = chosen(ANYWHERE, 4).layout(4)
    paper = {f"layout {BESIDE}": layouts.load(BESIDE)}
    moved = judged({"designed in MuJoCo": four, **paper}, "mpl", PYBULLET, simulator="pybullet")
    rows = [{"asked": "MPL hand in PyBullet", **each} for each in named(moved)]
    for env in ("shadow", "allegro"):
        own = chosen(ANYWHERE, 4, env=env).layout(4)
        both = {"designed for the MPL hand": four, "designed for this hand": own, **paper}
        rows += [{"asked": f"{env} hand", **each} for each in named(judged(both, env, CHOICE))]
    twice = chosen(ANYWHERE, 4, redundancy=2).layout(4)
    both = {"four": four, "four, redundancy 2": twice}
    rows += [{"asked": "MPL hand", **each} for each in named(judged(both, "mpl", TEST))]
    return {"rows": rows}


def named(result: dict[str, Any]) -> list[Row]:
    """As rows."""
    return [{"layout": name, **row} for name, row in result.items()]


def show_transfers(result: dict[str, Any]) -> None:
    """As Markdown."""
    print(f"\n### Carried elsewhere, {ANYWHERE}\n")
    markdown(
        "| judged on | layout | taxels | success | felt | one taxel dead: mean, worst |",
        (
            (row["asked"], row["layout"], row["taxels"],
             interval(row["success"], *row["interval"]), f"{row['felt']:.2f}",
             "{:.2f}, {:.2f}".format(*row["one dead"]) if row["one dead"] else "")
            for row in result["rows"]
        ),
    )  # fmt: skip


def layouts_of_study() -> dict[str, Any]:
    """The scripted baseline of every layout of studies/design.toml."""
    study = toml_files.read(ROOT / "studies" / "design.toml", "study")
    return baselines("mpl", study["setups"]["ppo"]["grid"]["layout"])


def layouts_of_hands() -> dict[str, Any]:
    """The same of every hand's layouts in studies/setups.toml."""
    study = toml_files.read(ROOT / "studies" / "setups.toml", "study")["setups"]
    return {
        hand: baselines(hand, ["1", *study[f"ppo_{hand}_layouts"]["grid"]["layout"]])
        for hand in gates.HANDS
    }


def baselines(env: str, names: Iterable[str]) -> dict[str, Any]:
    """A hand that closes at the first touch, by layout and by how far closed it waits; and where it
    waits as suited the layout best in other starts."""
    found = {design_study.title(str(each)): layouts.load(str(each)) for each in names}
    n, first = GOALS[0][2], JUDGED - timing.TEST + timing.CHOICE
    waits = {w: judged(found, env, n, start_closing=w) for w in WAITS}
    before = {w: judged(found, env, CHOICE, first, start_closing=w) for w in WAITS}
    usual, result = setup(env, **scenes.load(ANYWHERE).on(env)).start_closing, {}
    for name in found:
        best = max(WAITS, key=lambda w: before[w][name]["success"])
        result[name] = {
            **waits[usual][name],
            "waits": {str(w): made[name]["success"] for w, made in waits.items()},
            "best": {"start_closing": best, **waits[best][name]},
        }
    return result


def show_layouts(result: dict[str, Any]) -> None:
    """As Markdown."""
    print("\n### Success at the first touch, by how far closed the hand waits\n")
    trained = {name: study_tables.mean(closed) for name, closed in data("waiting").items()}
    rows = [(name, *_by_wait(row), trained.pop(name, "")) for name, row in result.items()]
    rows += [(name, *[""] * (len(WAITS) + 1), closed) for name, closed in trained.items()]
    markdown(f"| layout | {BY_WAIT} | trained hands wait at |", rows)


def show_hands(result: dict[str, Any]) -> None:
    """As Markdown."""
    print("\n### The same with every hand\n")
    rows = [
        (style.NAMES[hand], name, row["taxels"], *_by_wait(row))
        for hand, of_hand in result.items()
        for name, row in of_hand.items()
    ]
    markdown(f"| hand | layout | taxels | {BY_WAIT} |", rows)


BY_WAIT = " | ".join(f"{wait:g}" for wait in WAITS) + " | at its best"


def _by_wait(row: Row) -> tuple[str, ...]:
    """A layout's success, under `BY_WAIT`."""
    best = row["best"]
    waits = (f"{value:.2f}" for value in row["waits"].values())
    return *waits, interval(best["success"], *best["interval"])


def main() -> None:
    """All parts, or one with --only."""
    parts = {
        "goals": (goals, show_goals),
        "layouts": (layouts_of_study, show_layouts),
        "hands": (layouts_of_hands, show_hands),
        "ways": (ways, show_ways),
        "transfers": (transfers, show_transfers),
    }
    run_parts(__doc__, parts, "mujoco", "scipy", "scikit-learn")
