"""Where a dataset keeps the calibration of its cameras.

It stands in `meta/info.json`, in the `info` of the feature that holds the camera's depth (its images, for a camera without
depth), beside LeRobot's own `is_depth_map` and `depth_unit`:

```json
"observation.images.front_depth": {"dtype": "image", ..., "info": {"is_depth_map": true, "depth_unit": "mm",
    "calibration": {"frame": "base", "intrinsics": [600.0, 600.0, 319.5, 239.5], "size": [640, 480], "extrinsics": null}}}
```

LeRobot's tools carry a feature's `info` along: deleting, splitting and recomputing statistics keep it, and merging
refuses datasets whose `info` differs, as two rigs' does. A file `meta/calibration.json` (see calibration.py) is read too;
these tools drop it. An entry holds what the file says about one camera; the arms stand in the `info` of `observation.state`, as
`arms`. LeRobot has no place for it yet (its issue 4417).
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..dataset_folder import INFO_FILE, require_dataset
from ..weight_files.files import write_whole
from .calibration import (
    BASE_FRAME,
    CALIBRATION_FILE,
    VERSION,
    Calibration,
    Rig,
    calibration_content,
    parse_calibration,
    read_calibration_file,
)
from .keys import RIG, camera_of, depth_camera_name, depth_features, is_depth_key, is_depth_map

INFO_ENTRY = "calibration"
ARMS_ENTRY, RIGS_ENTRY = "arms", "rigs"
_STATE = "observation.state"


def read_dataset_calibration(dataset_meta: Any, depth_keys: Mapping[str, str]) -> Calibration:
    """Calibration of a dataset's cameras and arms; an empty one if it has none.

    dataset_meta: LeRobot's metadata (`features`, `root`). depth_keys: camera -> key of its depth, where it is not LeRobot's.
    Raises ValueError for an unusable entry, or if the two places contradict each other.
    """
    features, root = dataset_meta.features, Path(dataset_meta.root)
    keys = _calibrated_features(features, depth_keys)
    entries = {camera: dict(features[key]["info"][INFO_ENTRY]) for camera, key in keys.items()}
    frames = {camera: entry.pop("frame", None) for camera, entry in entries.items()}
    other = next((camera for camera, frame in frames.items() if frame != BASE_FRAME), None)
    content: dict[str, Any] = {"version": VERSION, "frame": BASE_FRAME if other is None else frames[other]}
    rigs = (features.get(RIG, {}).get("info") or {}).get(RIGS_ENTRY)
    if rigs is not None:
        content["rigs"] = rigs
    else:
        content["cameras"] = entries
        content["arms"] = (features.get(_STATE, {}).get("info") or {}).get(ARMS_ENTRY, {})
    in_info = parse_calibration(content, f"The calibration in {root / INFO_FILE}")
    file = root / "meta" / CALIBRATION_FILE
    in_file = read_calibration_file(file) if file.is_file() else Calibration()
    for camera in in_info.cameras.keys() & in_file.cameras.keys():
        if in_info.cameras[camera] != in_file.cameras[camera]:
            raise ValueError(
                f"Camera '{camera}' has two calibrations that differ, in {root / INFO_FILE} (feature {keys[camera]}) and in "
                f"{file}; delete the wrong one, or give the right one with --policy.calibration_path."
            )
    for name in in_info.arms.keys() & in_file.arms.keys():
        if in_info.arms[name] != in_file.arms[name]:
            raise ValueError(
                f"Arm '{name}' has two calibrations that differ, in {root / INFO_FILE} and in {file}; delete the wrong one, or "
                "give the right one with --policy.calibration_path."
            )
    return Calibration(in_file.cameras | in_info.cameras, in_file.arms | in_info.arms, in_file.rigs | in_info.rigs)


def state_names(features: Mapping[str, Any]) -> list[str] | None:
    """Names of the entries of a dataset's state, in their order; None if its features do not name each of them."""
    state = features.get(_STATE) or {}
    names = state.get("names")
    if isinstance(names, Mapping):  # older datasets name the group: {"motors": [...]}
        names = next(iter(names.values()), None)
    if not isinstance(names, list | tuple) or len(names) != state["shape"][0]:
        return None
    return [str(name) for name in names]


def check_state_names(rig: Rig, features: Mapping[str, Any]) -> None:
    """Raise ValueError unless the arms that carry a camera, of all rigs, read the entries of this dataset's state that they know.

    A dataset that does not name the entries of its state cannot be checked.
    """
    names = state_names(features)
    if names is None:
        return
    for each in (rig, *(rig.rigs.values() if isinstance(rig, Calibration) else ())):
        for name in {camera.mount.arm: None for camera in each.cameras.values() if camera.mount is not None}:
            each.arms[name].check_state_names(name, names)


def write_dataset_calibration(root: Path, rig: Rig, depth_keys: Mapping[str, str] | None = None) -> None:
    """Store the calibration of cameras and arms in the `info` of a dataset's features, where LeRobot's tools keep it.

    depth_keys: as in `read_dataset_calibration`. Raises ValueError for a camera that the
    dataset does not have and an arm whose joints are other entries of its state, FileNotFoundError if there is no dataset
    at `root`.
    """
    path = require_dataset(root) / INFO_FILE
    info = json.loads(path.read_text())
    check_state_names(rig, info["features"])
    if isinstance(rig, Calibration) and rig.rigs:
        if RIG not in info["features"]:
            raise ValueError(f"The dataset at {root} has no {RIG}, by which a frame says which rig it is from.")
        _add_info(info["features"][RIG], RIGS_ENTRY, calibration_content(rig)["rigs"])
    content = calibration_content(Rig(rig.cameras, rig.arms))
    for camera in rig.cameras:
        key = _feature_of(camera, info["features"], depth_keys or {})
        _add_info(info["features"][key], INFO_ENTRY, {"frame": BASE_FRAME, **content["cameras"][camera]})
    if rig.arms:
        _add_info(info["features"][_STATE], ARMS_ENTRY, content["arms"])
    write_whole(path, json.dumps(info, indent=4, ensure_ascii=False) + "\n")


def _add_info(feature: dict[str, Any], name: str, value: Any) -> None:
    feature["info"] = {**(feature.get("info") or {}), name: value}


def _calibrated_features(features: Mapping[str, Any], depth_keys: Mapping[str, str]) -> dict[str, str]:
    """Camera -> feature with its calibration. An entry with depth comes before one with colour images of the camera."""
    named = {key: camera for camera, key in depth_keys.items()}
    found: dict[str, str] = {}
    for key in sorted(features, key=lambda key: _holds_depth(key, features[key], named)):  # depth last: it wins
        if INFO_ENTRY in (features[key].get("info") or {}):
            depth = _holds_depth(key, features[key], named)
            camera = named.get(key) or (depth_camera_name(key) if depth else camera_of(key))
            found[camera] = key
    return found


def _holds_depth(key: str, feature: Mapping[str, Any], named: Mapping[str, str]) -> bool:
    return key in named or is_depth_key(key) or is_depth_map(feature)


def _feature_of(camera: str, features: Mapping[str, Any], depth_keys: Mapping[str, str]) -> str:
    """The feature that holds a camera's depth, or else its images."""
    depth = depth_features(features, depth_keys)
    images = [key for key, feature in features.items() if feature["dtype"] in ("image", "video")]
    candidates = {camera_of(key): key for key in images if key not in depth.values()} | depth
    if camera not in candidates:
        known = ", ".join(sorted(candidates)) or "none"
        raise ValueError(f"The dataset has no camera '{camera}' to store a calibration of; its cameras are {known}.")
    return candidates[camera]
