"""MuJoCo with rendering without a display. It selects its OpenGL on its first import, so import it from here."""

import os

os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco

__all__ = ["mujoco"]
