"""A feature store matched to a policy and a dataset: found and compared.

Training from a store needs no encoder. The checkpoint records which encoder the features are from, and runs that one.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from ..da3 import default_image_size
from ..da3.weights import backbone_hash, find_encoder
from . import FeatureStore, Manifest, read_manifest
from .fingerprint import Episodes, changed_file, read_episodes
from .manifest import MANIFEST_FILE, stores_in

if TYPE_CHECKING:
    from ...configuration_pi05_geometry import PI05GeometryConfig

STORES = "geometry"  # folder of a dataset that holds its stores


def open_store(config: "PI05GeometryConfig", root: Path) -> FeatureStore:
    """The store for this policy and the dataset at `root`.

    Raises FileNotFoundError or ValueError, with one sentence, if there is none, it does not fit, or it is damaged.
    """
    episodes = read_episodes(root)
    folder = Path(config.features_path) if config.features_path is not None else _find(config, root, episodes)
    manifest = read_manifest(folder)
    reason = misfit(config, manifest, root, episodes)
    if reason is not None:
        raise ValueError(f"The feature store {folder} does not fit: {reason}.")
    store = FeatureStore(folder)
    store.read_ahead()
    return store


def misfit(config: "PI05GeometryConfig", manifest: Manifest, root: Path, episodes: Episodes) -> str | None:
    """Why a store does not fit this policy and the dataset at `root` with these episodes, and what to do; None if it fits."""
    anew = "run pi05-geometry precompute for it"
    if episodes != manifest.episodes:
        if not episodes.begins_with(manifest.episodes):
            return f"the dataset {root} has changed since, or is another one (meta/episodes); {anew}"
        added = len(episodes.hashes) - len(manifest.episodes.hashes)
        return (
            f"the dataset {root} has {added} more episode(s) since; {anew} again, which computes the new frames alone"
        )
    changed = changed_file(root, manifest.dataset_files, allow_new=False)
    if changed is not None:
        return f"the dataset's {root / changed} has another size than when the features were computed; {anew}"
    if manifest.grid != config.geometry_grid:
        return (
            f"it has {manifest.grid} x {manifest.grid} cells per camera, the policy {config.geometry_grid} x "
            f"{config.geometry_grid}; set --policy.geometry_grid={manifest.grid}, or {anew}"
        )
    cameras = config.rgb_cameras()
    if list(manifest.cameras.items()) != list(cameras.items()):
        names = ",".join(f'"{name}"' for name in manifest.cameras)
        return (
            f"it has the cameras {_list(manifest.cameras)}, the policy {_list(cameras)}, in this order; set "
            f"--policy.geometry_cameras='[{names}]', or {anew} (a store knows cameras by the dataset's own names, so none of "
            "them may be in --rename_map)"
        )
    size = config.da3_image_size
    if size is None:  # a policy that was trained on images used the default size
        size = manifest.image_size if config.da3_hash is None else default_image_size(config.geometry_grid)
    for name, theirs, ours in (
        ("da3_image_size", manifest.image_size, size),
        ("da3_dtype", manifest.dtype, config.da3_dtype),
    ):
        if theirs != ours:
            return (
                f"it was computed with {name} {theirs}, the policy has {ours}; set --policy.{name}={theirs}, or {anew}"
            )
    return _other_encoder(config, manifest)


def _other_encoder(config: "PI05GeometryConfig", manifest: Manifest) -> str | None:
    """Why the features are from another encoder than the policy's; content decides, not the name."""
    wanted = config.da3_hash
    if wanted is None:
        if config.da3_encoder in (None, manifest.encoder):
            return None
        wanted = backbone_hash(find_encoder(config.da3_encoder))
    if wanted == manifest.encoder_hash:
        return None
    return (
        f"its features are from another encoder: {manifest.encoder} (SHA-256 {manifest.encoder_hash}), the policy's is "
        f"{config.da3_encoder} (SHA-256 {wanted}); run pi05-geometry precompute --encoder={config.da3_encoder}"
    )


def _find(config: "PI05GeometryConfig", root: Path, episodes: Episodes) -> Path:
    """The one store beside the dataset that fits."""
    beside = root / STORES
    found = stores_in(beside)
    if not found:
        older = " of this version" if any(beside.glob(f"*/{MANIFEST_FILE}")) else ""
        raise FileNotFoundError(
            f"geometry_source=features needs a feature store, and {beside} has none{older}; run pi05-geometry precompute "
            f"--dataset.root={root}, or name one by --policy.features_path."
        )
    reasons = {folder: misfit(config, manifest, root, episodes) for folder, manifest in found.items()}
    fitting = [folder for folder, reason in reasons.items() if reason is None]
    if not fitting:
        told = "; and ".join(f"{folder.name}: {reason}" for folder, reason in reasons.items())
        raise ValueError(f"No feature store in {beside} fits: {told}.")
    if len(fitting) > 1:
        raise ValueError(
            f"Several feature stores in {beside} fit ({', '.join(folder.name for folder in fitting)}); name one by "
            "--policy.features_path."
        )
    return fitting[0]


def _list(cameras: dict[str, str]) -> str:
    return ", ".join(f"{name} ({key})" for name, key in cameras.items()) or "none"
