"""What other people's tools do with our environments, and what ours do with theirs."""

import json
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest

import tactilerl
import tactilerl.envs

TINY = {"hidden": (8,), "steps_per_epoch": 20, "n_passes": 1}


def test_an_unknown_keyword_is_pythons_error_and_ours():
    """TorchRL goes on only after the first."""
    for error in (TypeError, ValueError):
        with pytest.raises(error, match="got an unexpected keyword argument 'frameskip'"):
            gym.make("tactilerl/Handover-v0", frameskip=1)


def test_a_second_picture_without_a_display_fails_like_the_first():
    code = (
        "import tactilerl\nfor _ in range(3):\n env = tactilerl.make('shadow', render_mode='rgb_array')"
    )
    code += (
        "\n env.reset()\n try: env.render(); print('drawn')\n except OSError as e: print('cannot draw')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env={"MUJOCO_GL": "glfw", "PYTHONPATH": ":".join(sys.path)},
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert len(set(done.stdout.splitlines())) == 1


@pytest.mark.parametrize("name", ["lqr", "point-reach"])
def test_toys_take_a_render_mode(name):
    for mode in (None, "rgb_array"):
        env = (
            tactilerl.make(name, render_mode=mode) if mode else gym.make(f"tactilerl/{NAMES[name]}-v0")
        )
        env.reset(seed=0)
        picture = env.render()
        assert picture is None if mode is None else picture.shape == (64, 64, 3)


NAMES = {"lqr": "LQR", "point-reach": "PointReach"}


def test_a_step_before_the_first_reset_is_said():
    env = tactilerl.make("shadow", layout="5")
    with pytest.raises(gym.error.ResetNeeded, match="before the first reset"):
        env.step(env.action_space.sample())


class Odd(gym.Env):
    """Spaces and an info as others have them."""

    def __init__(self, obs=None, action=None, info=None):
        self.observation_space = obs or gym.spaces.Box(-1, 1, (2,))
        self.action_space = action or gym.spaces.Box(-1, 1, (1,))
        self.info = info or {}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.observation_space.sample() * 0, {}

    def step(self, action):
        self.steps += 1
        return self.observation_space.sample() * 0, 0.0, False, self.steps == 5, self.info


@pytest.mark.parametrize(
    ("choices", "words"),
    [
        ({"obs": gym.spaces.Box(0, 255, (8, 8, 3), np.uint8)}, "images"),
        ({"action": gym.spaces.Box(0, 5, (1,), np.int64)}, "Box of floats"),
        ({"obs": gym.spaces.Dict(a=gym.spaces.Box(-1, 1, (2,)))}, "FlattenObservation"),
    ],
)
def test_spaces_that_no_learner_reads_are_refused(choices, words):
    with pytest.raises(ValueError, match=words) as raised:
        tactilerl.PPO(Odd(**choices), **TINY)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("said", [True, False])
def test_success_is_read_by_its_other_name(said):
    result = tactilerl.evaluate(tactilerl.PPO(Odd(), **TINY), Odd(info={"success": said}), episodes=2)
    assert json.loads(json.dumps(result))["success_rate"] == float(said)


def test_a_wrapper_whose_statistics_are_lost_is_warned_of():
    with pytest.warns(UserWarning, match="normalise_obs"):
        tactilerl.PPO(gym.wrappers.NormalizeObservation(Odd()), **TINY)


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


def test_gymnasiums_max_episode_steps_is_the_tasks_own():
    envs = [
        gym.make("tactilerl/Shadow-v0", layout="5", max_episode_steps=3),
        tactilerl.make("shadow", layout="5", max_episode_steps=3),
    ]
    envs.append(gym.make(envs[0].spec))
    ends = []
    for env in envs:
        env.reset(seed=0)
        ends.append([env.step(np.zeros(23))[1:4] for _ in range(3)])
    assert ends[0] == ends[1] == ends[2]
    assert ends[0][-1][1:] == (True, False)
    with pytest.raises(ValueError, match="max_episode_steps: found 20, allowed 53 or more"):
        gym.make("tactilerl/Handover-v0", max_episode_steps=20)
    assert gym.make("tactilerl/Shadow-v0", layout="5").unwrapped.max_episode_steps == 100
