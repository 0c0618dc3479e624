"""Datasets of several robots become one, in which every frame keeps the calibration of its own robot.

LeRobot's merge refuses features whose `info` differs, as two calibrations do. So each dataset is copied with the number of its
rig in every frame (`observation.calibration.rig`) and with the same table of all rigs in the `info` of that feature; then LeRobot
merges the copies.
"""

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.dataset_tools import add_features, merge_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from ..dataset_folder import require_dataset
from ..geometry.calibration import Calibration, Rig
from ..geometry.dataset_calibration import (
    ARMS_ENTRY,
    INFO_ENTRY,
    read_dataset_calibration,
    write_dataset_calibration,
)
from ..geometry.dataset_depth import codec_bounds
from ..geometry.keys import RIG, depth_features, find_depth_keys
from ..weight_files.files import write_whole


def merge_rigs(roots: Sequence[Path], output: Path, repo_id: str = "local/merged") -> dict[Path, int]:
    """Write a dataset of all episodes of some datasets, each of one rig. Equal calibrations are one rig.

    Returns the number of every dataset's rig. Raises FileNotFoundError, FileExistsError or ValueError with one sentence.
    """
    if len(roots) < 2:
        raise ValueError("Merging needs two datasets or more.")
    if output.exists():
        raise FileExistsError(f"{output} exists already; give another --output, or delete it.")
    metas = [_read(root) for root in roots]
    rigs = [_rig_of(meta) for meta in metas]
    _check_alike(metas, rigs)
    known: list[Rig] = []
    for rig in rigs:
        if rig not in known:
            known.append(rig)
    calibration = Calibration(rigs={str(number): rig for number, rig in enumerate(known)})
    numbers = [known.index(rig) for rig in rigs]
    output.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=output.parent) as folder:
        copies = [
            labelled(LeRobotDataset(meta.repo_id, root=meta.root), number, calibration, Path(folder) / str(place))
            for place, (meta, number) in enumerate(zip(metas, numbers, strict=True))
        ]
        merge_datasets(copies, repo_id, output)
    return dict(zip(roots, numbers, strict=True))


def labelled(dataset: LeRobotDataset, number: int, calibration: Calibration, output: Path) -> LeRobotDataset:
    """A copy of a dataset whose frames say that they are of rig `number` of `calibration`."""
    rig = {RIG: (np.full(len(dataset), number), {"dtype": "int64", "shape": (1,), "names": None})}
    copy = add_features(dataset, rig, output, dataset.repo_id)
    path = output / "meta" / "info.json"
    info = json.loads(path.read_text())
    for feature in info["features"].values():
        for entry in (INFO_ENTRY, ARMS_ENTRY):
            (feature.get("info") or {}).pop(entry, None)
        if not feature.get("info"):
            feature.pop("info", None)
    write_whole(path, json.dumps(info, indent=4, ensure_ascii=False) + "\n")
    write_dataset_calibration(output, calibration)
    return LeRobotDataset(copy.repo_id, root=output)


def _read(root: Path) -> LeRobotDatasetMetadata:
    return LeRobotDatasetMetadata(f"local/{root.name}", root=require_dataset(root))


def _rig_of(meta: LeRobotDatasetMetadata) -> Rig:
    """The one rig that a dataset is of."""
    if RIG in meta.features:
        raise ValueError(f"{meta.root} is of several rigs already; merge the datasets that it was made of.")
    found = read_dataset_calibration(meta, find_depth_keys(meta.features, {}))
    if not found.cameras:
        raise ValueError(
            f"{meta.root} carries no calibration; store it with `pi05-geometry store-calibration calibration.json "
            f"--dataset.root={meta.root}`."
        )
    return Rig(found.cameras, found.arms)


def _check_alike(metas: Sequence[LeRobotDatasetMetadata], rigs: Sequence[Rig]) -> None:
    """Raise ValueError where what LeRobot would merge in silence is not the same: calibrated cameras, and the depth codec."""
    first = metas[0]
    depth_keys = find_depth_keys(first.features, {})
    cameras = list(depth_features(first.features, depth_keys))
    for meta, rig in zip(metas[1:], rigs[1:], strict=True):
        apart = rig.cameras.keys() ^ rigs[0].cameras.keys()
        if apart:
            raise ValueError(
                f"Camera(s) {', '.join(sorted(apart))} are calibrated in only one of {first.root} and {meta.root}; calibrate "
                "the same cameras in both, under the same names."
            )
        bounds = [codec_bounds(each.features, cameras, depth_keys) for each in (first, meta)]
        if bounds[0] != bounds[1]:
            raise ValueError(
                f"Depth is encoded between {bounds[0]} m in {first.root} and between {bounds[1]} m in {meta.root}, and "
                "LeRobot's merge would drop both; encode them with the same depth_min and depth_max."
            )
