"""Shared fixtures. Every test runs on one torch thread: on shared cores more are slower."""

import os

import pytest
import torch as th

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")


@pytest.fixture(autouse=True)
def _one_torch_thread():
    th.set_num_threads(1)
