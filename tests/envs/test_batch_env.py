"""A batch of worlds plays what GraspEnv plays."""

import importlib
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import tactilerl
import torch
from tactilerl import envs
from tactilerl.envs import tasks
from tactilerl.envs.batch import BatchEnv
from tactilerl.envs.grasp import GraspConfig, GraspEnv

CHOSEN = Path(__file__).parents[2] / "docs/data/chosen/mpl_touch_8.toml"
NOISY = dict(object_seen="noisy", joint_noise=0.02, joint_noise_held=0.05, slide_noise=0.001)
FAULTS = dict(
    taxel_false_on=0.02,
    taxel_false_off=0.1,
    taxel_dead=0.1,
    taxel_stuck=0.05,
    taxel_delay=2,
    hand_seed=3,
)


def config(hand: str, scene: str = "handover_anywhere", **choices: Any) -> GraspConfig:
    """Return a scene's configuration on a hand, in MuJoCo."""
    env: Any = envs.make(hand, scene=scene, simulator="mujoco", **choices)
    return env.unwrapped.config


def play(env: Any, seed: int, actions: Any) -> list[Any]:
    """Return an episode's (obs, reward, terminated, truncated, is_success), the start first."""
    obs, _ = env.reset(seed=seed)
    steps = [(obs, 0.0, False, False, False)]
    while not any(steps[-1][2:4]):
        obs, *rest, info = env.step(actions(seed, len(steps)))
        steps.append((obs, *rest, info["is_success"]))
    return steps


def play_batch(env: BatchEnv, seeds: list[int], actions: Any) -> list[list[Any]]:
    """Return the same of one episode in each world."""
    obs, info = env.reset(seed=seeds)
    episodes = [[(row(obs, i), 0.0, False, False, False)] for i in range(len(seeds))]
    over = np.zeros(len(seeds), bool)
    while not over.all():
        acts = [actions(seed, len(steps)) for seed, steps in zip(seeds, episodes, strict=True)]
        obs, reward, terminated, truncated, info = env.step(np.array(acts))
        results = *(part.numpy() for part in (reward, terminated, truncated)), info["is_success"]
        for i in np.flatnonzero(~over & ~info["holding"]):
            episodes[i].append((row(obs, i), *(part[i] for part in results)))
        over |= results[1] | results[2]
    return episodes


def row(obs: Any, i: int) -> Any:
    return {key: value[i].numpy().copy() for key, value in obs.items()}


def act(hand_closes_at: int, size: int) -> Any:
    """Return a rule of actions that closes the hand from some step on, with a little noise."""

    def actions(seed: int, step: int) -> Any:
        noise = 0.1 * np.random.default_rng([seed, step]).standard_normal(size)
        return np.clip(np.where(step < hand_closes_at + seed % 4, -0.2, 0.9) + noise, -1, 1)

    return actions


def assert_alike(
    hand: str, groups: list[GraspConfig], seeds: list[int], actions: Any, least: float = 0.0
) -> list[Any]:
    """Play the same episodes in a batch, two a group, and one by one."""
    batch = BatchEnv(hand, [(group, 2) for group in groups], "loop", autoreset=False)
    together = play_batch(batch, seeds, actions)
    returns = []
    for group, width, *pairs in zip(
        [g for g in groups for _ in "ab"],
        [one.observation_space["observation"].shape[0] for one in batch.singles for _ in "ab"],
        seeds,
        together,
        strict=True,
    ):
        seed, played = pairs
        env = GraspEnv(hand, group)
        alone = play(env, seed, actions)
        assert len(alone) == len(played), seed
        for (obs, *rest), (seen, *found) in zip(alone, played, strict=True):
            np.testing.assert_allclose(seen["observation"][:width], obs["observation"], atol=1e-5)
            assert not seen["observation"][width:].any()
            for goal in ("achieved_goal", "desired_goal"):
                np.testing.assert_allclose(seen[goal], obs[goal], atol=1e-6)
            np.testing.assert_allclose(found, rest, rtol=1e-6)
        returns.append(alone[-1][1])
        env.close()
    batch.close()
    return returns


@pytest.mark.parametrize(
    "hand", ["mpl", *(pytest.param(hand, marks=pytest.mark.slow) for hand in ("shadow", "allegro"))]
)
def test_handover_with_noise_in_groups_of_layouts_touch_and_faults(hand: str) -> None:
    first = config(hand, layout="1", **NOISY)
    groups = [
        first,
        replace(first, layout="5", **FAULTS),
        replace(first, layout="5", taxel_threshold=0.05, taxel_release=0.02),
        replace(first, touch="off"),
        replace(first, touch="absent"),
    ]
    returns = assert_alike(hand, groups, list(range(10)), act(15, 1))
    assert {-100.0, 1000.0} & set(returns)


def grasp(seed: int, step: int) -> Any:
    """Return actions of the MPL hand that lower it, close it and lift what it has."""
    down = 2 + seed % 3
    return np.array(
        [0, 0, -1.0 if step <= down else float(step > down + 15), *[float(step > down)] * 4]
    )


def swing(seed: int, step: int) -> Any:
    """Return actions of every joint of the Shadow Hand."""
    return np.random.default_rng([seed, step]).uniform(-1, 1, 23)


SHORT = dict(object_size="0.04..0.05", max_episode_steps=15, history=3)
WEAK = dict(taxel_noise=0.1, taxel_false_off=0.2)
HELD = {"full": dict(hold_seconds=2.0), "settled": dict(hold_verdict="settled")}


@pytest.mark.parametrize(
    ("hand", "choices", "actions", "returns"),
    [
        ("mpl", dict(object_size=0.04, **HELD["full"]), grasp, 1000.0),
        ("mpl", dict(object_size=0.04, **HELD["settled"], taxel_threshold=0.1), grasp, 1000.0),
        ("mpl", dict(object="cylinder", touch_rule="force", **WEAK, **SHORT), grasp, -100.0),
        ("mpl", dict(object="capsule", skin_thickness=0.003, **SHORT), grasp, -100.0),
        ("mpl", dict(object="ellipsoid", friction="0.5..1", **SHORT), grasp, -100.0),
        ("shadow", dict(object="sphere", sight_noise_kind="held", **SHORT, **NOISY), swing, -100.0),
        ("shadow", dict(task="reach-goal", reward="dense", object_seen="start"), swing, None),
    ],
    ids=["full hold", "settled hold", "force", "soft", "ellipsoid", "late", "goals"],
)  # fmt: skip
def test_tasks_of_the_paper(hand: str, choices: Any, actions: Any, returns: float | None) -> None:
    env: Any = envs.make(hand, simulator="mujoco", **choices)
    first = env.unwrapped.config
    found = assert_alike(hand, [first, replace(first, layout="5", touch="on")], [0, 1, 2, 3], actions)
    assert returns is None or returns in found


@pytest.mark.parametrize("autoreset", [True, False])
def test_a_next_episode_is_the_one_of_grasp_env(autoreset: bool) -> None:
    first = config("mpl", layout="1", joint_noise_held=0.01)
    batch: Any = BatchEnv("mpl", [(first, 2)], "loop", autoreset)
    env, rule = GraspEnv("mpl", first), act(15, 1)
    batch.reset(seed=[7, 8])
    play(env, 7, rule)
    again, _ = env.reset()
    is_over = False
    for step in range(1, 80):
        obs, _, terminated, truncated, _ = batch.step(np.array([rule(7, step), rule(8, step)]))
        if is_over:
            break
        is_over = bool(terminated[0] | truncated[0])
    if not autoreset:
        assert not terminated[0]
        obs, _ = batch.reset(options={"reset_mask": np.array([True, False])})
    np.testing.assert_allclose(obs["observation"][0], again["observation"], atol=1e-5)


def test_noise_after_a_reset_in_the_middle_is_the_one_of_grasp_env() -> None:
    choices = dict(object_seen="noisy", joint_noise=0.02, layout="5", taxel_false_on=0.3)
    reach: Any = dict(task="reach-goal", max_episode_steps=40, touch="on")
    made: Any = envs.make("shadow", simulator="mujoco", **reach, **choices)
    first = made.unwrapped.config
    other = replace(first, layout="6")  # has begun no episode yet while the first group plays
    batch: Any = BatchEnv("shadow", [(first, 2), (other, 1)], "loop", autoreset=False)
    alone = [GraspEnv("shadow", config) for config in (first, first, other)]
    begins, playing = {0: [0, 1], 5: [1], 8: [2]}, set[int]()
    for step in range(40):
        for i in begins.get(step, []):
            batch.reset(seed=step + i, options={"reset_mask": np.arange(3) == i})
            alone[i].reset(seed=step + 2 * i)
            playing.add(i)
        obs, *_ = batch.step(np.zeros((3, 23)))
        for i in playing:
            env = alone[i]
            expected = env.step(np.zeros(23))[0]["observation"]
            np.testing.assert_allclose(row(obs, i)["observation"], expected, atol=1e-5)


def test_scenes_that_do_not_go_together_are_named() -> None:
    first = config("mpl")
    with pytest.raises(ValueError, match="groups: found scenes that differ, allowed in: hand_seed"):
        BatchEnv("mpl", [(first, 1), (replace(first, friction=0.5), 1)], "loop")
    with pytest.raises(ValueError, match="touch_rule of a batch: found 'contact'"):
        BatchEnv("mpl", [(replace(first, touch_rule="contact"), 1)], "loop")
    batch = BatchEnv("mpl", [(first, 1)], "loop")
    batch.reset(seed=0)
    with pytest.raises(ValueError, match="action: found NaN"):
        batch.step([[np.nan]])


def test_a_world_that_diverges_ends_alone() -> None:
    first = config("mpl")
    batch: Any = BatchEnv("mpl", [(first, 2)], "loop", autoreset=False)
    batch.reset(seed=0)
    before, *_ = batch.step(np.zeros((2, 1)))
    batch.simulator.worlds[1].data.qvel[:] = np.nan
    obs, reward, terminated, truncated, info = batch.step(np.zeros((2, 1)))
    assert info["diverged"].tolist() == truncated.tolist() == [False, True]
    assert not terminated.any()
    assert not reward.any()
    np.testing.assert_array_equal(obs["observation"][1], before["observation"][1])
    assert obs["observation"].isfinite().all()
    assert batch.n_diverged == 1


def test_by_name() -> None:
    """Worlds are shared out between layouts, and Gymnasium finds the batch by a scene's id."""
    batch = tactilerl.make_vec(
        scene="handover", simulator="mujoco", num_envs=5, layouts=(1, 5), device="loop"
    )
    obs, _ = batch.reset(seed=0)
    assert obs["observation"].shape == (5, batch.single_observation_space["observation"].shape[0])
    assert obs["observation"].dtype == torch.float32
    batch.close()
    found: Any = gym.make_vec(
        "tactilerl/HandoverBatch-v0", num_envs=2, vectorization_mode="vector_entry_point", device="loop"
    )
    assert isinstance(found, BatchEnv)
    found.reset(seed=0)
    found.step(found.action_space.sample())
    found.close()
    with pytest.raises(ValueError, match="num_envs: found 1"):
        tactilerl.make_vec("mpl", simulator="mujoco", num_envs=1, layouts=(1, 5), device="loop")
    if not torch.cuda.is_available():
        with pytest.raises((ValueError, ImportError), match=r"found no (GPU|MuJoCo Warp)"):
            tactilerl.make_vec("mpl", simulator="mujoco")


def test_copies_of_a_layout_are_one(tmp_path: Path) -> None:
    """As the runs of a study have them, once they have begun."""
    text = CHOSEN.read_text()
    groups = []
    for name in ("a", "b", "c"):
        (file := tmp_path / f"{name}.toml").write_text(text if name < "c" else text + "# another\n")
        groups.append((config("mpl", layout=str(file)), 1))
    batch = BatchEnv("mpl", groups, "loop")
    assert batch.singles[0] is batch.singles[1] is not batch.singles[2]
    batch.close()


@pytest.mark.slow
def test_warp_on_the_cpu_plays_what_mujoco_plays() -> None:
    pytest.importorskip("mujoco_warp")
    first = config("mpl", layout="1", **NOISY)
    groups = [(first, 1), (replace(first, layout="5", taxel_threshold=0.05), 1)]
    ends = []
    for device in ("cpu", "loop"):
        batch = BatchEnv("mpl", groups, device, autoreset=False)
        episodes = play_batch(batch, [0, 1], act(15, 1))
        assert not batch.n_diverged
        ends.append([steps[-1][1:] for steps in episodes])
        starts = np.array([[step[0]["observation"] for step in steps[:16]] for steps in episodes])
        ends[-1].append(starts)
    np.testing.assert_allclose(ends[0].pop(), ends[1].pop(), atol=1e-4)
    assert ends[0] == ends[1]


def test_a_task_of_ones_own_is_played_too_where_it_says_so(monkeypatch: Any) -> None:
    """With its own object and its own entry of the observation."""
    examples = Path(__file__).parents[2] / "examples"
    monkeypatch.setattr(tasks, "TASKS", dict(tasks.TASKS))
    monkeypatch.syspath_prepend(str(examples))
    monkeypatch.delitem(sys.modules, "own_task", raising=False)
    cup = importlib.import_module("own_task").HoldCup
    first: Any = replace(config("mpl", str(examples / "own_task.toml"), finger_gain=1.0), **NOISY)
    assert "pressure on cup" in GraspEnv("mpl", first).observation_names()
    returns = assert_alike("mpl", [first], [0, 1], act(15, 1))
    assert set(returns) == {-100.0}  # crushed
    tasks.TASKS["hold-cup"] = type("Careful", (cup,), {})
    with pytest.raises(ValueError, match="task of a batch: found 'hold-cup', allowed: lift-and-hold,"):
        BatchEnv("mpl", [(first, 1)], "loop")
