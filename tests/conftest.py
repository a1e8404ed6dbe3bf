"""Shared by all tests: one thread of PyTorch, and MPI allowed for root."""

import os

import pytest
import torch

os.environ.setdefault("OMPI_ALLOW_RUN_AS_ROOT", "1")
os.environ.setdefault("OMPI_ALLOW_RUN_AS_ROOT_CONFIRM", "1")


@pytest.fixture(autouse=True)
def _one_thread():
    torch.set_num_threads(1)
