"""RGB and depth of a MuJoCo scene from one rendering, without a display.

`mujoco.Renderer` renders a scene once for RGB and once for depth. Without multisampling the depth buffer of the first rendering
already holds the depth, so one is enough (a test compares both).
"""

from typing import Any

import numpy as np

from .headless import mujoco

_MAX_GEOMETRIES = 10_000
_SLOW = (
    mujoco.mjtRndFlag.mjRND_SHADOW,
    mujoco.mjtRndFlag.mjRND_REFLECTION,
    mujoco.mjtRndFlag.mjRND_SKYBOX,
    mujoco.mjtRndFlag.mjRND_HAZE,
)


class RgbdRenderer:
    """Renders images of size x size pixels. It switches the model's multisampling, shadows, reflections, sky and haze off.

    Without multisampling software rendering is ten times as fast, and depth at edges is no average.
    """

    def __init__(self, model: Any, size: int) -> None:
        model.vis.quality.offsamples = 0
        self.scene = mujoco.MjvScene(model=model, maxgeom=_MAX_GEOMETRIES)
        self._model, self._options = model, mujoco.MjvOption()
        self._area = mujoco.MjrRect(0, 0, size, size)
        model.vis.global_.offwidth = model.vis.global_.offheight = size  # of the framebuffer
        self._gl = mujoco.gl_context.GLContext(size, size)
        self._gl.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR  # keeps the digits of far depth

    def render(self, data: Any, camera: Any) -> tuple[np.ndarray, np.ndarray]:
        """RGB (S, S, 3) uint8 and depth (S, S) float32 in metres along the optical axis, from an `MjvCamera`."""
        every = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, data, self._options, None, camera, every, self.scene)
        for flag in _SLOW:
            self.scene.flags[flag] = 0
        size = self._area.width
        pixels, buffer = np.empty((size, size, 3), np.uint8), np.empty((size, size), np.float32)
        self._gl.make_current()
        mujoco.mjr_render(self._area, self.scene, self._context)
        mujoco.mjr_readPixels(pixels, buffer, self._area, self._context)
        return np.ascontiguousarray(pixels[::-1]), np.ascontiguousarray(self._metres(buffer)[::-1])

    def _metres(self, buffer: np.ndarray) -> np.ndarray:
        """Depth from the buffer, which is 1 at the near plane and 0 at the far plane."""
        extent, planes = self._model.stat.extent, self._model.vis.map
        near, far = np.float32(planes.znear * extent), np.float32(planes.zfar * extent)
        half = np.float32(0.5)
        offset = half * (far + near) / (far - near) - half  # rounded as in OpenGL's projection matrix, which is float32
        return (far * near / (far - near) / (buffer.astype(np.float64) + offset)).astype(np.float32)

    def close(self) -> None:
        """Free the rendering context."""
        self._context.free()
        self._gl.free()
