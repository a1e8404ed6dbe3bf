"""What others' tools do with our environments, and our learners with theirs: a few real steps each."""

from __future__ import annotations

import os
import tempfile
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import tactilerl
import tactilerl.envs

from benchmarks.command import DATA, python
from benchmarks.peers.client_check import CHECKS, STEPS, Check, check, play

HANDOVER, SHADOW = "tactilerl/Handover-v0", "tactilerl/Shadow-v0"
TINY = {"hidden": (8,), "steps_per_epoch": STEPS, "n_passes": 1}


def flat(env_id: str = HANDOVER) -> gym.Env[Any, Any]:
    """With observations in a Box, for clients that know no Dict."""
    return gym.wrappers.FlattenObservation(gym.make(env_id))


# -- Gymnasium -------------------------------------------------------------------------------


@check("gymnasium")
def check_env() -> None:
    """`check_env`."""
    from gymnasium.utils.env_checker import check_env

    for name in (HANDOVER, SHADOW):
        check_env(gym.make(name).unwrapped, skip_render_check=True)


@check("gymnasium")
def vectors() -> None:
    """`make_vec`, synchronous and asynchronous."""
    for mode in ("sync", "async"):
        envs = gym.make_vec(HANDOVER, num_envs=2, vectorization_mode=mode)
        envs.reset(seed=0)
        for _ in range(STEPS):
            envs.step(envs.action_space.sample())
        envs.close()


@check("gymnasium")
def wrappers() -> None:
    """nine wrappers around each other."""
    w = gym.wrappers
    env = w.FilterObservation(w.TimeLimit(gym.make(HANDOVER), 60), ["observation"])
    env = w.TimeAwareObservation(w.FrameStackObservation(w.FlattenObservation(env), 2), flatten=True)
    env = w.ClipAction(w.RescaleAction(env, np.float32(-2), np.float32(2)))
    play(w.RecordEpisodeStatistics(w.NormalizeReward(env)))


# -- Stable-Baselines3 and its neighbours ----------------------------------------------------


def _sb3(name: str, env: Any = None, package: str = "stable_baselines3", **choices: Any) -> None:
    kind = getattr(import_module(package), name)
    env, policy = env or gym.make(HANDOVER), choices.pop("policy", "MultiInputPolicy")
    model = kind(policy, env, seed=0, device="cpu", **choices)
    model.learn(2 * STEPS)
    model.predict(model.get_env().reset())


@check("stable-baselines3")
def sb3_check_env() -> None:
    """`check_env`."""
    from stable_baselines3.common.env_checker import check_env

    check_env(gym.make(HANDOVER))


@check("stable-baselines3")
def sb3_ppo() -> None:
    """PPO, also with `SubprocVecEnv`."""
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import SubprocVecEnv

    _sb3("PPO", n_steps=STEPS, batch_size=STEPS)
    two = make_vec_env(f"tactilerl.envs:{HANDOVER}", 2, vec_env_cls=SubprocVecEnv)
    _sb3("PPO", two, n_steps=STEPS, batch_size=STEPS)


for _kind in ("SAC", "TD3"):
    _run = partial(_sb3, _kind, learning_starts=STEPS, buffer_size=1000)
    CHECKS[f"sb3_{_kind.lower()}"] = Check("stable-baselines3", _kind, _run)


@check("stable-baselines3")
def sb3_ddpg_her() -> None:
    """DDPG with `HerReplayBuffer`."""
    from stable_baselines3 import HerReplayBuffer

    env = gym.make(SHADOW, task="reach-goal")
    _sb3("DDPG", env, learning_starts=STEPS, buffer_size=1000, replay_buffer_class=HerReplayBuffer)


@check("sb3-contrib")
def sb3_contrib() -> None:
    """TQC, RecurrentPPO."""
    _sb3("TQC", package="sb3_contrib", learning_starts=STEPS, buffer_size=1000)
    lstm = {"policy": "MultiInputLstmPolicy", "n_steps": STEPS, "batch_size": STEPS}
    _sb3("RecurrentPPO", package="sb3_contrib", **lstm)


@check("rl-zoo3")
def zoo() -> None:
    """`train` and `enjoy`, PPO."""
    with tempfile.TemporaryDirectory() as folder:
        told = ["--algo", "ppo", "--env", HANDOVER, "--gym-packages", "tactilerl.envs", "-f", folder]
        settings = ["policy:'MultiInputPolicy'", f"n_steps:{STEPS}", f"batch_size:{STEPS}"]
        settings += [f"n_timesteps:{STEPS}"]
        config = Path(folder, "ppo.yml")
        lines = "".join(f"  {each.replace(':', ': ')}\n" for each in settings)
        config.write_text(f"{HANDOVER}:\n{lines}", encoding="utf-8")
        for module, more in (
            ("rl_zoo3.train", ["-conf", str(config), "--device", "cpu"]),
            ("rl_zoo3.enjoy", ["-n", str(STEPS), "--no-render", "--device", "cpu"]),
        ):
            python("-m", module, *told, *more)


# -- other libraries -------------------------------------------------------------------------


@check("skrl")
def skrl() -> None:
    """PPO, flat observations."""
    import torch
    from skrl.agents.torch.ppo import PPO, PPO_CFG
    from skrl.envs.wrappers.torch import wrap_env
    from skrl.memories.torch import RandomMemory
    from skrl.trainers.torch import SequentialTrainer
    from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model

    env = wrap_env(flat())
    spaces = dict(observation_space=env.observation_space, action_space=env.action_space)
    net = [{"name": "net", "input": "OBSERVATIONS", "layers": [8], "activations": "elu"}]
    models = {
        "policy": gaussian_model(**spaces, device="cpu", network=net, output="ACTIONS"),
        "value": deterministic_model(**spaces, device="cpu", network=net, output="ONE"),
    }
    memory = RandomMemory(memory_size=STEPS, num_envs=1, device="cpu")
    config = PPO_CFG(rollouts=STEPS, learning_epochs=1, mini_batches=1)
    agent = PPO(models=models, memory=memory, cfg=config, device=torch.device("cpu"), **spaces)
    trainer = {"timesteps": 2 * STEPS, "headless": True, "disable_progressbar": True}
    SequentialTrainer(cfg=trainer, env=env, agents=agent).train()


@check("tianshou")
def tianshou() -> None:
    """vectors of environments, in turn and in processes."""
    from tianshou.env import DummyVectorEnv, SubprocVectorEnv

    for kind in (DummyVectorEnv, SubprocVectorEnv):
        envs = kind([flat, flat])
        envs.reset()
        for _ in range(20):
            envs.step(np.array([space.sample() for space in envs.action_space]))
        envs.close()


@check("torchrl")
def torchrl() -> None:
    """`GymEnv`: `check_env_specs`, rollouts, `SerialEnv`."""
    from torchrl.envs import GymEnv, SerialEnv
    from torchrl.envs.utils import check_env_specs

    env = GymEnv(HANDOVER)
    check_env_specs(env)
    env.rollout(STEPS)
    SerialEnv(2, lambda: GymEnv(HANDOVER)).rollout(20)


@check("minari")
def minari() -> None:
    """a data set with infos, written and read."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["MINARI_DATASETS_PATH"] = folder
        import minari

        env = minari.DataCollector(gym.make(HANDOVER), record_infos=True)
        for seed in range(3):
            env.reset(seed=seed)
            is_over = False
            while not is_over:
                *_, terminated, truncated, _ = env.step(env.action_space.sample())
                is_over = terminated or truncated
        made = env.create_dataset("tactilerl/handover-v0", algorithm_name="random")
        env.close()
        assert made.total_episodes == 3
        episode = next(minari.load_dataset("tactilerl/handover-v0").iterate_episodes())
        assert len(episode.rewards) == len(episode.actions)


@check("rliable")
def rliable() -> None:
    """IQM with intervals, from a report's `scores.npz`."""
    from rliable import library, metrics

    with tempfile.TemporaryDirectory() as folder:
        python("-m", "tactilerl", "study", "report", str(DATA / "faults.tar.gz"), "--out", folder)
        scores = dict(np.load(next(Path(folder).rglob("scores.npz"))))
    found, intervals = library.get_interval_estimates(
        scores, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=100
    )
    assert found.keys() == intervals.keys() == scores.keys()


# -- our learners in their environments ------------------------------------------------------


def _train(register: str, *names: str) -> None:
    """PPO learns a little in each environment that the package registers."""
    import_module(register)
    for name in names:
        env = gym.make(name)
        tactilerl.PPO(env, **TINY).learn(STEPS)
        env.close()


for _name, _package, *_ids in (
    ("half_cheetah", "gymnasium", "HalfCheetah-v5", "Pusher-v5"),
    ("maze", "gymnasium-robotics", "PointMaze_UMaze-v3"),
    ("adroit", "gymnasium-robotics", "AdroitHandDoor-v1"),
    ("fetch", "gymnasium-robotics", "FetchReach-v4"),
    ("hand", "gymnasium-robotics", "HandManipulateBlock_BooleanTouchSensors-v1"),
):
    _what = f"our PPO in {' and '.join(_ids)}"
    CHECKS[_name] = Check(_package, _what, partial(_train, _package.replace("-", "_"), *_ids))


@check("dm-control")
def dm_control() -> None:
    """`suite.load`, a step."""
    from dm_control import suite

    env = suite.load("cartpole", "balance")
    env.reset()
    env.step(env.action_spec().generate_value())
