"""A LIBERO task's simulation: reset to a seed's layout, step, observe, ask whether the goal is reached."""

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from .cameras import CameraMove, mujoco_quaternion, opencv_pose
from .installation import require_libero
from .placement import place_anew
from .rendering import CAMERAS, CameraRig, Frame
from .tasks import PLACEMENTS, LiberoTask

FPS = 20
SETTLE_STEPS = 10  # as LeRobot: objects of the initial states float or intersect a little
STATES = 10  # initial states to try: in some, objects that stay leave no place for those that are moved
NO_MOTION = np.array([0, 0, 0, 0, 0, 0, -1.0])  # and an open gripper
_OBSERVABLE = "calibrated_frames"


@contextlib.contextmanager
def numpy_seed(seed: int) -> Iterator[None]:
    """LIBERO's samplers draw from numpy's global generator: seed it, and put it back afterwards."""
    state = np.random.get_state()
    np.random.seed(seed % 2**32)
    try:
        yield
    finally:
        np.random.set_state(state)


class LiberoScene:
    """One task. cameras: names of `CAMERAS` to render, none for physics alone.

    Frames are in `frames` after `reset` and `step`; robosuite's own observations (world frame) are what both return.
    """

    def __init__(
        self,
        task: LiberoTask,
        image_size: int = 256,
        cameras: tuple[str, ...] = tuple(CAMERAS),
        rendering: str = "full",
        depth: bool = True,
    ) -> None:
        require_libero()
        from libero.libero.envs.env_wrapper import ControlEnv

        self.task = task
        with numpy_seed(0):
            self.control = ControlEnv(
                bddl_file_name=str(task.bddl_file),
                use_camera_obs=False,
                has_offscreen_renderer=False,  # robosuite's renderer gives no metric depth; CameraRig is ours
                control_freq=FPS,
                hard_reset=False,
            )
        self.env: Any = self.control.env
        self.rig: CameraRig | None = CameraRig(self.model, image_size, rendering, depth) if cameras else None
        self.frames: dict[str, Frame] = {}
        self._camera_names, self._watching = cameras, False
        self._front = int(self.model.camera(CAMERAS["front"]).id)
        self._stock_camera = self._camera_pose()
        self._states: np.ndarray | None = None
        self._observe_frames()

    @property
    def model(self) -> Any:
        """MuJoCo's model."""
        return self.env.sim.model._model

    @property
    def data(self) -> Any:
        """MuJoCo's data."""
        return self.env.sim.data._data

    @property
    def base(self) -> np.ndarray:
        """Position of the Panda's base in the world, (3,) metres. It is never turned."""
        return np.array(self.data.body("robot0_base").xpos)

    def _observe_frames(self) -> None:
        from robosuite.utils.observables import Observable, sensor

        @sensor(modality="frames")
        def take_frames(cache: dict) -> np.ndarray:
            if self._watching and self.rig is not None:
                self.frames = {name: self.rig.take(self.data, name) for name in self._camera_names}
            return np.array([float(self.data.time)])

        self.env.add_observable(Observable(_OBSERVABLE, take_frames, sampling_rate=FPS))

    def _camera_pose(self) -> np.ndarray:
        rotation = np.zeros(9)
        from ..headless import mujoco

        mujoco.mju_quat2Mat(rotation, self.model.cam_quat[self._front])
        return opencv_pose(self.model.cam_pos[self._front], rotation)

    def move_camera(self, move: CameraMove) -> None:
        """Put the front camera where the move takes it from its stock place."""
        pivot = np.asarray(self.env.workspace_offset, dtype=float)
        pose = move.apply(self._stock_camera, pivot)
        self.model.cam_pos[self._front] = pose[:3, 3]
        self.model.cam_quat[self._front] = mujoco_quaternion(pose)

    def reset(
        self, seed: int, placement: str = "stock", camera: CameraMove | None = None, state: np.ndarray | None = None
    ) -> dict:
        """A seed's layout, settled. Returns robosuite's observation.

        placement: `stock` is LIBERO's initial state number `seed` (modulo their number), with the fixtures' poses drawn
        by the seed; otherwise objects of interest are then placed anew, in the first state from that number on that has room
        for them. state: start from this flattened state instead.
        """
        if placement not in PLACEMENTS:
            raise ValueError(f"There is no placement '{placement}'; choose one of: {', '.join(PLACEMENTS)}.")
        self._watching = False
        self.move_camera(camera or CameraMove())
        with numpy_seed(seed):
            self._draw_fixtures()
        if state is not None:
            states = state[None]
        else:
            states = self._states = self.task.initial_states() if self._states is None else self._states
        generator = np.random.default_rng(seed)
        for number in range(seed, seed + STATES):
            self.control.set_init_state(states[number % len(states)])
            if placement == "stock" or place_anew(self, PLACEMENTS[placement], generator):
                break
        else:
            raise RuntimeError(f"{self.task.key} has no free places within ±{PLACEMENTS[placement]} m; use 'stock'.")
        for step in range(SETTLE_STEPS):
            self._watching = step == SETTLE_STEPS - 1
            observation = self.env.step(NO_MOTION)[0]
        self._watching = True
        return observation

    def _draw_fixtures(self) -> None:
        """A new episode, with the fixtures' poses drawn from numpy's global generator."""
        from robosuite.utils.errors import RandomizationError

        while True:
            try:
                self.env.reset()
                return
            except RandomizationError:  # LIBERO's sampler found no free place: it draws again
                continue

    def step(self, action: np.ndarray) -> tuple[dict, bool]:
        """Apply an action, (7,) in [-1, 1]; returns robosuite's observation and whether the goal is reached."""
        observation = self.env.step(action)[0]
        return observation, bool(self.env._check_success())

    def set_state(self, state: np.ndarray) -> dict:
        """Set a flattened state without simulating, and observe it."""
        self._watching = True
        return self.control.set_init_state(state)

    def close(self) -> None:
        if self.rig is not None:
            self.rig.close()
            self.rig = None
        self.control.close()
