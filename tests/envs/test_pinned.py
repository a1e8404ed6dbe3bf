"""Nothing that is not asked for changes an episode: its bits are those of the first version with it."""

import hashlib
from importlib.metadata import PackageNotFoundError, version

import numpy as np
import pytest
from tactilerl import envs
from tactilerl.envs import scripted

VERSIONS = {"mujoco": "4.0.0", "pybullet": "3.2.7"}  # other versions compute otherwise
LIFT, REACH, CONTACT = {"task": "lift-and-hold"}, {"task": "reach-goal"}, {"touch_rule": "contact"}
CYLINDER = {"object": "cylinder", "object_size": (0.04, 0.05), "friction": 0.5}
CUBOID = {"object_size": (0.03, 0.04, 0.06), "object_density": 700.0}
FORCES = {"touch_rule": "force", "history": 2, "observe_targets": True, "layout": "1"}
NOISY = {"object_seen": "noisy", "joint_noise": 0.02, "taxel_delay": 1}
PINNED = [
    ("518745aa274a433f", "shadow", "mujoco", REACH),
    ("a1359a70d79483ed", "shadow", "pybullet", LIFT),
    ("8789b69ad8be8654", "shadow", "pybullet", REACH),
    ("aa5c54e4ab1d7210", "mpl", "mujoco", REACH),
    ("64e9445ef0516d51", "mpl", "pybullet", REACH),
    ("1cbef40b33e64e95", "shadow", "mujoco", {"object": "sphere", "object_size": 0.045}),
    ("f1c6cf31b16fc15c", "mpl", "mujoco", CYLINDER),
    ("4fba65cadb6125ba", "shadow", "mujoco", CUBOID),
    ("ad2e047a649db87f", "mpl", "mujoco", REACH | {"object_size": 0.06, "reward": "dense"}),
    ("2132484c307f8b00", "shadow", "mujoco", {**CONTACT, "touch": "on", "layout": "6"}),
    ("af03d54bbf055119", "mpl", "pybullet", {"object": "sphere", **CONTACT, "layout": "1"}),
    ("9833c33ee295ddc4", "shadow", "mujoco", FORCES),
    ("c0e75817eab66840", "mpl", "mujoco", NOISY),
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
    return digest.hexdigest()[:16]


@pytest.mark.parametrize(("pinned", "hand", "simulator", "choices"), PINNED, ids=str)
def test_an_episode_is_what_it_was(pinned, hand, simulator, choices):
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
