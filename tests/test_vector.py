"""Environments in turn, in threads and in processes: the same numbers, clean ends."""

import os
import signal
import subprocess
import sys
import time
from functools import partial

import numpy as np
import psutil
import pytest

from tactilerl import envs
from tactilerl.envs import vector

shadow = partial(envs.make, "shadow", task="reach-goal")
mpl = partial(envs.make, "mpl", layout="1", hold_steps=200)


@pytest.fixture(autouse=True)
def needs_pybullet():
    pytest.importorskip("pybullet")


def play(pool):
    """Steps of changing subsets, and resets in between."""
    rng = np.random.default_rng(0)
    seen = [pool.reset(i, 10 + i)["observation"] for i in range(3)]
    for indices in ([0, 1, 2], [2], [0, 2], [1, 0], [0, 1, 2], [1, 2]):
        actions = rng.uniform(-1, 1, (len(indices), *pool.action_space.shape))
        for index, step in zip(indices, pool.step(indices, actions), strict=True):
            seen += [step.obs["observation"], [step.reward]]
            if step.terminated or step.truncated:
                seen.append(pool.reset(index, 100 + index)["observation"])
    pool.close()
    return np.concatenate(seen)


@pytest.mark.parametrize(
    ("make", "kind"),
    [(shadow, vector.ThreadedEnvs), (mpl, vector.ProcessEnvs)],
    ids=["threads", "processes"],
)
def test_parallel_equals_in_turn(make, kind):
    in_turn = play(vector.start(make, 3))
    for cores in (2, 3):
        pool = vector.start(make, 3, cores)
        assert type(pool) is kind
        assert len(pool) == 3
        np.testing.assert_array_equal(play(pool), in_turn)


def test_one_environment_or_one_core_needs_neither():
    for n, cores in ((1, 4), (2, 1)):
        pool = vector.start(mpl, n, cores)
        assert type(pool) is vector.Envs
        pool.close()


@pytest.fixture
def processes():
    pool = vector.ProcessEnvs(mpl, 2, 2)
    yield pool
    pool.close()


def test_what_a_learner_asks_of_the_pool_is_answered(processes):
    goal = np.zeros((2, 7))
    assert processes.max_episode_steps == 100
    assert processes.n_boolean == 139
    assert processes.compute_reward(goal, goal).shape == (2,)


def test_an_error_in_a_process_is_raised_here_and_the_others_go_on(processes):
    for index in range(2):
        processes.reset(index, 0)
    bad = np.zeros((2, 7))
    bad[0, 0] = np.nan
    with pytest.raises(ValueError, match="action: found nan"):
        processes.step([0, 1], bad)
    assert len(processes.step([0, 1], np.zeros((2, 7)))) == 2


def test_a_killed_process_is_an_error_that_says_so(processes):
    process = processes._processes[1]
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    with pytest.raises(OSError, match="process that steps environments has died"):
        processes.reset(1, 0)


def test_processes_end_when_their_parent_is_killed():
    code = (
        "import time\n"
        "from functools import partial\n"
        "from tactilerl import envs\n"
        "from tactilerl.envs import vector\n"
        "if __name__ == '__main__':\n"
        "    pool = vector.ProcessEnvs(partial(envs.make, 'mpl'), 2, 2)\n"
        "    pool.reset(0, 0)\n"
        "    pool.reset(1, 0)\n"
        "    print('ready', flush=True)\n"
        "    time.sleep(60)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout.readline() == "ready\n"
    children = psutil.Process(parent.pid).children(recursive=True)
    assert len(children) >= 2
    parent.kill()
    parent.wait()
    end = time.monotonic() + 10
    while any(child.is_running() and child.status() != psutil.STATUS_ZOMBIE for child in children):
        assert time.monotonic() < end
        time.sleep(0.05)
