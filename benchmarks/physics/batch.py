"""How fast is a batch of worlds on a GPU, and is it the same physics?

Control steps a second of `handover_anywhere` with three hands, and one CPU core's; a hand that closes
at the first touch, in the batch and in MuJoCo from the same starts, with the hold test; taxels in
states of the batch, read by both; physics settings against MuJoCo at 1 ms; worlds that diverged or had
no room; Warp's deterministic option, whether a batch then repeats, and what it costs.
What is in the file already is not measured again:

    python -m benchmarks batch --out docs/data/batch.json
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from tactilerl import envs
from tactilerl.envs.batch import BatchEnv
from tactilerl.envs.grasp import GraspConfig, GraspEnv
from tactilerl.envs.simulators import mujoco

from benchmarks.command import (
    DATA,
    count,
    measure_missing,
    on_one_thread,
    parser,
    processes,
)

CHOSEN = {"mpl": "anywhere_8", "shadow": "shadow_anywhere_8", "allegro": "allegro_anywhere_8"}
WORLDS = {"mpl": 16_384, "shadow": 8_192, "allegro": 8_192}
SETTINGS = [(ms, iterations) for ms in (2, 4, 8) for iterations in (10, 20)]
CONTROL_DT = 0.096  # s: whole numbers of all these timesteps, and of 1 ms
SEED = 400_000


def config(hand: str, layout: str = "1", **choices: Any) -> GraspConfig:
    """Return the scene's configuration."""
    env: Any = envs.make(hand, scene="handover_anywhere", simulator="mujoco", layout=layout, **choices)
    return env.unwrapped.config


def layouts(hand: str) -> dict[str, str]:
    """Return the layouts of a hand, by name."""
    return {"1": "1", "5": "5", "chosen 8": str(DATA / "chosen" / f"{CHOSEN[hand]}.toml")}


def cpu_speed(hand: str, seconds: float = 3.0) -> dict[str, Any]:
    """Measure one core's control steps a second; random actions, resets included."""
    env, rng, steps = GraspEnv(hand, config(hand)), np.random.default_rng(0), 0
    env.reset(seed=SEED)
    start = time.perf_counter()
    while time.perf_counter() - start < seconds:
        *_, terminated, truncated, _ = env.step(rng.uniform(-0.5, 0.5, env.action_space.shape))
        steps += 1
        if terminated or truncated:
            env.reset()
    return {"steps_per_second": steps / (time.perf_counter() - start)}


def physics_ms(env: BatchEnv) -> float:
    """Measure how long the physics of a control step takes, the mean of five."""
    start, n_substeps = time.perf_counter(), np.full(env.num_envs, env.config.n_substeps)
    for _ in range(5):
        env.simulator.step(env._targets, n_substeps)
    return 1e3 * (time.perf_counter() - start) / 5


def speed(hand: str, device: str, n: int, steps: int = 40) -> dict[str, Any]:
    """Measure a batch's control steps a second; random actions, resets included."""
    start = time.perf_counter()
    env = BatchEnv(hand, [(config(hand), n)], device)
    env.reset(seed=SEED)
    made, rng, played = time.perf_counter() - start, np.random.default_rng(0), 0

    def step() -> int:
        *_, info = env.step(rng.uniform(-0.5, 0.5, env.action_space.shape))
        return int((~info["holding"]).sum())

    for _ in range(30):  # until worlds begin and end at all times
        step()
    start = time.perf_counter()
    played = sum(step() for _ in range(steps))
    seconds = (time.perf_counter() - start) / steps
    row = {"worlds": n, "steps_per_second": n / seconds, "without_hold_tests": played / steps / seconds}
    row |= {"step_ms": 1e3 * seconds, "physics_ms": physics_ms(env), "start_s": made}
    row |= {"diverged": env.n_diverged, "steps": n * (steps + 30)}
    env.close()
    return row


def repeats(hand: str, device: str, n: int, steps: int = 40) -> dict[str, Any]:
    """Play the same batch twice, without and with Warp's option; return its cost and what repeats.

    The cost is of the physics alone.
    """
    row, env = {"worlds": n}, BatchEnv(hand, [(config(hand), n)], device, autoreset=False)
    simulator: Any = env.simulator
    for is_deterministic in (False, True):
        simulator._model.opt.deterministic = is_deterministic
        simulator._graphs.clear()
        ends, name = [], "deterministic" if is_deterministic else "usual"
        for _ in range(2):
            rng = np.random.default_rng(0)
            env.reset(seed=SEED)
            for _ in range(steps):
                env.step(rng.uniform(-0.5, 0.5, env.action_space.shape))
            ends.append(simulator._now.qpos.cpu().numpy().copy())
        row[f"{name}_alike"] = float((ends[0] == ends[1]).all(1).mean())
        row[f"{name}_ms"] = physics_ms(env)
    env.close()
    return row


def alone(hand: str, layout: str, seeds: list[int]) -> list[tuple[bool, bool]]:
    """Play a hand that closes at the first touch in MuJoCo; return whether it held and felt."""
    on_one_thread()
    env, results = GraspEnv(hand, config(hand, layout)), []
    for seed in seeds:
        env.reset(seed=seed)
        felt, over, info = False, False, {}
        while not over:
            felt |= bool(env.taxel_readings().any())
            *_, terminated, truncated, info = env.step(np.array([float(felt)]))
            over = terminated or truncated
        results.append((bool(info["is_success"]), felt))
    return results


def together(hand: str, device: str, n: int, compared: int = 100) -> dict[str, Any]:
    """Play the same in a batch of all layouts, and read taxels in some of its states in MuJoCo too."""
    configs = [config(hand, layout) for layout in layouts(hand).values()]
    env = BatchEnv(hand, [(scene, n) for scene in configs], device, autoreset=False)
    plain = [GraspEnv(hand, scene) for scene in configs]
    obs, _ = env.reset(seed=[SEED + i for i in range(n)] * len(configs))
    fired, over, held = (np.zeros(env.num_envs, bool) for _ in range(3))
    taxels = np.zeros((len(configs), 3), int)
    steps, start = 0, time.perf_counter()
    while not over.all():
        playing = ~over & ~env._holding
        seen = obs["observation"].cpu().numpy()
        felt = [
            seen[number * n : (number + 1) * n, single.observation_entries("taxels")] > 0
            for number, single in enumerate(plain)
        ]
        fired |= np.concatenate([part.any(1) for part in felt]) & playing
        if steps in (12, 20, 28, 36):
            taxels += compare_taxels(env, plain, felt, playing, compared)
        obs, _, terminated, truncated, info = env.step(fired[:, None].astype(float))
        held |= info["is_success"]
        over |= (terminated | truncated).cpu().numpy()
        steps += 1
    seconds, rows = time.perf_counter() - start, {}
    for number, name in enumerate(layouts(hand)):
        part, (same, on, all_) = slice(number * n, (number + 1) * n), taxels[number].tolist()
        rows[name] = {"held": held[part].tolist(), "felt": fired[part].tolist()}
        rows[name] |= {"taxels": all_, "taxels_alike": same, "taxels_on": on}
    row = {"starts": n, "seconds": seconds, "diverged": env.n_diverged}
    env.close()
    return row | {"layouts": rows}


def compare_taxels(
    env: BatchEnv, plain: list[GraspEnv], felt: list[Any], playing: Any, compared: int
) -> Any:
    """Return taxels that read alike, that are on, and all, (n_groups, 3), in states put into MuJoCo.

    Of the first worlds of each group, those that are playing: the others' observations stand still.
    """
    state, counts, n = env.simulator.state(), [], len(felt[0])
    tensors: Any = state.joint_positions, state.object_position, state.object_orientation
    parts = [part.cpu().numpy().astype(float) for part in tensors]
    for number, single in enumerate(plain):
        count = np.zeros(3, int)
        first = number * n
        for i in first + np.flatnonzero(playing[first : first + min(n, compared)]):
            simulator, measures = single.simulator, state.shape.half_size
            shape = replace(state.shape, half_size=tuple(float(part[i]) for part in measures))
            simulator.change_object(shape, simulator.scene.mass, simulator.scene.friction)
            simulator.place(*(part[i] for part in parts))  # type: ignore[attr-defined]
            seen = single.taxel_readings()
            same = seen == felt[number][i - first]
            count += (int(same.sum()), int(seen.sum()), len(seen))
        counts.append(count)
    return np.array(counts)


def _ends(env: Any, states: Callable[[], Any]) -> Any:
    """Return where objects are in the hand after each step of a hand that closes, (steps, n, 3)."""
    task = env.task
    task.sets_off, env.max_episode_steps, task.settles, task.fallen = 20, 10**6, 10**6, 10.0
    places = []
    for step in range(45):
        env.step(np.full(env.action_space.shape, -0.1 if step < 38 else 1.0))
        state = states()
        places.append(np.asarray(state.object_position - state.palm).reshape(-1, 3))
    return np.array(places)


def reference(hand: str, timestep: float, seeds: list[int]) -> Any:
    """Return the same in MuJoCo, float64 and well solved."""
    on_one_thread()
    env: Any = GraspEnv(hand, setting(hand, timestep))
    env.simulator.model.opt.iterations, rows = 100, []
    for seed in seeds:
        env.reset(seed=seed)
        rows.append(_ends(env, lambda: env.state)[:, 0])
    return np.array(rows).swapaxes(0, 1)


def setting(hand: str, timestep: float) -> GraspConfig:
    """Return the scene with another timestep, of which nothing is drawn but the start."""
    noise = ("joint_noise", "joint_noise_held", "slide_noise", "slide_noise_held")
    exact: dict[str, Any] = dict.fromkeys(noise, 0.0)
    return config(hand, timestep=timestep, control_dt=CONTROL_DT, object_size=(0.045,), **exact)


def physics(
    hand: str, device: str, timestep: float, iterations: int, seeds: list[int], right: Any
) -> dict[str, Any]:
    """Measure a setting's speed, and how far its objects are from the reference's."""
    mujoco.SOLVER_ITERATIONS = iterations
    env = BatchEnv(hand, [(setting(hand, timestep), len(seeds))], device, autoreset=False)
    env.reset(seed=seeds)
    start = time.perf_counter()
    places = _ends(env, lambda: env._look()[1])
    seconds = (time.perf_counter() - start) / len(places)
    row = {"worlds": len(seeds), "step_ms": 1e3 * seconds, **errors(places, right)}
    env.close()
    return row | {"diverged": env.n_diverged}


def joined(futures: list[Future[Any]]) -> Any:
    """Return what all of them played, (steps, n, 3)."""
    return np.concatenate([future.result() for future in futures], 1)


def errors(places: Any, right: list[Future[Any]]) -> dict[str, float]:
    """Return how far objects are from where they should be, from touch on, and how many end alike."""
    exact = joined(right)
    far = 1e3 * np.linalg.norm(places - exact, axis=2)[28:]
    kept, right_kept = (np.linalg.norm(p[-1], axis=1) < 0.12 for p in (places, exact))
    row = {"median_mm": float(np.median(far)), "p90_mm": float(np.quantile(far, 0.9))}
    return row | {"same_outcome": float((kept == right_kept).mean())}


def score(hand: str, device: str, n: int, plain: dict[str, list[Future[Any]]]) -> dict[str, Any]:
    """Return success and touch in the batch and in MuJoCo, and the paired difference with its error."""
    row = together(hand, device, n)
    for name, futures in plain.items():
        part = row["layouts"][name]
        results = np.array([pair for future in futures for pair in future.result()], float)
        mine = np.array([part.pop("held"), part.pop("felt")], float).T
        for what, ours, theirs in zip(("success", "felt"), mine.T, results.T, strict=True):
            gap = ours - theirs
            part |= {what: ours.mean(), f"{what}_mujoco": theirs.mean()}
            part[f"{what}_difference"] = gap.mean()
            part[f"{what}_ci95"] = 1.96 * gap.std() / len(gap) ** 0.5
        part["same_outcome"] = float((mine[:, 0] == results[:, 0]).mean())
    return row


def main() -> None:
    """Measure what is not in the file yet."""
    flags = parser(__doc__)
    flags.add_argument("--device", default="cuda", help="PyTorch's for MuJoCo Warp, or loop: MuJoCo")
    flags.add_argument("--starts", type=count, default=2_000, help="of each hand and layout")
    flags.add_argument("--worlds", type=count, help="for speed, instead of 16,384 and 8,192")
    flags.add_argument("--hands", nargs="*", choices=CHOSEN, default=[*CHOSEN])
    options = flags.parse_args()
    device, n, hands = options.device, options.starts, options.hands
    name = torch.cuda.get_device_name() if device == "cuda" else device
    seeds = [SEED + i for i in range(n)]
    on_one_thread()
    speeds: dict[str, Callable[[], Any]] = {}
    for hand in hands:
        speeds[f"one CPU core, {hand}"] = partial(cpu_speed, hand)
        worlds = options.worlds or WORLDS[hand]
        speeds[f"speed, {hand}, {name}"] = partial(speed, hand, device, worlds)
    if device != "loop":
        worlds = options.worlds or WORLDS[hands[0]]
        speeds[f"deterministic, {hands[0]}, {name}"] = partial(repeats, hands[0], device, worlds)
    known = measure_missing(options.out, speeds)  # before anything else plays
    with processes(None) as pool:
        measures: dict[str, Callable[[], Any]] = {}
        for hand in hands:
            if (key := f"success, {hand}, {name}") not in known:
                plain = {
                    layout: [
                        pool.submit(alone, hand, path, seeds[i : i + 125]) for i in range(0, n, 125)
                    ]
                    for layout, path in layouts(hand).items()
                }
                measures[key] = partial(score, hand, device, n, plain)
        few = seeds[:256]
        parts = [few[i : i + 16] for i in range(0, len(few), 16)]
        key = f"settings, {hands[0]}"
        asked = [f"{key}, {name}, {ms}, {iterations}" for ms, iterations in SETTINGS]
        if not known.keys() >= {usually := f"{key}, MuJoCo, 4, 100", *asked}:
            exact, usual = (
                [pool.submit(reference, hands[0], timestep, part) for part in parts]
                for timestep in (0.001, 0.004)
            )
            measures[usually] = lambda: errors(joined(usual), exact)
            for setting_key, (ms, iterations) in zip(asked, SETTINGS, strict=True):
                measures[setting_key] = partial(
                    physics, hands[0], device, ms / 1000, iterations, few, exact
                )
        print(json.dumps(known | measure_missing(options.out, measures), indent=1))
