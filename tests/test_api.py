"""tactilerl as a library: the same bits as the command, policies that load by themselves, one line for
each mistake, and other people's tools."""

import json
import math
import pickle
import runpy
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import tactilerl
import torch
from tactilerl.runs import store

from one_line import printed, python
from states import TIMES

pytestmark = pytest.mark.usefixtures("in_tmp")
ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted(path for path in (ROOT / "examples").glob("*.py") if "# %%" in path.read_text())
PPO = dict(hidden=[16], steps_per_epoch=120, n_passes=2)
HER = dict(hidden=[16], n_cycles=2, n_batches=4, n_test_rollouts=1, batch_size=32)
LEARNERS = [("PPO", "lqr", PPO | {"recipe": "steady"}, 200), ("DDPGHER", "point-reach", HER, 150)]


class Short(gym.Env):
    """Ends after ten steps; what it says can be spoilt."""

    def __init__(self, obs=(2,), action=(1,), high=1.0, info=()):
        def space(shape, high):
            is_shape = isinstance(shape, tuple)
            return gym.spaces.Box(-high, high, shape, np.float32) if is_shape else shape

        self.observation_space, self.action_space = space(obs, 1), space(action, high)
        self.info, self.steps = info, 0

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        assert np.shape(action) == self.action_space.shape
        self.steps += 1
        info = {} if self.info == () else self.info
        return self.observation_space.sample(), 0.0, self.steps == 10, False, info


SHORT = dict(hidden=[8], steps_per_epoch=20, n_passes=1)


def short(*args, **choices):
    return tactilerl.PPO(Short(*args, **choices), **SHORT)


def with_nan():
    policy = short().policy()
    for parameter in policy.network.parameters():
        parameter.data[:] = math.nan
    return policy


def without_goal():
    parts = {"observation": 2, "achieved_goal": 0, "desired_goal": 0}
    return Short(gym.spaces.Dict({name: gym.spaces.Box(-1, 1, (n,)) for name, n in parts.items()}))


def test_pytorchs_own_generator_is_left_alone():
    before = torch.random.get_rng_state()
    learner = short()
    learner.save("policy.pt")
    tactilerl.evaluate(tactilerl.load_policy("policy.pt"), Short(), episodes=2)
    assert torch.equal(torch.random.get_rng_state(), before)


def observations(env, n=7):
    """(single ones, the same as a batch)"""
    space = tactilerl.make(env).observation_space
    space.seed(0)
    single = [space.sample() for _ in range(n)]
    if isinstance(single[0], dict):
        return single, {key: np.stack([obs[key] for obs in single]) for key in single[0]}
    return single, np.stack(single)


def flags(choices):
    """As keywords of `tactilerl train`, to the command's arguments."""
    for name, value in choices.items():
        yield f"--{name.replace('_', '-')}"
        yield from map(str, value if isinstance(value, list) else [value])


def same(rows, others):
    def steady(row):
        return {key: str(value) for key, value in row.items() if key not in TIMES}

    return list(map(steady, rows)) == list(map(steady, others))


def run_python(code):
    done = python("-c", code)
    assert done.returncode == 0, done.stderr


class TestLearner:
    @pytest.mark.parametrize(("name", "env", "choices", "steps"), LEARNERS)
    def test_learns_saves_loads_and_acts_like_the_command(self, name, env, choices, steps, capsys):
        algo = {"PPO": "ppo", "DDPGHER": "ddpg_her"}[name]
        wanted = ["--algo", algo, "--env", env, "--total-timesteps", steps, "--out", "run"]
        printed(capsys, ["train", *wanted, "--seed", "3", *flags(choices)])
        torch.set_num_threads(2)
        told = json.loads(printed(capsys, ["evaluate", "run", "--episodes", "5", "--json"]))
        assert torch.get_num_threads() == 1  # as it was trained

        made = tactilerl.make(env)
        agent = getattr(tactilerl, name)(made, **choices, seed=3).learn(steps)
        agent.save("policy.pt")
        singles, batch = observations(env)
        policies = [agent.policy(), tactilerl.load_policy("policy.pt"), tactilerl.load_policy("run")]
        for policy in [*policies, pickle.loads(pickle.dumps(policies[1]))]:
            for obs in singles:
                np.testing.assert_array_equal(policy.act(obs), policies[0].act(obs))
            np.testing.assert_allclose(policy.act(batch), np.stack([*map(policy.act, singles)]), 1e-4)
        result = tactilerl.evaluate(policies[1], made, episodes=5)
        assert result == {key: told[key] for key in result}
        assert len(told) == len(result) + 5  # which run, how far, with noise or not, each episode

    def test_env_stays_open_and_is_played_in_as_it_is_wrapped(self):
        class Counted(gym.Wrapper):
            steps = closed = 0

            def step(self, action):
                assert self.action_space.contains(action.astype(np.float32))
                self.steps += 1
                return super().step(action)

            def close(self):
                self.closed += 1

        env = Counted(gym.wrappers.RescaleAction(gym.make("Pendulum-v1"), -1.0, 1.0))
        agent = tactilerl.PPO(env, **PPO)
        agent.learn(1)
        assert env.steps == agent.env_steps == 200
        tactilerl.evaluate(agent.policy(), env, episodes=1)
        agent.close()
        assert (env.steps, env.closed) == (400, 0)

    def test_learning_again_goes_on_and_a_callback_ends_it(self):
        whole, rows = tactilerl.PPO("lqr", **PPO), []
        whole.learn(360, callback=rows.append)
        assert [row["epoch"] for row in rows] == [1, 2, 3]
        parts, again = tactilerl.PPO("lqr", **PPO), []
        parts.learn(240, callback=lambda row: again.append(row) or len(again) < 1)
        assert parts.env_steps == 120
        obs, taken = np.array([0.1, 0.2], np.float32), parts.policy()
        before = taken.act(obs)
        parts.learn(1, callback=again.append).learn(1, callback=again.append)
        assert same(rows, again)
        assert np.array_equal(whole.policy().act(obs), parts.policy().act(obs))
        assert not np.array_equal(parts.policy().act(obs), before)
        assert np.array_equal(taken.act(obs), before)  # a policy stays as it was taken

    def test_anybodys_policy_is_played(self):
        class Still:
            def predict(self, obs, state=None, deterministic=False):
                assert deterministic
                return np.zeros(2), state

        steered = tactilerl.evaluate(lambda obs: -0.1 * obs[:1], "lqr", episodes=3)
        left_alone = tactilerl.evaluate(lambda obs: [0.0], "lqr", episodes=3)
        assert steered["mean_return"] > left_alone["mean_return"]
        assert tactilerl.evaluate(Still(), "point-reach", episodes=2)["success_rate"] == 0

    @pytest.mark.parametrize("said", [True, False])
    def test_success_is_read_by_its_other_name(self, said):
        result = tactilerl.evaluate(short(), Short(info={"success": said}), episodes=2)
        assert json.loads(json.dumps(result))["success_rate"] == float(said)

    def test_progress_is_what_the_command_shows(self, capsys):
        tactilerl.PPO("lqr", **PPO).learn(120)
        assert capsys.readouterr().out == ""
        tactilerl.PPO("lqr", **PPO).learn(120, progress=True)
        assert "epoch    1  steps 120/120" in capsys.readouterr().out

    def test_threads_are_only_its_own(self):
        """Also of what computes beside, or results would depend on the workers."""
        torch.set_num_threads(2)
        agent, seen = tactilerl.PPO(lambda: tactilerl.make("lqr"), workers=2, **PPO), []
        agent.learn(1, callback=lambda row: seen.append(torch.get_num_threads()))
        seen.append(agent._learner.in_two_threads(int, torch.get_num_threads)[1])
        agent.close()
        assert seen == [1, 1]
        assert torch.get_num_threads() == 2


class TestTrain:
    def test_makes_and_goes_on_with_a_run_folder(self, capsys):
        run = tactilerl.train("lqr", out="run", total_timesteps=1, **PPO)
        assert run == Path("run")
        assert "epoch    1  steps 120/1" in capsys.readouterr().out
        command = ["train", "--env", "lqr", "--total-timesteps", "1", "--out", "other", *flags(PPO)]
        printed(capsys, command)
        one, other = (
            torch.load(f"{folder}/checkpoint.pt", weights_only=True)["ranks"][0]["actor"]
            for folder in (run, "other")
        )
        assert all(map(torch.equal, one.values(), other.values()))
        with pytest.raises(ValueError, match="env: found 'point-reach', the run was made with 'lqr'"):
            tactilerl.train("point-reach", resume=run)
        assert tactilerl.train(resume=run, total_timesteps=121) == run
        assert len(Path("run/progress.csv").read_text().splitlines()) == 3


MISTAKES = [
    (lambda: tactilerl.train("lqr", gamma=2), r"gamma: found 2.0, allowed \[0, 1\]"),
    (lambda: tactilerl.train(Short()), "env: found <"),
    (lambda: tactilerl.train("lqr", resume=""), "resume: found '', allowed a folder"),
    (lambda: tactilerl.make("zork:Env-v0"), "No module named 'zork'"),
    (lambda: tactilerl.PPO(lambda: gym.make("Pendulum-v1"), workers=2), "or give workers=1"),
    (lambda: tactilerl.PPO("lqr", clip_rang=1), "clip_rang: unknown; did you mean clip_range?"),
    (lambda: tactilerl.make("shadow", laout=4), "laout: unknown; did you mean layout?"),
    (lambda: tactilerl.PPO(3), "env: found int, allowed an environment, an id or a function"),
    (lambda: tactilerl.PPO(tactilerl.make("lqr"), workers=2), "workers: found 2 with one"),
    (lambda: tactilerl.evaluate(short(), Short(), workers=0), r"workers: found 0, allowed \[1, 256\]"),
    (lambda: tactilerl.PPO("lqr").save("no/folder.pt"), "cannot write 'no/folder.pt'"),
    (lambda: tactilerl.PPO("lqr").policy().act([1, 2, 3]), r"\(3,\), expected \(2,\), or a batch"),
    (lambda: tactilerl.PPO("lqr").policy().act([1, np.nan]), "obs: not finite"),
    (lambda: tactilerl.PPO("lqr").policy().act(([1, 2], {})), r"found a tuple, expected \(2,\)"),
    (lambda: tactilerl.DDPGHER("point-reach").policy().act([1, 2]), "found a list, expected {'observ"),
    (lambda: tactilerl.evaluate(short(), "point-reach"), r"env: found observations of shape .* \(2,\)"),
    (lambda: tactilerl.evaluate("policy.pt", "lqr"), "policy: found str, allowed what load_policy"),
    (lambda: tactilerl.PPO("handover"), "did you mean scene='handover' .* tactilerl/Handover-v0"),
    (lambda: short(action=gym.spaces.Box(-3e38, 3e38, (1,))), "Box of floats with finite bounds"),
    (lambda: tactilerl.make("lqr", layout=3), "'lqr' cannot be made here .*'layout'"),
    (lambda: tactilerl.evaluate(short(), Short(high=2.0)), r"actions Box\(-2.0, 2.0, .* has Box\(-1.0"),
    (lambda: with_nan().act(np.zeros(2)), "policy: its action is not finite"),
    (lambda: short(obs=gym.spaces.Box(0, 255, (8, 8, 3), np.uint8)), "images"),
    (lambda: short(obs=gym.spaces.Dict(a=gym.spaces.Box(-1, 1, (2,)))), "FlattenObservation"),
    (lambda: tactilerl.DDPGHER(without_goal()), "allowed a goal environment's"),
    (lambda: tactilerl.evaluate(lambda obs: [math.nan], "lqr"), r"policy: its action: found \[nan\]"),
]


class TestMistakes:
    @pytest.mark.parametrize(("make", "words"), MISTAKES)
    def test_are_value_errors_of_one_line_and_leave_nothing(self, make, words):
        with pytest.raises(ValueError, match=words) as raised:
            make()
        assert "\n" not in str(raised.value)
        assert not list(Path().iterdir())

    @pytest.mark.parametrize(
        ("method", "returned", "words"),
        [
            ("step", (np.zeros(3), 0.0, False, False, {}), r"obs: found shape \(3,\), expected \(2,\)"),
            (
                "step",
                (np.zeros((1, 2)), 0.0, False, False, {}),
                "obs: found a batch, allowed one observation",
            ),
            ("reset", (1, 2, 3), "too many values to unpack"),
        ],
    )
    def test_what_an_environment_should_not_return_is_said(self, method, returned, words):
        env = tactilerl.make("lqr").unwrapped
        setattr(env, method, lambda *args, **kwargs: returned)
        with pytest.raises(ValueError, match=words):
            tactilerl.PPO(env, **PPO).learn(100)

    def test_an_episode_without_an_end_is_said(self, monkeypatch):
        monkeypatch.setattr("tactilerl.algos.rollout.MAX_LENGTH", 50)
        pendulum = gym.make("Pendulum-v1")  # 200 steps, which are endless here
        with pytest.raises(ValueError, match=r"goes on after 50 steps.*max_episode_steps"):
            tactilerl.PPO(pendulum, **PPO).learn(10)

    @pytest.mark.slow
    def test_a_script_that_starts_processes_without_its_guard(self):
        Path("script.py").write_text(
            "import tactilerl\ntactilerl.PPO('Pendulum-v1', workers=2, steps_per_epoch=20)\n"
        )
        result = python("script.py")
        assert result.returncode == 1
        assert 'needs `if __name__ == "__main__":`' in result.stderr

    def test_a_damaged_policy_is_refused(self):
        tactilerl.PPO("lqr", **PPO).save("policy.pt")
        whole = torch.load("policy.pt", weights_only=True)
        for change in (dict(policy_format=99), dict(algo="sac"), dict(spaces="[]"), dict(state={})):
            store.write_tensors(Path("bad.pt"), {**whole, **change})
            with pytest.raises(ValueError, match=r"bad\.pt: (damaged|not a policy)") as raised:
                tactilerl.load_policy("bad.pt")
            assert "\n" not in str(raised.value)
        Path("bad.pt").write_bytes(Path("policy.pt").read_bytes()[:-100])
        with pytest.raises(ValueError, match=r"bad\.pt: not a policy"):
            tactilerl.load_policy("bad.pt")


class TestPolicy:
    def test_exploring_needs_a_generator_and_follows_from_it(self):
        policy, obs = tactilerl.PPO("lqr").policy(), [[0.1, 0.2], [0.3, 0.4]]
        explored = [policy.act(obs, False, np.random.default_rng(seed)) for seed in (1, 1, 2)]
        assert np.array_equal(explored[0], explored[1])
        assert not np.array_equal(explored[0], explored[2])
        assert not np.array_equal(explored[0], policy.act(obs))

    def test_actions_have_the_environments_shape_and_range(self):
        class Shaped(gym.Env):
            observation_space = gym.spaces.Box(-1.0, 1.0, (2, 3))
            action_space = gym.spaces.Box(np.full((2, 2), 5.0), np.full((2, 2), 6.0), dtype=np.float64)

        tactilerl.PPO(Shaped()).save("policy.pt")
        policy = tactilerl.load_policy("policy.pt")
        assert policy.act(np.zeros((2, 3))).shape == (2, 2)
        actions = policy.act(np.zeros((2, 2, 3)))
        assert actions.shape == (2, 2, 2)
        assert actions.dtype == np.float64
        assert ((actions >= 5) & (actions <= 6)).all()

    @pytest.mark.slow
    def test_loading_makes_no_environment_and_no_simulator(self):
        tactilerl.train("lqr", out="run", total_timesteps=1, **PPO)
        tactilerl.PPO("lqr", **PPO).save("policy.pt")
        run_python(
            """
import sys, tactilerl

for path in ("policy.pt", "run"):
    tactilerl.load_policy(path).act([0.1, 0.2])
    needless = {"mujoco", "tactilerl.runs.training", "tactilerl.envs.toy"}
    assert not needless & set(sys.modules), needless & set(sys.modules)
"""
        )


class TestImport:
    def test_importing_the_package_imports_nothing_and_gymnasium_knows_our_environments(self):
        run_python(
            """
import sys

before = set(sys.modules)
import tactilerl

new = set(sys.modules) - before
assert new == {"tactilerl", "tactilerl.version"}, new
import gymnasium

gymnasium.register_envs(tactilerl.envs)
gymnasium.make("tactilerl/LQR-v0").reset()
tactilerl.make("lqr")
assert "torch" not in sys.modules
"""
        )
        run_python("import gymnasium; gymnasium.make('tactilerl.envs:tactilerl/LQR-v0').reset()")

    def test_what_the_package_says_it_has_is_there(self):
        assert all(callable(getattr(tactilerl, name)) for name in tactilerl.__all__)
        with pytest.raises(AttributeError, match="'tactilerl' has no attribute 'nothing'"):
            _ = tactilerl.nothing


class TestExamples:
    def test_the_quickest_runs(self, monkeypatch, capsys):
        monkeypatch.setattr(sys, "argv", ["own_environment.py", "--steps", "1"])
        runpy.run_path(str(ROOT / "examples/own_environment.py"), run_name="__main__")
        assert "mean return" in capsys.readouterr().out

    @pytest.mark.slow
    @pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
    def test_runs(self, path, tmp_path):
        if path.stem == "train_and_film":
            pytest.importorskip("imageio")
        if "stable_baselines3" in path.stem:
            pytest.importorskip("stable_baselines3")
        result = python(str(path), "--steps", "60", MUJOCO_GL="egl", TMPDIR=str(tmp_path))
        assert result.returncode == 0, result.stderr
        assert "tactilerl: error" not in result.stderr, result.stderr


def test_an_unknown_keyword_is_pythons_error_and_ours():
    """TorchRL goes on only after the first."""
    for error in (TypeError, ValueError):
        with pytest.raises(error, match="got an unexpected keyword argument 'frameskip'"):
            gym.make("tactilerl/Handover-v0", frameskip=1)


def test_where_there_is_no_display():
    """The command says it in one line, and of a second picture as of the first."""
    pytest.importorskip("imageio.v2")
    code = "from tactilerl.commands import cli; pose = ['render', '--layout', '1']; "
    code += "print(cli.main(pose), cli.main(pose))"
    done = python("-c", code, MUJOCO_GL="glfw")
    first, second = done.stderr.splitlines()
    assert (done.stdout, second) == ("2 2\n", first)
    assert first.startswith("tactilerl: error: MuJoCo cannot draw here; without a display")


def test_windows_are_gymnasiums():
    with pytest.raises(ValueError, match="render_mode: found 'human', allowed: rgb_array"):
        tactilerl.make("shadow", render_mode="human")


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
