"""One rendering gives what MuJoCo's own renderer gives in two."""

import numpy as np
import pytest

from lerobot_policy_pi05_geometry.sim.environment import RgbdMetaworldEnv
from lerobot_policy_pi05_geometry.sim.headless import mujoco
from lerobot_policy_pi05_geometry.sim.renderer import _SLOW
from lerobot_policy_pi05_geometry.sim.tasks import WIDE_TASKS

pytestmark = pytest.mark.sim


@pytest.mark.parametrize("task", ["coffee-button-wide", "drawer-open-wide"])
@pytest.mark.parametrize("size", [48, 84])
def test_one_rendering_equals_mujocos_two(task, size):
    assert task in WIDE_TASKS
    environment = RgbdMetaworldEnv(task, "wide", size)
    environment.reset(seed=size)
    simulator, camera = environment._simulator, environment._camera
    for _ in range(3):
        environment.step(np.array([0.5, 1.0, -0.5, 0.0], np.float32))
    pixels, depth = environment._renderer.render(simulator.data, camera)
    with mujoco.Renderer(simulator.model, size, size) as expected:
        expected.update_scene(simulator.data, camera)
        for flag in _SLOW:
            expected.scene.flags[flag] = 0
        np.testing.assert_array_equal(pixels, expected.render())
        expected.enable_depth_rendering()
        np.testing.assert_allclose(depth, expected.render(), rtol=1e-6)
    environment.close()
    assert depth.std() > 0.05  # a scene, and no plain background
    assert len(np.unique(pixels)) > 20
