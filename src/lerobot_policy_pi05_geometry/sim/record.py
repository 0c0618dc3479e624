"""Scripted experts -> a LeRobotDataset v3 with LeRobot's depth maps."""

import logging
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from datasets.utils.logging import disable_progress_bar
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_STATE

from ..data.quantiles import write_frame_quantiles
from ..geometry.calibration import Rig
from ..geometry.dataset_calibration import write_dataset_calibration
from .environment import ACTION_NAMES, CAMERA, DEPTH_KEY, EXTRINSICS_KEY, FPS, STATE_NAMES, RgbdMetaworldEnv
from .tasks import make_expert

logger = logging.getLogger(__name__)

# Recording seeds start here, evaluation seeds at 0, so no training episode is evaluated.
FIRST_SEED = 1_000_000
POSE_NAMES = [f"{CAMERA}.pose.{row}{column}" for row in range(4) for column in range(4)]


def dataset_features(image_size: int) -> dict[str, dict]:
    """LeRobot features of a recording."""
    axes = ["height", "width", "channels"]
    info = {"is_depth_map": True, "depth_unit": "mm"}
    depth = {"dtype": "image", "shape": (image_size, image_size, 1), "names": axes, "info": info}
    return {
        f"observation.images.{CAMERA}": {"dtype": "image", "shape": (image_size, image_size, 3), "names": axes},
        f"observation.{DEPTH_KEY}": depth,
        # base_T_camera row by row: LeRobot's tools cannot edit a column of more than one dimension.
        f"observation.{EXTRINSICS_KEY}": {"dtype": "float32", "shape": (16,), "names": POSE_NAMES},
        "observation.state": {"dtype": "float32", "shape": (4,), "names": STATE_NAMES},
        "action": {"dtype": "float32", "shape": (4,), "names": ACTION_NAMES},
    }


def record(
    root: Path,
    repo_id: str,
    task: str,
    episodes: int,
    cameras: str = "train",
    image_size: int = 84,
    action_noise: float = 0.3,
    seed: int = 0,
) -> Iterator[tuple[int, bool]]:
    """Record `episodes` successful expert episodes; failed attempts are dropped and another seed is tried.

    root: folder of the new dataset; it exists only after all episodes are written. task: of tasks.py. cameras: range of
    camera poses. action_noise: standard deviation of the noise in executed actions; the recorded action is the
    expert's without noise, so that the data contains corrections (DART, Laskey et al., 2017).

    Yields (episodes recorded so far, whether the last attempt succeeded) after every attempt.
    """
    root = Path(root)
    if root.exists():
        raise FileExistsError(f"{root} already exists; choose another folder, or remove it first.")
    unfinished = root.with_name(f".{root.name}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    disable_progress_bar()  # one bar per episode would hide ours
    environment = RgbdMetaworldEnv(task, cameras, image_size)
    dataset = LeRobotDataset.create(
        repo_id,
        fps=FPS,
        features=dataset_features(image_size),
        root=unfinished,
        robot_type="metaworld_sawyer",
        use_videos=False,
    )
    try:
        done, attempt = 0, 0
        while done < episodes:
            frames = _attempt(environment, FIRST_SEED + 100_000 * seed + attempt, action_noise)
            attempt += 1
            if frames is not None:
                for frame in frames:
                    dataset.add_frame({**frame, "task": environment.task_description})
                dataset.save_episode()
                done += 1
            elif attempt - done > 5 * episodes + 20:
                raise RuntimeError(
                    f"The expert of '{task}' failed {attempt - done} of {attempt} times; its object range may be out of reach."
                )
            yield done, frames is not None
        dataset.finalize()
        write_frame_quantiles(unfinished, repo_id, (OBS_STATE, ACTION))
        write_dataset_calibration(unfinished, Rig(environment.calibration))
        unfinished.rename(root)
    finally:
        environment.close()


def _attempt(environment: RgbdMetaworldEnv, seed: int, action_noise: float) -> list[dict] | None:
    """One expert episode as dataset frames, or None if it failed."""
    expert = make_expert(environment._spec)
    noise = np.random.default_rng(seed)
    observation, _ = environment.reset(seed=seed)
    frames = []
    while True:
        action = expert.get_action(environment.simulator_state).clip(-1.0, 1.0).astype(np.float32)
        frames.append(
            {
                f"observation.images.{CAMERA}": observation["pixels"][CAMERA],
                f"observation.{DEPTH_KEY}": observation[DEPTH_KEY].astype(np.uint16),
                f"observation.{EXTRINSICS_KEY}": observation[EXTRINSICS_KEY].flatten(),
                "observation.state": observation["agent_pos"],
                "action": action,
            }
        )
        executed = action.copy()
        executed[:3] += noise.normal(0.0, action_noise, 3)
        observation, _, success, truncated, _ = environment.step(executed)
        if success or truncated:
            return frames if success else None
