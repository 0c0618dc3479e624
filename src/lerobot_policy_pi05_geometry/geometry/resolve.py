"""From a configuration and a dataset to a geometry source, and to the facts that a checkpoint records about both.

`resolve` reads the configuration and never changes it. The policy writes what it returns back once, with `config.record`.
"""

import logging
from collections.abc import Mapping
from copy import copy
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from .calibration import Calibration, Rig, read_calibration_file
from .da3 import Da3Encoder, Da3Source
from .da3.weights import load_da3
from .dataset_calibration import check_state_names, read_dataset_calibration
from .dataset_depth import check_depth_scale, codec_bounds
from .depth import LEROBOT_COUNT
from .feature_store import FeatureStoreSource
from .feature_store.match import open_store
from .keys import camera_of, extrinsics_key
from .placed_camera import PlacedCamera
from .random_tokens import RandomSource
from .rays import FEATURE_DIM as RAY_FEATURES
from .rays import RaySource
from .rgbd import RgbdSource, depth_features
from .source import GeometrySource
from .unknown_cameras import UnknownCameras
from .with_rays import WithRays

if TYPE_CHECKING:
    from ..configuration_pi05_geometry import PI05GeometryConfig

logger = logging.getLogger(__name__)


FROM_RGB = ("da3", "features", "rays")  # sources with one view per RGB camera


class Resolved(NamedTuple):
    """source: what measures geometry; None builds plain π0.5. changes: fields of the configuration to write back."""

    source: GeometrySource | None
    changes: dict[str, Any]


def resolve(
    config: "PI05GeometryConfig", dataset_meta: Any | None = None, encoder: Da3Encoder | None = None
) -> Resolved:
    """The geometry source that a configuration and a dataset give, and what the checkpoint has to record.

    dataset_meta: metadata of the dataset to train on, if there is one. encoder: what `load_da3` returned for this
    configuration, for a policy that runs the encoder; None: it is loaded here.
    Raises ValueError or FileNotFoundError, with one sentence, for what does not fit together.
    """
    if config.geometry_source == "none":
        return Resolved(None, {})
    if config.geometry_source in ("da3", "features"):
        return _resolve_from_rgb(config, dataset_meta, encoder)
    if config.geometry_source == "rays":
        return _resolve_rays(config, dataset_meta)
    return _resolve_depth(config, dataset_meta)


def _resolve_from_rgb(config: "PI05GeometryConfig", dataset_meta: Any | None, encoder: Da3Encoder | None) -> Resolved:
    """Depth Anything 3's features: looked up in a dataset's store, or computed, as in a policy without a dataset."""
    cameras = list(config.rgb_cameras())
    changes: dict[str, Any] = {}
    if config.geometry_pending and cameras:
        _check_camera_count(config, cameras)
        changes["geometry_pending"] = 0
    elif config.geometry_pending and dataset_meta is None:
        encoder = load_da3(config) if encoder is None else encoder
        rays = RAY_FEATURES if config.geometry_tokens == "rays" else 0
        return Resolved(UnknownCameras(_pending(config), config.geometry_grid, encoder.variant.feature_dim + rays), {})
    if config.geometry_source == "features" and dataset_meta is not None:
        found = _resolve_store(config, Path(dataset_meta.root))
    else:
        source = _da3_source(config, encoder)
        content = source.encoder.content_hash
        found = Resolved(source, {} if content is None else {"da3_hash": content})
    if config.geometry_tokens == "rays":
        rays_found = _resolve_rays(config, dataset_meta)
        assert found.source is not None
        assert isinstance(rays_found.source, RaySource)
        found = Resolved(WithRays(found.source, rays_found.source), found.changes | rays_found.changes)
    return Resolved(found.source, found.changes | changes)


def _resolve_depth(config: "PI05GeometryConfig", dataset_meta: Any | None) -> Resolved:
    """The sources that have one view per depth camera: rgbd, and its control, random."""
    sizes = config.depth_cameras()
    changes: dict[str, Any] = {}
    if config.geometry_pending and sizes:
        _check_camera_count(config, list(sizes))
        changes["geometry_pending"] = 0
    if config.geometry_source == "random":
        cameras = camera_names(config)
        if not cameras:
            raise ValueError(
                "geometry_source=random makes tokens per camera, but the data has none; use geometry_source=none."
            )
        return Resolved(RandomSource(cameras, config.geometry_grid), changes)
    if not sizes and config.geometry_pending and dataset_meta is None:
        return Resolved(
            UnknownCameras(_pending(config), config.geometry_grid, *depth_features(config.geometry_tokens == "points")),
            changes,
        )
    if not sizes:
        raise ValueError(
            "geometry_source=rgbd needs depth, but the data has no observation.images.<camera>_depth and no feature that "
            "LeRobot flags as is_depth_map; record depth (LeRobot: use_depth=true on the camera), name its key by "
            "--policy.depth_keys, or train with --policy.geometry_source=none (for a converted checkpoint: convert it with "
            "--geometry-source none)."
        )
    recorded, rigs = _calibrated(config, dataset_meta, list(sizes))
    bounds = config.depth_bounds
    if dataset_meta is not None:
        check_depth_scale(rigs, dataset_meta, list(sizes), config.depth_keys)
        bounds = codec_bounds(dataset_meta.features, list(sizes), config.depth_keys)
    changes |= {**recorded, "depth_bounds": bounds}
    unknown = set(config.optional_depth_cameras) - set(sizes)
    if unknown:
        raise ValueError(
            f"optional_depth_cameras names {', '.join(sorted(unknown))}, but the data has depth from {', '.join(sizes)} only."
        )
    source = RgbdSource(
        [PlacedCamera(camera, rigs, size, config.rig) for camera, size in sizes.items()],
        config.geometry_grid,
        sizes,
        base_frame=config.geometry_frame == "base",
        unit=config.depth_unit,
        max_depth=config.max_depth,
        depth_keys=config.depth_keys,
        bounds={camera: (low, high) for camera, (low, high) in bounds.items()},
        optional=config.optional_depth_cameras,
        as_points=config.geometry_tokens == "points",
        augmentation=config.depth_augmentation,
    )
    return Resolved(source, changes)


def _resolve_rays(config: "PI05GeometryConfig", dataset_meta: Any | None) -> Resolved:
    """Rays of the RGB cameras, which need calibration as depth cameras do."""
    keys = config.rgb_cameras()
    changes: dict[str, Any] = {}
    if config.geometry_pending and keys:
        _check_camera_count(config, list(keys))
        changes["geometry_pending"] = 0
    elif config.geometry_pending and dataset_meta is None:
        return Resolved(UnknownCameras(_pending(config), config.geometry_grid, RAY_FEATURES), {})
    if not keys:
        raise ValueError("geometry_source=rays needs RGB cameras, but the data has none; use geometry_source=none.")
    if config.geometry_frame != "base":
        raise ValueError(
            "Camera rays describe where the camera stands in the robot's base frame; leave geometry_frame=base."
        )
    recorded, rigs = _calibrated(config, dataset_meta, list(keys))
    changes |= recorded
    sizes = {
        camera: (config.image_features[key].shape[-2], config.image_features[key].shape[-1])
        for camera, key in keys.items()
    }
    placed = [PlacedCamera(camera, rigs, sizes[camera], config.rig) for camera in keys]
    return Resolved(RaySource(placed, config.geometry_grid, sizes), changes)


def _calibrated(
    config: "PI05GeometryConfig", dataset_meta: Any | None, cameras: list[str]
) -> tuple[dict[str, Any], dict[int, Rig]]:
    """Fields that record the calibration of these cameras, which is checked; and the rigs by id."""
    calibration = resolve_calibration(config, dataset_meta)
    rigs = choose_rigs(config, calibration)
    check_calibration(config, rigs, cameras)
    if dataset_meta is not None:
        check_state_names(calibration, dataset_meta.features)
    recorded = {
        "calibration": calibration.cameras,
        "arms": calibration.arms,
        "rigs": calibration.rigs,
        "calibration_given": config.calibration_given or config.calibration_path is not None,
        "calibration_path": None,  # the checkpoint now carries the content
    }
    return recorded, rigs


def camera_names(config: "PI05GeometryConfig") -> tuple[str, ...]:
    """The geometry cameras in token order, as far as the configuration knows them; names in their place while data is awaited."""
    if config.geometry_source == "none":
        return ()
    if config.geometry_source in FROM_RGB:
        return tuple(config.rgb_cameras()) or _pending(config)
    images = tuple(camera_of(key) for key in config.image_features) if config.geometry_source == "random" else ()
    return tuple(config.depth_cameras()) or _pending(config) or images


def _pending(config: "PI05GeometryConfig") -> tuple[str, ...]:
    """Names of cameras that the data is yet to name."""
    return tuple(config.geometry_cameras or (f"camera{i}" for i in range(config.geometry_pending)))


def _check_camera_count(config: "PI05GeometryConfig", cameras: list[str]) -> None:
    """Raise ValueError unless the data has as many cameras as a converted checkpoint was made for."""
    if len(cameras) != config.geometry_pending:
        names = ",".join(cameras)
        kind = "RGB images" if config.geometry_source in FROM_RGB else "depth"
        raise ValueError(
            f"The checkpoint was converted for geometry from {config.geometry_pending} camera(s), but the data has {kind} "
            f"from {len(cameras)}: {names}; convert again with --geometry-cameras {names}, or choose among them with "
            "--policy.geometry_cameras."
        )


def _da3_source(config: "PI05GeometryConfig", encoder: Da3Encoder | None = None) -> Da3Source:
    keys = config.rgb_cameras()
    if not keys:
        raise ValueError(
            f"geometry_source={config.geometry_source} is computed from RGB images, but the data has none; use "
            "geometry_source=none."
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


def _resolve_store(config: "PI05GeometryConfig", root: Path) -> Resolved:
    """The feature store of the dataset to train on. Observations outside of the dataset go through the encoder itself."""
    store = open_store(config, root)
    manifest = store.manifest
    changes = {
        "da3_encoder": config.da3_encoder or manifest.encoder,
        "da3_hash": manifest.encoder_hash,
        "da3_image_size": manifest.image_size,
    }
    recorded = copy(config)
    recorded.record(changes)
    return Resolved(FeatureStoreSource(store, partial(_da3_source, recorded), config.optional_rgb_cameras()), changes)


def resolve_calibration(config: "PI05GeometryConfig", dataset_meta: Any | None) -> Calibration:
    """The calibration to use: the file given, else what the checkpoint recorded, else the dataset's.

    Raises ValueError if the dataset's differs from the recorded one and no file says which of them holds.
    """
    if config.calibration_path is not None:
        return read_calibration_file(config.calibration_path)
    recorded = Calibration(config.calibration, config.arms, config.rigs)
    if dataset_meta is None:
        return recorded
    of_dataset = read_dataset_calibration(dataset_meta, config.depth_keys)
    known, found = recorded != Calibration(), of_dataset != Calibration()
    if known and found and recorded != of_dataset and not config.calibration_given:
        raise ValueError(
            f"The calibration of the dataset at {dataset_meta.root} differs from the one recorded in the checkpoint; say "
            "which holds with --policy.calibration_path."
        )
    if known and found and recorded != of_dataset:
        logger.warning(
            "The dataset at %s carries another calibration than the one that was given to this policy, which is kept; give the "
            "dataset's with --policy.calibration_path if the cameras have moved.", dataset_meta.root,
        )  # fmt: skip
    return recorded if known else of_dataset


def one_metre(config: "PI05GeometryConfig", camera: str, rig: int | None = None) -> float:
    """Depth of 1 m as it arrives from a camera: in the declared unit, and counted as its calibration says.

    rig: of a policy of several rigs.
    """
    cameras = config.calibration if rig is None or not config.rigs else config.rigs[str(rig)].cameras
    scale = cameras[camera].depth_scale if camera in cameras else None
    return (1000.0 if config.depth_unit == "mm" else 1.0) * (1.0 if scale is None else LEROBOT_COUNT / scale)


def choose_rigs(config: "PI05GeometryConfig", calibration: Calibration) -> dict[int, Rig]:
    """Rigs by id. Raises ValueError if `config.rig` names one that is not there."""
    if not calibration.rigs:
        return {0: Rig(calibration.cameras, calibration.arms)}
    rigs = {int(name): rig for name, rig in calibration.rigs.items()}
    if config.rig is not None and config.rig not in rigs:
        raise ValueError(f"--policy.rig={config.rig}, but the calibration has the rigs {', '.join(calibration.rigs)}.")
    return rigs


def check_calibration(config: "PI05GeometryConfig", rigs: Mapping[int, Rig], cameras: list[str]) -> None:
    """Raise ValueError unless every depth camera has usable intrinsics on every rig, and a pose where one is needed."""
    for number, rig in rigs.items():
        where = f" on rig {number}" if len(rigs) > 1 else ""
        for camera in cameras:
            if camera not in rig.cameras:
                known = ", ".join(sorted(rig.cameras)) or "no camera"
                raise ValueError(
                    f"Camera '{camera}' has no intrinsics{where} (the calibration has {known}); give a "
                    f"calibration file with "
                    "--policy.calibration_path, or store it in the dataset with pi05-geometry store-calibration."
                )
            found = rig.cameras[camera]
            found.check(camera)
            in_data = extrinsics_key(camera) in config.geometry_features
            posed = found.extrinsics is not None or found.mount is not None or in_data
            if config.geometry_frame == "base" and not posed:
                raise ValueError(
                    f"Camera '{camera}' has no extrinsics{where}: neither in its calibration (there as a mount, "
                    f"if it is on "
                    f"the arm) nor as {extrinsics_key(camera)} in the data; give them, or set --policy.geometry_frame=camera."
                )
        rig.check()
