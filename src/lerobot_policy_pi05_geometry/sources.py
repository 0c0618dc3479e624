"""Which geometry source a configuration asks for, and what it needs: calibration, an encoder, a feature store."""

from functools import partial
from pathlib import Path
from typing import Any

from .configuration_pi05_geometry import PI05GeometryConfig
from .frozen import load_da3
from .geometry import GeometrySource
from .geometry.da3 import Da3Encoder, Da3Source
from .geometry.random_tokens import RandomSource
from .geometry.rgbd import RgbdSource
from .geometry.store import FeatureStoreSource
from .geometry.unknown_cameras import UnknownCameras
from .inputs import check_calibration, resolve_calibration
from .stored import open_store


def build_source(
    config: PI05GeometryConfig, dataset_meta: Any | None, encoder: Da3Encoder | None
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


def _build_da3(config: PI05GeometryConfig, encoder: Da3Encoder | None = None) -> Da3Source:
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


def _accept_cameras(config: PI05GeometryConfig, cameras: list[str]) -> None:
    """The data has named the depth cameras of a converted checkpoint. Raises ValueError if they are not as many."""
    if len(cameras) != config.geometry_pending:
        names = ",".join(cameras)
        raise ValueError(
            f"The checkpoint was converted for {config.geometry_pending} depth camera(s), but the data has depth "
            f"from {len(cameras)}: {names}; convert again with --geometry-cameras {names}, or choose among them with "
            "--policy.geometry_cameras."
        )
    config.geometry_pending = 0


def _build_features(config: PI05GeometryConfig, root: Path) -> FeatureStoreSource:
    """The feature store of the dataset to train on. A policy without a dataset looks live."""
    return FeatureStoreSource(open_store(config, root), partial(_build_da3, config), config.optional_rgb_cameras())
