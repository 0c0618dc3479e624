"""Tiny LeRobotDatasets with two RGB cameras, without a simulator."""

from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_policy_pi05_geometry.data.quantiles import write_frame_quantiles

FPS, STATE_DIM, ACTION_DIM = 10, 7, 5
REPO_ID = "local/tiny"


def write_dataset(
    root: Path,
    lengths: tuple[int, ...] = (9, 5, 12),
    videos: bool = False,
    size: int = 28,
    seed: int = 0,
    depth: tuple[str, ...] = (),
    tasks: tuple[str, ...] = (),
) -> Path:
    """Episodes of these lengths; every image is a gradient of its own colour, which a video codec keeps apart.

    depth: keys of depth images, in millimetres, without LeRobot's flag. tasks: of each episode; by default all are "push".
    """
    kind = "video" if videos else "image"
    features = {
        **{
            f"observation.images.{camera}": {
                "dtype": kind,
                "shape": (size, size, 3),
                "names": ["height", "width", "channels"],
            }
            for camera in ("front", "wrist")
        },
        **{
            key: {"dtype": "image", "shape": (size, size, 1), "names": ["height", "width", "channels"]} for key in depth
        },
        "observation.state": {"dtype": "float32", "shape": (STATE_DIM,), "names": None},
        "action": {"dtype": "float32", "shape": (ACTION_DIM,), "names": None},
    }
    dataset = LeRobotDataset.create(REPO_ID, fps=FPS, features=features, root=root, use_videos=videos)
    _record(dataset, lengths, size, seed, tasks)
    dataset.finalize()
    write_frame_quantiles(root, REPO_ID, ("observation.state", "action"))
    return root


def add_episodes(root: Path, lengths: tuple[int, ...], size: int = 28, seed: int = 1) -> Path:
    """Record episodes in addition, as `lerobot-record --resume=true` does."""
    dataset = LeRobotDataset.resume(REPO_ID, root=root)
    _record(dataset, lengths, size, seed)
    dataset.finalize()
    return root


def _record(
    dataset: LeRobotDataset, lengths: tuple[int, ...], size: int, seed: int, tasks: tuple[str, ...] = ()
) -> None:
    random = np.random.default_rng(seed)
    ramp = np.linspace(0.2, 1.0, size)[:, None, None] * np.linspace(0.5, 1.0, size)[None, :, None]
    depth = [key for key, feature in dataset.features.items() if tuple(feature["shape"]) == (size, size, 1)]
    for length, task in zip(lengths, tasks or ["push"] * len(lengths), strict=True):
        for _ in range(length):
            dataset.add_frame(
                {
                    **{
                        f"observation.images.{camera}": (ramp * random.integers(40, 255, 3)).astype(np.uint8)
                        for camera in ("front", "wrist")
                    },
                    **{key: random.integers(300, 1500, (size, size, 1)).astype(np.uint16) for key in depth},
                    "observation.state": random.uniform(-1, 1, STATE_DIM).astype(np.float32),
                    "action": random.uniform(-1, 1, ACTION_DIM).astype(np.float32),
                    "task": task,
                }
            )
        dataset.save_episode()
