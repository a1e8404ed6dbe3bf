"""What other people's tools do with our environments, and what ours do with theirs."""

import json
import sys

import gymnasium as gym
import numpy as np
import pytest
import tactilerl

from one_line import python


def test_an_unknown_keyword_is_pythons_error_and_ours():
    """TorchRL goes on only after the first."""
    for error in (TypeError, ValueError):
        with pytest.raises(error, match="got an unexpected keyword argument 'frameskip'"):
            gym.make("tactilerl/Handover-v0", frameskip=1)


def test_a_second_picture_without_a_display_fails_like_the_first():
    code = (
        "import tactilerl\nfor _ in range(3):\n env = tactilerl.make('shadow', render_mode='rgb_array')"
    )
    code += "\n env.reset()\n try: env.render(); print('drawn')\n except OSError: print('cannot draw')"
    done = python("-c", code, MUJOCO_GL="glfw")
    assert done.returncode == 0, done.stderr
    assert len(set(done.stdout.splitlines())) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is a display")
def test_where_there_is_no_window():
    made = "import tactilerl; tactilerl.make('shadow', render_mode='human').reset(seed=0)"
    said = python("-c", made).stderr.splitlines()[-1]
    assert said.startswith("OSError: render_mode human: no window opens here (no display)")
    with pytest.raises(ValueError, match="render_mode: found 'human', allowed with simulator mujoco"):
        tactilerl.make("shadow", simulator="pybullet", render_mode="human").reset(seed=0)


def test_a_step_before_the_first_reset_is_said():
    env = tactilerl.make("shadow", layout="5")
    with pytest.raises(gym.error.ResetNeeded, match="before the first reset"):
        env.step(env.action_space.sample())


def test_info_has_the_same_keys_and_plain_values_at_every_step():
    """Minari records it then."""
    env = tactilerl.make(scene="handover", layout="5")
    _, first = env.reset(seed=0)
    kinds, is_over = {key: type(value) for key, value in first.items()}, False
    while not is_over:
        *_, terminated, truncated, info = env.step(env.action_space.sample())
        assert {key: type(value) for key, value in info.items()} == kinds
        is_over = terminated or truncated
    json.dumps(info)
    assert info["object"] == first["object"]
    env.simulator.data.qpos[5] = np.nan
    assert {key: type(value) for key, value in env.step([0.0])[-1].items()} == kinds
    env.close()


def test_stable_baselines3_evaluates_our_policies(tmp_path):
    """A learner and a loaded policy; the toys take render_mode=None, as its make_vec_env gives it."""
    evaluate_policy = pytest.importorskip("stable_baselines3.common.evaluation").evaluate_policy
    for name in ("tactilerl/LQR-v0", "tactilerl/PointReach-v0"):
        env = gym.make(name, render_mode=None)
        learner = tactilerl.PPO(env, steps_per_epoch=60, n_passes=1, hidden=(8,))
        learner.learn(60, tensorboard=tmp_path / "events")
        assert [*(tmp_path / "events").iterdir()]
        learner.save(tmp_path / "policy.pt")
        loaded = tactilerl.load_policy(tmp_path / "policy.pt")
        obs, _ = env.reset(seed=0)
        for policy in (learner.policy(), loaded):
            action, state = policy.predict(obs, deterministic=True)
            assert np.array_equal(action, policy.act(obs))
            assert state is None
            assert (policy.predict(obs)[0] != policy.predict(obs)[0]).any()
            assert np.isfinite(evaluate_policy(policy, env, n_eval_episodes=2)).all()
        with pytest.raises(ValueError, match="render_mode: found 'human', allowed None"):
            tactilerl.make(name, render_mode="human")
