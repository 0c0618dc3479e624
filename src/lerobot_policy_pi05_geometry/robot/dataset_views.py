"""Views of a board in a recorded dataset: frames in which the arm stood still, as different from each other as possible."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import OBS_STATE

from ..geometry.kinematics import ForwardKinematics
from .board import Board
from .hand_eye_problem import View
from .joint_offsets import levers

# A joint's motion over `WINDOW` frames (1 mm of a lift): more, and image and state are of different poses.
STILL = np.radians(0.6)
WINDOW = 2  # frames before and after
MAX_VIEWS = 120  # the more the better: the noise of the joints leaves an error that falls with their root


def find_views(dataset: LeRobotDataset, image_key: str, kinematics: ForwardKinematics, board: Board) -> list[View]:
    """Up to `MAX_VIEWS` views of the board, in the order of their frames.

    Raises ValueError if there is no such image or the arm never stood still.
    """
    if image_key not in dataset.meta.camera_keys:
        cameras = ", ".join(dataset.meta.camera_keys) or "no camera"
        raise ValueError(f"The dataset has no images {image_key}; it has {cameras}.")
    rows = dataset.hf_dataset.select_columns([OBS_STATE, "episode_index"])[:]
    states = torch.stack([torch.as_tensor(state) for state in rows[OBS_STATE]]).double()
    values = kinematics.values(states).numpy()  # (N, J)
    angles = values / levers(kinematics)
    still = still_frames(angles, np.array([int(number) for number in rows["episode_index"]]))
    if not len(still):
        raise ValueError(
            "The arm never stands still in this dataset, so images and joints do not belong together; hold still for "
            "a second in each "
            "pose."
        )
    views = []
    for frame in spread_out(angles, still, MAX_VIEWS):
        seen = board.detect(to_pixels(dataset[frame][image_key]))
        if seen is not None:
            views.append(View(int(frame), values[frame], seen))
    return sorted(views, key=lambda view: view.frame)


def still_frames(values: np.ndarray, episodes: np.ndarray) -> np.ndarray:
    """Frames around which no joint moves. values: (N, J) radians, or what counts as such (`levers`). episodes: (N,)."""
    count = len(values)
    calm = np.ones(count, dtype=bool)
    for shift in range(1, WINDOW + 1):
        for there in (np.arange(count) - shift, np.arange(count) + shift):
            inside = (there >= 0) & (there < count)
            other = there.clip(0, count - 1)
            same = inside & (episodes[other] == episodes)
            moved = np.abs(values - values[other]).max(axis=1) > STILL
            calm &= ~(same & moved)
    return np.flatnonzero(calm)


def spread_out(values: np.ndarray, among: np.ndarray, count: int) -> list[int]:
    """Up to `count` frames, each as far from those before it as possible (farthest-point order), none closer than 2 degrees.

    values: as in `still_frames`.
    """
    chosen = [int(among[0])]
    distance = np.abs(values[among] - values[chosen[0]]).max(axis=1)
    while len(chosen) < count and distance.max() > np.radians(2):
        chosen.append(int(among[int(distance.argmax())]))
        distance = np.minimum(distance, np.abs(values[among] - values[chosen[-1]]).max(axis=1))
    return chosen


def image_size(feature: Mapping[str, Any]) -> tuple[int, int]:
    """Height and width of a dataset's image feature, whose `names` say whether its channels come first."""
    shape, first = feature["shape"], str((feature.get("names") or [""])[0])
    height, width = shape[1:] if first.startswith("channel") else shape[:2]
    return height, width


def to_pixels(image: torch.Tensor) -> np.ndarray:
    """A dataset's image (3, H, W) -> (H, W, 3) uint8."""
    image = image.permute(1, 2, 0)
    return (image if image.dtype == torch.uint8 else (image * 255).round().to(torch.uint8)).contiguous().numpy()
