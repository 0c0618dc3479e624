"""Scripted experts on LIBERO -> a LeRobotDataset v3 with LeRobot's depth maps."""

import logging
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from datasets.utils.logging import disable_progress_bar
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from ...data.quantiles import write_frame_quantiles
from ...geometry.calibration import Rig
from ...geometry.dataset_calibration import write_dataset_calibration
from ..record import FIRST_SEED
from .environment import ACTION_NAMES, STATE_NAMES, RgbdLiberoEnv, depth_key, extrinsics_key
from .expert.expert import Expert
from .expert.skills import Style
from .scene import FPS

logger = logging.getLogger(__name__)

MAX_FAILURES = 20  # in a row, of one task
PUSH_STEPS, PUSH_EVERY = 4, 80  # a push off the path: its length, and the mean distance between two, in steps
NOISE = 0.15  # standard deviation of the noise in an executed motion, in action units
CAREFUL_NOISE = 0.03  # near contact


def dataset_features(views: Sequence[str], size: int) -> dict[str, dict]:
    """LeRobot features of a recording of these cameras."""
    axes = ["height", "width", "channels"]
    features: dict[str, dict] = {}
    for name in views:
        pose_names = [f"{name}.pose.{row}{column}" for row in range(4) for column in range(4)]
        features[f"observation.images.{name}"] = {"dtype": "image", "shape": (size, size, 3), "names": axes}
        features[f"observation.{depth_key(name)}"] = {
            "dtype": "image",
            "shape": (size, size, 1),
            "names": axes,
            "info": {"is_depth_map": True, "depth_unit": "mm"},
        }
        # base_T_camera row by row: LeRobot's tools cannot edit a column of more than one dimension.
        features[f"observation.{extrinsics_key(name)}"] = {"dtype": "float32", "shape": (16,), "names": pose_names}
    features["observation.state"] = {"dtype": "float32", "shape": (8,), "names": STATE_NAMES}
    features["action"] = {"dtype": "float32", "shape": (7,), "names": ACTION_NAMES}
    return features


def frame_of(observation: dict, views: Sequence[str], action: np.ndarray) -> dict[str, Any]:
    """An environment's observation and the action taken on it, as a frame of `dataset_features`."""
    frame: dict[str, Any] = {"observation.state": observation["agent_pos"], "action": action.astype(np.float32)}
    for name in views:
        frame[f"observation.images.{name}"] = observation["pixels"][name]
        frame[f"observation.{depth_key(name)}"] = observation[depth_key(name)].astype(np.uint16)
        frame[f"observation.{extrinsics_key(name)}"] = observation[extrinsics_key(name)].flatten()
    return frame


class DatasetWriter:
    """A dataset that appears at `root` only when it is whole. Use as a context; `finish` makes it appear."""

    def __init__(self, root: Path, repo_id: str, views: Sequence[str], image_size: int) -> None:
        self.root = Path(root)
        if self.root.exists():
            raise FileExistsError(f"{self.root} already exists; choose another folder, or remove it first.")
        self._repo_id = repo_id
        self._unfinished = self.root.with_name(f".{self.root.name}.unfinished")
        shutil.rmtree(self._unfinished, ignore_errors=True)
        disable_progress_bar()  # one bar per episode would hide ours
        self._dataset = LeRobotDataset.create(
            repo_id,
            fps=FPS,
            features=dataset_features(views, image_size),
            root=self._unfinished,
            robot_type="libero_panda",
            use_videos=False,
        )

    def add_episode(self, frames: list[dict], instruction: str) -> None:
        for frame in frames:
            self._dataset.add_frame({**frame, "task": instruction})
        self._dataset.save_episode()

    def finish(self, calibration: dict) -> None:
        """Write statistics and calibration, and put the dataset where it belongs."""
        self._dataset.finalize()
        write_frame_quantiles(self._unfinished, self._repo_id)
        write_dataset_calibration(self._unfinished, Rig(calibration))
        self._unfinished.rename(self.root)


def record(
    root: Path, repo_id: str, environments: Sequence[RgbdLiberoEnv], episodes: int, seed: int = 0
) -> Iterator[tuple[int, bool]]:
    """Record `episodes` successful expert episodes of every environment's task into one dataset.

    environments: of the same views and image size; closed afterwards. Failed attempts are dropped and another seed is
    tried. The executed motion has noise and, now and then, a push off the path; the recorded action is the expert's
    without either, so that the data contains corrections (DART, Laskey et al., 2017).

    Yields (episodes recorded so far, whether the last attempt succeeded) after every attempt.
    """
    first = environments[0]
    writer = DatasetWriter(root, repo_id, first.views, first.image_size)
    done, calibration = 0, {}
    for environment in environments:
        recorded, failures, attempt = 0, 0, FIRST_SEED + 100_000 * seed
        try:
            while recorded < episodes:
                frames = _attempt(environment, attempt)
                attempt += 1
                if frames is None:
                    failures += 1
                    if failures >= MAX_FAILURES:
                        raise RuntimeError(
                            f"The expert of {environment.libero_task.key} failed {failures} times in a row; "
                            f"docs/libero.md lists the tasks that it solves."
                        )
                else:
                    writer.add_episode(frames, environment.task_description)
                    recorded, done, failures = recorded + 1, done + 1, 0
                yield done, frames is not None
            calibration = environment.calibration
        finally:
            environment.close()
    writer.finish(calibration)


def _attempt(environment: RgbdLiberoEnv, seed: int) -> list[dict] | None:
    """One expert episode as dataset frames, or None if it failed."""
    generator = np.random.default_rng(seed)
    observation, _ = environment.reset(seed=seed)
    if environment.scene is None:
        raise RuntimeError("The environment has no scene after its reset.")
    expert = Expert(environment.scene, style=Style(np.random.default_rng(seed + 1)))
    frames: list[dict] = []
    push: np.ndarray = np.zeros(3)
    left = 0
    while True:
        action = expert.act()
        frames.append(frame_of(observation, environment.views, action))
        careful = expert.hand.careful
        executed = action.copy()
        executed[:6] += generator.normal(0.0, CAREFUL_NOISE if careful else NOISE, 6)
        if left == 0 and not careful and generator.random() < 1 / PUSH_EVERY:
            push, left = generator.uniform(-1.0, 1.0, 3) * [1, 1, 0.3], PUSH_STEPS
        if left > 0:
            executed[:3], left = push, left - 1
        observation, _, success, truncated, _ = environment.step(executed)
        if success or truncated:
            return frames if success else None
