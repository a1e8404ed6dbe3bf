"""Nothing that is not asked for changes an episode: its bits are those of the first version that had
them, for both hands in both simulators and both tasks, and for objects of all kinds."""

import hashlib
from importlib.metadata import PackageNotFoundError, version

import numpy as np
import pytest

from tactilerl import envs
from tactilerl.envs import scripted

VERSIONS = {"mujoco": "4.0.0", "pybullet": "3.2.7"}  # other versions compute otherwise
SCENES = [
    *(
        (hand, simulator, {"task": task})
        for hand in ("shadow", "mpl")
        for simulator in ("mujoco", "pybullet")
        for task in ("lift-and-hold", "reach-goal")
    ),
    ("shadow", "mujoco", {"object": "sphere", "object_size": 0.045}),
    ("mpl", "mujoco", {"object": "cylinder", "object_size": (0.04, 0.05), "friction": 0.5}),
    ("shadow", "mujoco", {"object_size": (0.03, 0.04, 0.06), "object_density": 700.0}),
    ("mpl", "mujoco", {"object_size": 0.06, "task": "reach-goal", "reward": "dense"}),
    ("shadow", "mujoco", {"touch_rule": "contact", "touch": "on", "layout": "6"}),
    ("mpl", "pybullet", {"object": "sphere", "touch_rule": "contact", "layout": "1"}),
    ("shadow", "mujoco", {"touch_rule": "force", "history": 2, "observe_targets": True, "layout": "1"}),
    (
        "mpl",
        "mujoco",
        {"object_seen": "noisy", "joint_noise": 0.02, "taxel_delay": 1, "critic_sees": "truth"},
    ),
]
PINNED = [
    "1579f744550cd6c4",
    "518745aa274a433f",
    "a1359a70d79483ed",
    "8789b69ad8be8654",
    "df317bc4135b91b7",
    "aa5c54e4ab1d7210",
    "db0ffe237ec1af3c",
    "64e9445ef0516d51",
    "1cbef40b33e64e95",
    "f1c6cf31b16fc15c",
    "4fba65cadb6125ba",
    "ad2e047a649db87f",
    "2132484c307f8b00",
    "af03d54bbf055119",
    "118916f0cdf6e211",
    "d8b6c4aa8a2400f6",
]


def bits(hand, simulator, choices):
    """A hash of two seeded episodes of grasping at random: what is observed and rewarded."""
    env = envs.make(hand, simulator=simulator, hold_seconds=0.2, **choices)
    digest, n_actions = hashlib.sha256(), env.action_space.shape[0]
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        obs, _ = env.reset(seed=seed)
        for step in range(12):
            for key in sorted(obs):
                digest.update(obs[key].tobytes())
            down_then_up = np.concatenate([[0, 0, -0.4 if step < 7 else 1], np.zeros(n_actions - 3)])
            obs, reward, terminated, *_ = env.step(rng.uniform(-0.5, 1, n_actions) + down_then_up)
            digest.update(f"{reward:.4f} {terminated}".encode())
            if terminated:
                break
    env.close()
    return digest.hexdigest()[:16]


@pytest.mark.parametrize(("scene", "pinned"), list(zip(SCENES, PINNED, strict=True)), ids=str)
def test_an_episode_is_what_it_was(scene, pinned):
    hand, simulator, choices = scene
    try:
        found = version(simulator)
    except PackageNotFoundError:
        found = None
    if found != VERSIONS[simulator]:
        pytest.skip(f"pinned with {simulator} {VERSIONS[simulator]}, found {found}")
    assert bits(hand, simulator, choices) == pinned


HELD = {
    ("shadow", "full"): "3a28756e25fc649d",
    ("shadow", "settled"): "00c957ccfa3788cd",
    ("mpl", "full"): "082ae18aa6dab895",
    ("mpl", "settled"): "902d522f235d8e90",
}


@pytest.mark.parametrize(("hand", "verdict"), HELD)
def test_a_hold_test_is_what_it_was(hand, verdict):
    """Where it leaves the joints and the object of a scripted grasp."""
    if version("mujoco") != VERSIONS["mujoco"]:
        pytest.skip(f"pinned with mujoco {VERSIONS['mujoco']}")
    env = envs.make(hand, simulator="mujoco", layout="1", hold_seconds=1.3, hold_verdict=verdict)
    grasp = scripted.grasp_for(env)
    start = scripted.Offsets()
    for _ in scripted.hold_steps(env, grasp, start, 0.2):
        pass
    assert env.task.hold.run(env.simulator, env.simulator.state())
    assert hashlib.sha256(env.simulator.data.qpos.tobytes()).hexdigest()[:16] == HELD[hand, verdict]
