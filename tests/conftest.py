"""Shared by all tests: each hand and simulator, what is skipped without PyBullet, one thread each."""

import importlib.util
import os
import signal
import tempfile
from pathlib import Path

import numpy as np
import pytest
from filelock import FileLock
from tactilerl.envs import scripted
from tactilerl.envs.hands import HANDS
from tactilerl.scripted import reflexes

os.environ.setdefault("OMPI_ALLOW_RUN_AS_ROOT", "1")
os.environ.setdefault("OMPI_ALLOW_RUN_AS_ROOT_CONFIRM", "1")
os.environ.setdefault("OMPI_MCA_mpi_yield_when_idle", "1")  # a waiting rank yields its core

# A shell's background ignores Ctrl-C, and what it starts inherits that: here it counts again.
signal.signal(signal.SIGINT, signal.default_int_handler)

scripted.N_STILL = 0  # each `train` of a hand would play four episodes first; test_scenes.py does

# The longest first, so that no core is idle at the end.
LONG = ["test_cli", "test_batch_env", "test_study_batch", "test_toy_learning", "test_export"]
LONG += ["test_mpi", "test_study_report", "test_design", "test_batch", "test_study_run"]
NO_PYBULLET = "PyBullet is not installed (it has wheels for Python up to 3.11)"


def needs_pybullet(item):
    """Whether a test has the mark, or the simulator or a scene in it among its parameters."""
    parameters = item.callspec.params.values() if hasattr(item, "callspec") else ()
    named = {"pybullet", "paper_mpl"} & set(map(str, parameters))
    return item.get_closest_marker("pybullet") or named


@pytest.fixture
def rng():
    return np.random.default_rng(1)


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: [*LONG, item.path.stem].index(item.path.stem))  # the others keep theirs
    if importlib.util.find_spec("pybullet") is None:
        for item in filter(needs_pybullet, items):
            item.add_marker(pytest.mark.skip(reason=NO_PYBULLET))


@pytest.fixture(scope="session")
def launches():
    """Held while MPI is launched: ranks that wait for cores starve, and a launch can fail."""
    return FileLock(Path(tempfile.gettempdir(), "tactilerl-tests-mpi.lock"))


@pytest.fixture
def one_launch(launches):
    """No other test launches MPI meanwhile."""
    with launches:
        yield


@pytest.fixture
def trained_here(monkeypatch):
    """Runs of a study are trained without a process each; with `--jobs 1`: they share one output."""
    from tiny_study import in_this_process, jobs

    monkeypatch.setattr(jobs, "_process", in_this_process)


@pytest.fixture(autouse=True)
def _one_thread():
    import torch  # takes seconds, which the process that hands out the tests need not spend

    torch.set_num_threads(1)


@pytest.fixture
def in_tmp(monkeypatch, tmp_path):
    """A working directory of its own, where what is written is nobody's."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def few_reflexes(monkeypatch):
    """`gate` and `design` choose scripted hands from three reflexes of each sense, not from fifteen."""
    candidates = reflexes.candidates
    monkeypatch.setattr(reflexes, "candidates", lambda *args: candidates(*args)[::7])


@pytest.fixture
def bullet():
    """PyBullet itself, of a test that is skipped where it is not installed."""
    return importlib.import_module("tactilerl.envs.simulators.pybullet").pybullet


@pytest.fixture(params=["mujoco", "pybullet"])
def simulator(request):
    """Each of them in turn."""
    return request.param


@pytest.fixture(params=HANDS)
def hand(request):
    """Each of the library's in turn."""
    return request.param
