"""Which geometry source a configuration asks for, and what it needs: calibration, an encoder, a feature store."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import GeometrySource
from .calibration import CALIBRATION_FILE, read_calibration_file
from .camera import CameraCalibration
from .da3 import Da3Encoder, Da3Source
from .da3.weights import load_da3
from .feature_store import FeatureStoreSource
from .feature_store.match import open_store
from .keys import extrinsics_key
from .random_tokens import RandomSource
from .rgbd import RgbdSource
from .unknown_cameras import UnknownCameras

if TYPE_CHECKING:
    from ..configuration_pi05_geometry import PI05GeometryConfig


def build_source(
    config: "PI05GeometryConfig", dataset_meta: Any | None, encoder: Da3Encoder | None
) -> GeometrySource | None:
    """The geometry source that the configuration names, or None; records calibration and cameras in the configuration.

    dataset_meta: of the dataset to train on, if there is one. encoder: as in the policy's constructor.
    """
    if config.geometry_source == "none":
        return None
    if config.geometry_source == "da3" or (config.geometry_source == "features" and dataset_meta is None):
        return _build_da3(config, encoder)
    if config.geometry_source == "features":
        return _build_features(config, Path(dataset_meta.root))
    sizes = config.depth_cameras()
    if config.geometry_pending and sizes:
        _accept_cameras(config, list(sizes))
    pending = tuple(config.geometry_cameras or (f"camera{i}" for i in range(config.geometry_pending)))
    if config.geometry_source == "random":
        cameras = tuple(sizes) or pending or tuple(key.rsplit(".", 1)[-1] for key in config.image_features)
        if not cameras:
            raise ValueError(
                "geometry_source=random makes tokens per camera, but the data has none; use geometry_source=none."
            )
        return RandomSource(cameras, config.geometry_grid)
    if not sizes and config.geometry_pending and dataset_meta is None:
        return UnknownCameras(pending, config.geometry_grid)
    if not sizes:
        raise ValueError(
            "geometry_source=rgbd needs depth, but the data has no observation.images.<camera>_depth; record depth "
            "(LeRobot: use_depth=true on the camera), or train with --policy.geometry_source=none (for a converted "
            "checkpoint: convert it with --geometry-source none)."
        )
    config.calibration = resolve_calibration(config, dataset_meta)
    config.calibration_given = config.calibration_given or config.calibration_path is not None
    config.calibration_path = None  # the checkpoint now carries the content
    check_calibration(config, list(sizes))
    return RgbdSource(
        tuple(sizes),
        config.geometry_grid,
        config.calibration,
        sizes,
        base_frame=config.geometry_frame == "base",
        unit=config.depth_unit,
        max_depth=config.max_depth,
    )


def _build_da3(config: "PI05GeometryConfig", encoder: Da3Encoder | None = None) -> Da3Source:
    keys = config.rgb_cameras()
    if not keys:
        raise ValueError(
            f"geometry_source={config.geometry_source} looks at RGB images, but the data has none; use geometry_source=none."
        )
    if config.geometry_source == "features" and config.da3_hash is None:
        raise ValueError(
            "geometry_source=features reads features of a dataset's frames, and there is no dataset to train on; use "
            "geometry_source=da3."
        )
    return Da3Source(
        keys,
        config.geometry_grid,
        load_da3(config) if encoder is None else encoder,
        config.da3_image_size,
        optional=config.optional_rgb_cameras(),
    )


def _accept_cameras(config: "PI05GeometryConfig", cameras: list[str]) -> None:
    """The data has named the depth cameras of a converted checkpoint. Raises ValueError if they are not as many."""
    if len(cameras) != config.geometry_pending:
        names = ",".join(cameras)
        raise ValueError(
            f"The checkpoint was converted for {config.geometry_pending} depth camera(s), but the data has depth "
            f"from {len(cameras)}: {names}; convert again with --geometry-cameras {names}, or choose among them with "
            "--policy.geometry_cameras."
        )
    config.geometry_pending = 0


def _build_features(config: "PI05GeometryConfig", root: Path) -> FeatureStoreSource:
    """The feature store of the dataset to train on. A policy without a dataset looks live."""
    return FeatureStoreSource(open_store(config, root), partial(_build_da3, config), config.optional_rgb_cameras())


def resolve_calibration(config: "PI05GeometryConfig", dataset_meta: Any | None) -> dict[str, CameraCalibration]:
    """The calibration to use: the file given, else what the checkpoint recorded, else the dataset's.

    The caller stores it in the configuration, so that a checkpoint carries it wherever it goes.
    Raises ValueError if the dataset's differs from the recorded one and no file says which of them holds.
    """
    if config.calibration_path is not None:
        return read_calibration_file(config.calibration_path)
    path = None if dataset_meta is None else Path(dataset_meta.root) / "meta" / CALIBRATION_FILE
    if path is None or not path.is_file():
        return config.calibration
    of_dataset = read_calibration_file(path)
    if config.calibration and config.calibration != of_dataset and not config.calibration_given:
        raise ValueError(
            f"The dataset's calibration ({path}) differs from the one recorded in the checkpoint; say which holds with "
            "--policy.calibration_path."
        )
    return config.calibration or of_dataset


def check_calibration(config: "PI05GeometryConfig", cameras: list[str]) -> None:
    """Raise ValueError unless every depth camera has usable intrinsics."""
    for camera in cameras:
        if camera not in config.calibration:
            known = ", ".join(sorted(config.calibration)) or "no camera"
            raise ValueError(
                f"Depth camera '{camera}' has no intrinsics (the calibration has {known}); give a calibration file with "
                "--policy.calibration_path, or put it at meta/calibration.json of the dataset."
            )
        config.calibration[camera].check(camera)
        posed = config.calibration[camera].extrinsics is not None or extrinsics_key(camera) in config.geometry_features
        if config.geometry_frame == "base" and not posed:
            raise ValueError(
                f"Depth camera '{camera}' has no extrinsics: neither in its calibration nor as {extrinsics_key(camera)} in "
                "the data; give them, or set --policy.geometry_frame=camera."
            )
