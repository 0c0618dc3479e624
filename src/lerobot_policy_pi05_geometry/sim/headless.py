"""MuJoCo, told to render without a display. It chooses its OpenGL when it is first imported, so import it from here."""

import os

os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco

__all__ = ["mujoco"]
