"""Settings that all tests share."""

import os

import pytest
import torch
from hypothesis import Phase, settings

# The same examples in every run: a test that compares floating-point numbers must not fail one night in a hundred.
# A failing example is made smaller, but not explained line by line, which takes minutes on a network.
settings.register_profile(
    "repeatable",
    deadline=None,
    derandomize=True,
    max_examples=10,
    phases=[Phase.explicit, Phase.generate, Phase.shrink],
)
settings.load_profile("repeatable")

# Tiny networks spend their time in threads waiting for each other; LeRobot's own processes inherit the variable.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# MuJoCo selects its OpenGL on its first import, whichever test makes it; without a display only EGL renders.
os.environ.setdefault("MUJOCO_GL", "egl")
torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def seeded() -> None:
    """What a test draws without a generator of its own is the same in every run and order."""
    torch.manual_seed(0)
