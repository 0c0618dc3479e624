"""MuJoCo with rendering without a display. It selects its OpenGL on its first import, so import it from here."""

import os
import sys

if sys.platform == "linux":  # elsewhere MuJoCo has no EGL, and its own choice is right
    os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco

__all__ = ["mujoco"]
