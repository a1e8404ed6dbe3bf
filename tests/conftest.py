"""Shared by all tests: one thread of PyTorch, MPI allowed for root, a MuJoCo that warns."""

import os

import pytest
import torch

from tactilerl.envs.simulators import mujoco

os.environ.setdefault("OMPI_ALLOW_RUN_AS_ROOT", "1")
os.environ.setdefault("OMPI_ALLOW_RUN_AS_ROOT_CONFIRM", "1")


@pytest.fixture(autouse=True)
def _one_thread():
    torch.set_num_threads(1)


@pytest.fixture
def little_memory(monkeypatch, tmp_path):
    """Scenes in MuJoCo that have too little memory for the constraints of a pressed object."""
    build = mujoco.build_spec

    def small(scene):
        spec = build(scene)
        spec.memory = 2**16
        return spec

    monkeypatch.setattr(mujoco, "build_spec", small)
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
