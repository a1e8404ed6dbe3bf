"""Touch of another episode: where its readings come from, and what they depend on."""

import json
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from tactilerl import envs
from tactilerl.commands.cli import main
from tactilerl.envs import vector
from tactilerl.probe.reflexes import Reflex

from one_line import fails_with

N = 79  # taxels of layout 2
handover = partial(envs.make, scene="handover", layout="2", history=1)
SHORT = ["--touch", "shuffled", "--layout", "5", "--max-episode-steps", "8"]
PPO = ["--algo", "ppo", "--hidden", "8", "--steps-per-epoch", "20", "--n-passes", "1"]
HER = ["--algo", "ddpg_her", "--hidden", "8", "--n-cycles", "1", "--n-batches", "2"]
HER += ["--n-test-rollouts", "1", "--batch-size", "8"]


def waited(env, seed):
    """Observations (n, size) of a hand that waits."""
    seen = [env.reset(seed=seed)[0]["observation"]]
    is_over = False
    while not is_over:
        obs, _, terminated, truncated, _ = env.step_to(env.hand.start_targets())
        seen.append(obs["observation"])
        is_over = terminated or truncated
    return np.array(seen)


def test_taxels_are_those_of_the_episode_before_at_the_same_step():
    with closing(handover()) as env:
        felt = {seed: waited(env, seed) for seed in (1, 2)}
    assert len(felt[1]) > len(felt[2])
    with closing(handover(touch="shuffled", critic_sees="truth")) as env:
        shown = [waited(env, seed) for seed in (1, 2, 1)]
        for seed, observed in zip((1, 2, 1), shown, strict=True):
            np.testing.assert_array_equal(observed[:, :-N], felt[seed][:, :-N])
        assert not shown[0][:, -N:].any()
        np.testing.assert_array_equal(shown[1][:, -N:], felt[1][: len(shown[1]), -N:])
        longer = shown[2][:, -N:]
        np.testing.assert_array_equal(longer[: len(felt[2])], felt[2][:, -N:])
        assert (longer[len(felt[2]) :] == felt[2][-1, -N:]).all()
        obs, _ = env.reset(seed=3)
        np.testing.assert_array_equal(obs["truth"][-N:], env.taxel_readings())
        np.testing.assert_array_equal(env.told_readings(), obs["observation"][-N:])
        env.forget()
        assert not waited(env, 2)[:, -N:].any()


def told(env, number, is_wanted):
    """Taxels of an episode of random actions."""
    rng = np.random.default_rng(number % 2**64)
    seen, is_over = [env.reset(seed=number % 2**64)[0]["observation"][-N:]], False
    while not is_over and is_wanted():
        obs, _, terminated, truncated, _ = env.step(rng.uniform(-1, 1, env.action_space.shape))
        seen.append(obs["observation"][-N:])
        is_over = terminated or truncated
    return np.array(seen)


def test_they_do_not_depend_on_what_a_worker_has_played():
    with closing(vector.start(partial(handover, touch="shuffled"), 1)) as one:
        results = [list(one.play(told, numbers)) for numbers in (range(3), range(2, -1, -1))]
    with closing(vector.start(partial(handover, touch="shuffled"), 3)) as three:
        results += [list(three.play(told, range(3)))]
    for there, back, threads in zip(results[0], results[1][::-1], results[2], strict=True):
        np.testing.assert_array_equal(there, back)
        np.testing.assert_array_equal(there, threads)
    assert any(shown.any() for shown in results[0])


def test_a_reflex_that_goes_by_them_is_blind():
    with closing(vector.start(partial(handover, touch="shuffled"), 1)) as workers:
        assert sum(workers.play(Reflex("touch", 1, 1.0).play, range(10))) <= 6


@pytest.mark.parametrize("learner", [PPO, HER], ids=["ppo", "ddpg_her"])
def test_runs_are_the_same_however_they_are_played_and_go_on(learner, in_tmp, capsys):
    scene = ["--env", "shadow", "--task", "reach-goal", *SHORT]
    for workers in ("1", "3"):
        run = ["train", *learner, *scene, "--workers", workers, "--out", workers]
        assert main([*run, "--total-timesteps", "20" if workers == "1" else "40"]) == 0
    assert main(["train", "--resume", "1", "--total-timesteps", "40"]) == 0
    one, three = (torch.load(Path(name, "checkpoint.pt")) for name in ("1", "3"))
    for key, value in one["ranks"][0]["actor"].items():
        assert torch.equal(value, three["ranks"][0]["actor"][key])
    results = []
    for workers in ("1", "3"):
        capsys.readouterr()
        assert main(["evaluate", "1", "--episodes", "3", "--json", "--workers", workers]) == 0
        results.append(json.loads(capsys.readouterr().out))
    assert results[0] == results[1]


def test_policies_are_evaluated_with_other_touch(in_tmp, capsys):
    scene = ["--env", "shadow", "--task", "reach-goal", "--layout", "5", "--max-episode-steps", "6"]
    short = [*PPO, *scene, "--total-timesteps", "20", "--workers", "1"]
    main(["train", *short, "--out", "run"])
    main(["train", *short, "--touch", "absent", "--out", "absent"])
    few = ["--episodes", "2", "--workers", "1"]
    capsys.readouterr()
    assert main(["evaluate", "run", *few, "--touch", "shuffled", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sensors"] == {"touch": "shuffled"}
    swept = ["--sweep", "touch", "on", "off", "shuffled", "--json"]
    assert main(["evaluate", "run", *few, *swept]) == 0
    points = json.loads(capsys.readouterr().out)["points"]
    assert [point["touch"] for point in points] == ["on", "off", "shuffled"]
    assert main(["evaluate", "run", *few, "--sweep", "taxel-delay", "0", "500"]) == 0
    fails_with(capsys, ["evaluate", "absent", *few, "--touch", "on"], "trained with touch absent")
    fails_with(capsys, ["evaluate", "run", *few, "--sweep", "touch", "absent"], "found absent")
