"""Workers in turn, in threads and in processes: the same results in the same order, clean ends."""

import itertools
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import closing
from functools import partial

import gymnasium as gym
import psutil
import pytest
from tactilerl.envs import vector


class Plain(gym.Env):
    """An environment that says nothing of itself but, if asked to, how it may be played in."""

    open = 0

    def __init__(self, side_by_side=None):
        Plain.open += 1
        self.is_open = True
        self.observation_space = self.action_space = gym.spaces.Box(-1, 1, (1,))
        if side_by_side:
            self.side_by_side = side_by_side

    def close(self):
        Plain.open -= self.is_open
        self.is_open = False


@pytest.mark.parametrize(
    ("side_by_side", "workers", "kind", "n"),
    [
        (None, 2, ProcessPoolExecutor, 2),
        (None, 1, type(None), 1),
        ("threads", 3, ThreadPoolExecutor, 3),
        ("in turn", 3, type(None), 1),
    ],
)
def test_an_environment_says_how_it_may_be_played_in(side_by_side, workers, kind, n):
    before = Plain.open
    with closing(vector.start(partial(Plain, side_by_side), workers)) as started:
        assert len(started) == n
        assert isinstance(started._pool, kind)
    assert Plain.open == before


def test_nobody_waits_and_the_order_stays():
    """While number 0 takes long, the other worker does all the rest."""
    done = []

    def noted(env, number, is_wanted):
        time.sleep(0.3 if number == 0 else 0.0)
        done.append(number)
        return number

    with closing(vector.start(partial(Plain, "threads"), 2)) as workers:
        assert list(workers.play(noted, range(6))) == list(range(6))
    assert done == [1, 2, 3, 4, 5, 0]


def until_unwanted(env, number, is_wanted):
    start = time.monotonic()
    while number and is_wanted() and time.monotonic() < start + 20:
        time.sleep(0.01)
    return number


@pytest.fixture(scope="module", params=["threads", "processes"])
def two(request):
    """Two workers, which the tests share."""
    with closing(vector.start(partial(Plain, request.param), 2)) as workers:
        yield workers


def test_what_is_begun_beyond_is_not_wanted_any_more(two):
    """Who stops iterating gets the workers back at once, and nothing of the rest."""
    begun = time.monotonic()
    for _ in range(3):  # what is said too late is not taken for the next
        played = two.play(until_unwanted, itertools.count())
        assert next(played) == 0
        played.close()
    assert list(two.play(until_unwanted, [0, 0])) == [0, 0]
    assert time.monotonic() - begun < 10


def fails_at_three(env, number, is_wanted):
    if number == 3:
        raise ValueError("three")
    return number


def test_an_error_comes_at_its_place_and_the_job_before_it_can_be_played_again(two):
    for _ in range(2):
        assert list(two.play(fails_at_three, range(3))) == [0, 1, 2]
        seen = []
        with pytest.raises(ValueError, match="three"):
            seen.extend(two.play(fails_at_three, range(6)))
        assert seen == [0, 1, 2]
    assert list(two.play(fails_at_three, [5, 4])) == [5, 4]


def kill_itself(env, number, is_wanted):
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_killed_process_is_an_error_that_says_so():
    raised = pytest.raises(OSError, match="worker's process has died")
    with closing(vector.start(Plain, 2)) as workers, raised:
        list(workers.play(kill_itself, range(2)))


def count_threads():
    os.environ["SET_UP"] = "yes"


def what_was_set_up(env, number, is_wanted):
    return os.environ.get("SET_UP")


def test_a_process_is_set_up_before_it_plays():
    with closing(vector.start(Plain, 2, count_threads)) as workers:
        assert set(workers.play(what_was_set_up, range(4))) == {"yes"}


@pytest.mark.slow
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGINT])
def test_processes_end_quietly_with_their_parent(end, tmp_path):
    """Ctrl-C goes to the whole group, as a terminal sends it."""
    train = ["-m", "tactilerl", "train", "--env", "Pendulum-v1", "--workers", "2", "--out", "run"]
    parent = subprocess.Popen(
        [sys.executable, *train, "--total-timesteps", "100_000_000"],
        cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    while not (tmp_path / "run/progress.csv").exists():
        assert parent.poll() is None
        time.sleep(0.1)
    children = psutil.Process(parent.pid).children(recursive=True)
    assert len(children) >= 2
    os.killpg(parent.pid, end) if end == signal.SIGINT else parent.kill()
    _, errors = parent.communicate(timeout=60)
    assert not psutil.wait_procs(children, timeout=10)[1]
    assert "Traceback" not in errors, errors


def only_here(process, side_by_side):
    if os.getpid() != process:
        raise ValueError("no environment in this process")
    return Plain(side_by_side)


def test_workers_that_cannot_start_close_what_they_have():
    before = set(multiprocessing.active_children())  # joblib keeps its own for the next call
    n_open = Plain.open
    with pytest.raises(ValueError, match="no environment in this process"):
        vector.start(partial(only_here, os.getpid(), "processes"), 2)
    assert Plain.open == n_open
    assert set(multiprocessing.active_children()) <= before
