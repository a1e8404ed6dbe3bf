"""Environments in turn, in threads and in processes: the same numbers, clean ends."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from functools import partial
from importlib.util import find_spec

import gymnasium as gym
import numpy as np
import psutil
import pytest

from tactilerl import envs
from tactilerl.envs import vector

shadow = partial(envs.make, "shadow", task="reach-goal")
mpl = partial(envs.make, "mpl", layout="1", hold_seconds=0.8)


needs_pybullet = pytest.mark.skipif(find_spec("pybullet") is None, reason="no PyBullet")


def play(pool):
    """Steps of changing subsets, and resets in between."""
    rng = np.random.default_rng(0)
    seen = [obs["observation"] for obs in pool.reset([2, 0, 1], [10, 11, 12])]
    for indices in ([0, 1, 2], [2], [0, 2], [1, 0], [0, 1, 2], [1, 2]):
        actions = rng.uniform(-1, 1, (len(indices), *pool.action_space.shape))
        for index, step in zip(indices, pool.step(indices, actions), strict=True):
            seen += [step.obs["observation"], [step.reward]]
            if step.terminated or step.truncated:
                seen.append(pool.reset([index], [100 + index])[0]["observation"])
    pool.close()
    return np.concatenate(seen)


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        pytest.param(shadow, vector.ThreadedEnvs, id="threads"),
        pytest.param(mpl, vector.ProcessEnvs, id="processes", marks=needs_pybullet),
    ],
)
def test_parallel_equals_in_turn(make, kind):
    in_turn = play(vector.start(make, 3))
    for cores in (2, 3):
        pool = vector.start(make, 3, cores)
        assert type(pool) is kind
        assert len(pool) == 3
        np.testing.assert_array_equal(play(pool), in_turn)


@pytest.mark.parametrize("kind", [vector.ThreadedEnvs, vector.ProcessEnvs])
def test_faults_and_warnings_arrive(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    broken = partial(envs.make, "mpl", simulator="mujoco", task="reach-goal", finger_gain=1e6)
    pool = kind(broken, 2, 2)
    pool.reset([0, 1], [0, 0])
    infos = [step.info for step in pool.step([0, 1], np.ones((2, 7)))]
    pool.close()
    assert all(info["diverged"] and info["warnings"] > 0 for info in infos)


def test_one_environment_or_one_core_needs_neither():
    for n, cores in ((1, 4), (2, 1)):
        pool = vector.start(shadow, n, cores)
        assert type(pool) is vector.Envs
        pool.close()


@pytest.fixture
def processes():
    pytest.importorskip("pybullet")
    pool = vector.ProcessEnvs(mpl, 2, 2)
    yield pool
    pool.close()


def test_what_a_learner_asks_of_the_pool_is_answered(processes):
    goal = np.zeros((2, 7))
    assert processes.max_episode_steps == 100
    assert processes.n_boolean == 139
    assert processes.compute_reward(goal, goal).shape == (2,)


def test_an_error_in_a_process_is_raised_here_and_the_others_go_on(processes):
    processes.reset([0, 1], [0, 0])
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
        processes.reset([1], [0])


@needs_pybullet
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGINT])
def test_processes_end_quietly_with_their_parent(end):
    """In the middle of a step; Ctrl-C goes to the whole group, as a terminal sends it."""
    code = (
        "import signal\n"
        "import numpy as np\n"
        "from functools import partial\n"
        "from tactilerl import envs\n"
        "from tactilerl.envs import vector\n"
        "if __name__ == '__main__':\n"
        "    signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # CI may have it ignored
        "    pool = vector.ProcessEnvs(partial(envs.make, 'mpl', task='reach-goal'), 2, 2)\n"
        "    try:\n"
        "        print('ready', flush=True)\n"
        "        while True:\n"
        "            pool.reset([0, 1], [0, 0])\n"
        "            for _ in range(20): pool.step([0, 1], np.zeros((2, 7)))\n"
        "    except KeyboardInterrupt:\n"
        "        pool.close()\n"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    assert parent.stdout.readline() == "ready\n"
    time.sleep(0.5)  # it is stepping
    children = psutil.Process(parent.pid).children(recursive=True)
    assert len(children) >= 2
    os.killpg(parent.pid, end) if end == signal.SIGINT else parent.kill()
    _, errors = parent.communicate(timeout=20)
    assert not psutil.wait_procs(children, timeout=10)[1]
    assert "Traceback" not in errors, errors


def test_many_environments_in_one_process_do_not_block_each_other():
    """More bytes of questions and answers than a pipe holds."""
    pool = vector.ProcessEnvs(partial(envs.make, "point-reach"), 400, 1)
    assert len(pool.reset(range(400), range(400))) == 400
    assert len(pool.step(range(400), np.zeros((400, *pool.action_space.shape)))) == 400
    pool.close()


def test_what_cannot_be_made_is_raised_here():
    with pytest.raises(ValueError, match="layout"):
        vector.ProcessEnvs(partial(envs.make, "shadow", layout="none"), 2, 2)


class Counted(gym.Env):
    """Says how many there are that nobody has closed."""

    open = 0
    holds_gil = False

    def __init__(self, holds_gil=False):
        Counted.open += 1
        self.holds_gil, self.is_open = holds_gil, True

    def close(self):
        Counted.open -= self.is_open
        self.is_open = False


def only_here(process, holds_gil):
    if os.getpid() != process:
        raise ValueError("no environment in this process")
    return Counted(holds_gil)


def test_a_pool_that_cannot_start_closes_what_it_has():
    with pytest.raises(ValueError, match="no environment in this process"):
        vector.start(partial(only_here, os.getpid(), holds_gil=True), 2, 2)
    assert Counted.open == 0
    assert not multiprocessing.active_children()


def test_a_pool_that_starts_closes_all_at_the_end():
    pool = vector.start(partial(only_here, os.getpid(), holds_gil=False), 3, 2)
    assert Counted.open == 3
    pool.close()
    assert Counted.open == 0
