"""Figures of a checkpoint on a frame of a dataset."""

from pathlib import Path

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from ..checkpoint.load import load_policy
from ..configuration_pi05_geometry import PI05GeometryConfig
from ..dataset_folder import require_dataset
from ..geometry.calibration import Calibration
from ..geometry.dataset_calibration import check_state_names
from .page import Page, picture
from .pictures import depth_figure, layout_figure, segment_share_figure
from .scene import Scene, log_to_rerun, scene_figure, scene_of


def write_inspection(
    checkpoint: str, root: Path, repo_id: str, frame: int, device: str, output: Path, rerun: Path | None = None
) -> None:
    """Write a page about one frame of a dataset, processed by a checkpoint. rerun: a file of the scene for the rerun viewer.

    Raises ValueError for a frame outside the dataset, a checkpoint of another policy, and an arm whose joints are other entries
    of the state.
    """
    require_dataset(root)
    loaded = load_policy(checkpoint, device)
    policy = loaded.policy
    dataset = LeRobotDataset(repo_id, root=root, depth_output_unit=policy.config.depth_unit)
    if not 0 <= frame < len(dataset):
        raise ValueError(f"The dataset has frames 0 to {len(dataset) - 1}; there is no frame {frame}.")
    check_state_names(
        Calibration(policy.config.calibration, policy.config.arms, policy.config.rigs), dataset.meta.features
    )
    raw = frame_batch(dataset, frame)
    scene = scene_of_policy(policy.config, raw)
    if rerun is not None:
        log_to_rerun(scene, str(rerun))
    batch = loaded.preprocess(raw)
    page = Page(f"{Path(checkpoint).name} on frame {frame} of {root.name}")
    page.lead(f"Task: {dataset[frame]['task']}")
    if policy.geometry is not None and policy.config.geometry_source == "rgbd":
        page.row(
            picture(depth_figure(policy, batch), "Depth with its grid cells, and the attention of the action tokens.")
        )
    if scene.points:
        page.row(
            picture(scene_figure(scene), "Measured points in the robot's base frame, with cameras and the arm's links.")
        )
    page.row(
        picture(layout_figure(policy, batch), "The attention mask as the network applied it."),
        picture(segment_share_figure(policy, batch), "Attention of the action tokens per segment and layer."),
    )
    page.write(output)


def scene_of_policy(config: PI05GeometryConfig, batch: dict) -> Scene:
    """The scene of a raw batch of one, by the calibration that a checkpoint carries."""
    calibration = Calibration(config.calibration, config.arms, config.rigs)
    if config.rigs and config.rig is not None:  # the policy acts on this robot only
        rig = config.rigs[str(config.rig)]
        calibration = Calibration(rig.cameras, rig.arms)
    bounds = {camera: (low, high) for camera, (low, high) in config.depth_bounds.items()}
    return scene_of(batch, calibration, config.depth_unit, min(config.max_depth, 3.0), bounds, config.depth_keys)


def frame_batch(dataset: LeRobotDataset, frame: int) -> dict:
    """A frame's observation as a raw batch of one."""
    item = dataset[frame]
    batch = {k: v[None] if isinstance(v, torch.Tensor) else v for k, v in item.items() if k.startswith("observation.")}
    return {**batch, "task": [item["task"]]}
