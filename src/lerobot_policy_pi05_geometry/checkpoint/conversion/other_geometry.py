"""A checkpoint of this policy with another geometry: another source, encoder, grid or set of cameras, or none.

What stays is copied byte for byte, and only what has to be new is drawn anew:

```
   π0.5's tensors, the count of steps     stay
   the adapter's MLP                      stays while features mean the same (source, encoder, frame); da3 and features do
   row and column embeddings              stay with the grid
   view embeddings                        stay with the camera's name
   the gate                               stays with the MLP; before new features it is shut, so that the policy goes on acting
   an own expert                          stays; a new one is a copy of the action expert
```

A checkpoint of an earlier version, whose gate was a logarithm, is brought up to date in passing.
"""

import math
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ...configuration_pi05_geometry import DEFAULT_ENCODER, PI05GeometryConfig
from ...geometry.adapter import PointAdapter
from ...geometry.da3.weights import meta_da3
from ...geometry.depth_augmentation import DepthAugmentation
from ...geometry.resolve import FROM_RGB, camera_names
from ...weight_files.strict_load import complain
from .geometry_start import SHUT, TAKE_UP, GeometryStart, value_or
from .settings import NOT_CARRIED, make_config
from .start import ADAPTER, GATE, OWN_EXPERT, STEP, inherited_shapes, is_new, meta_policy, start_values
from .tensor_file import StoredTensor, check_weights, read_tensor

Tensors = dict[str, StoredTensor | Tensor]
_DA3 = ("da3", "features")
_LOG_GATE, _OPENNESS = f"{GATE}log_gate", f"{GATE}openness"
_VIEW, _PLACES = f"{ADAPTER}view", (f"{ADAPTER}row", f"{ADAPTER}column")
_KNOWN = {STEP, _LOG_GATE, _OPENNESS} | {ADAPTER + name for name in PointAdapter(4, 1, 1, 1).state_dict()}


@dataclass(frozen=True)
class _Change:
    """What becomes of the new parameters. features: whether they mean another thing. gate: whether it starts again."""

    before: PI05GeometryConfig
    after: PI05GeometryConfig
    features: bool
    gate: bool


def other_geometry(
    source: object,
    described_by: Mapping[str, Any],
    file: Path,
    stored: Mapping[str, StoredTensor],
    start: GeometryStart,
    features_from_data: bool,
    seed: int,
) -> tuple[PI05GeometryConfig, Tensors]:
    """Configuration and tensors of the checkpoint with the geometry that `start` asks for.

    source: of the checkpoint, for messages. described_by: its config.json. file, stored: its weights. seed: draws what is new.
    Raises ValueError, with one sentence, if nothing would change, or for weights that are not whole.
    """
    if start == GeometryStart() and not features_from_data and _LOG_GATE not in stored:
        raise ValueError(
            f"{source} is a checkpoint of this policy already; say what its geometry should become (--geometry-source, "
            "--geometry-grid, --geometry-cameras, ...)."
        )
    before = make_config(_up_to_date(described_by), source)
    change = _plan(before, start, features_from_data)
    policy = meta_policy(change.after)
    inherited = {name: tensor for name, tensor in stored.items() if not is_new(name)}
    left = "nothing was written"
    unknown = [name for name in stored if is_new(name) and name not in _KNOWN and not name.startswith(OWN_EXPERT)]
    complain(file, "has unknown", sorted(unknown), left)
    check_weights(file, inherited_shapes(policy), inherited)
    new = start_values(policy, inherited, seed)
    values = {name: _value(name, fresh, stored, change) for name, fresh in new.items()}
    complain(file, "has wrong", [name for name, value in values.items() if value.shape != new[name].shape], left)
    return change.after, inherited | values


def _up_to_date(described_by: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of config.json in the form of this version, but for those of a machine or a training run."""
    settings = {name: value for name, value in described_by.items() if name not in NOT_CARRIED}
    log_gate = settings.pop("geometry_gate_init", None)
    if log_gate is not None:
        settings["geometry_gate_openness"] = math.exp(log_gate)
    return settings


def _plan(before: PI05GeometryConfig, start: GeometryStart, features_from_data: bool) -> _Change:
    """The configuration with another geometry, and what follows for the parameters."""
    after = deepcopy(before)
    after.geometry_source = value_or(start.source, before.geometry_source)
    start.check(after.geometry_source)
    after.geometry_grid = value_or(start.grid, before.geometry_grid)
    after.geometry_frame = value_or(start.frame, before.geometry_frame)
    after.geometry_expert = value_or(start.expert, before.geometry_expert)
    same_kind = (after.geometry_source in _DA3) == (before.geometry_source in _DA3)
    after.geometry_tokens = value_or(start.tokens, before.geometry_tokens if same_kind else "statistics")
    if after.geometry_source != "rgbd":  # augmentation of what is not measured any more would be refused
        after.depth_augmentation = DepthAugmentation()
    elif after.geometry_frame != "base":
        after.depth_augmentation = replace(after.depth_augmentation, shift=0.0, turn=0.0)
    start.calibrate(after)
    if features_from_data:
        after.input_features, after.output_features, after.optional_cameras = {}, {}, {}
    _choose_encoder(after, start)
    _choose_cameras(before, after, start, features_from_data)
    if before.geometry_source == "none":
        after.geometry_positions = "parallel"  # leaves the actions where they were
    features = _meaning(before) != _meaning(after)
    gate = features or start.openness is not None
    if gate and after.geometry_placement == "segment":
        after.geometry_gate_openness = value_or(start.openness, SHUT)
    if features and after.geometry_source != "none":
        for name, value in TAKE_UP.items():
            setattr(after, name, value)
    after.__post_init__()  # checks the whole again
    return _Change(before, after, features, gate)


def _choose_encoder(after: PI05GeometryConfig, start: GeometryStart) -> None:
    if after.geometry_source not in _DA3:
        after.da3_encoder = after.da3_hash = after.da3_image_size = after.features_path = None
        return
    if start.encoder is not None:
        after.da3_encoder, after.da3_hash = start.encoder, None
    after.da3_encoder = after.da3_encoder or DEFAULT_ENCODER
    after.da3_hash = meta_da3(after).content_hash  # by which an encoder is known
    if after.geometry_source == "da3":
        after.features_path = None
    if after.da3_image_size is not None and after.da3_image_size % (14 * after.geometry_grid):
        after.da3_image_size = None  # the default of the grid


def _choose_cameras(
    before: PI05GeometryConfig, after: PI05GeometryConfig, start: GeometryStart, features_from_data: bool
) -> None:
    """Cameras by the names that were given, else as they were. Those that the checkpoint does not know are left to the data."""
    source, after.geometry_pending = after.geometry_source, 0
    if source == "none":
        after.geometry_cameras = None
        return
    names = list(start.cameras) if start.cameras is not None else before.geometry_cameras
    after.geometry_cameras = names
    if source in FROM_RGB:
        known = bool(_all_cameras(after, source))
    else:
        there = _all_cameras(before, "rgbd")
        names = names or there
        calibrated = source == "random" or all(name in after.calibration for name in names)
        known = bool(names) and set(names) <= set(there) and calibrated
    if not known or features_from_data:
        same_kind = source == "random" or (source in FROM_RGB) == (before.geometry_source in FROM_RGB)
        names = after.geometry_cameras or (list(camera_names(before)) if same_kind else [])
        if source == "random" and names:
            after.geometry_cameras = names
        after.geometry_pending, after.geometry_features = len(names or [""]), {}


def _all_cameras(config: PI05GeometryConfig, source: str) -> list[str]:
    """Every camera that a source of this kind could use, as far as the configuration knows them."""
    whole = deepcopy(config)
    whole.geometry_cameras = None
    return list(whole.rgb_cameras() if source in FROM_RGB else whole.depth_cameras())


def _meaning(config: PI05GeometryConfig) -> tuple[str | None, ...]:
    """What decides what features mean, and so whether an adapter goes on reading them."""
    if config.geometry_source in _DA3:
        return "da3", config.da3_hash, config.geometry_tokens
    if config.geometry_source == "rgbd":
        return "rgbd", config.geometry_frame, config.geometry_tokens
    return (config.geometry_source,)


def _value(
    name: str, fresh: StoredTensor | Tensor, stored: Mapping[str, StoredTensor], change: _Change
) -> StoredTensor | Tensor:
    """A new parameter's value: the checkpoint's where it stays, else what it starts with."""
    if name == _OPENNESS and not change.gate and _LOG_GATE in stored:
        return read_tensor(stored[_LOG_GATE]).exp()
    if name == _VIEW and name in stored:
        assert isinstance(fresh, Tensor)
        return _views(fresh, read_tensor(stored[name]), camera_names(change.before), camera_names(change.after))
    if name == STEP or name.startswith(OWN_EXPERT):
        stays = True
    elif name == _OPENNESS:
        stays = not change.gate
    elif name in _PLACES:
        stays = change.before.geometry_grid == change.after.geometry_grid
    else:
        stays = not change.features
    return stored.get(name, fresh) if stays else fresh


def _views(fresh: Tensor, found: Tensor, before: tuple[str, ...], after: tuple[str, ...]) -> Tensor:
    """View embeddings (V, W): each camera's own, a new one's as drawn."""
    rows = [found[before.index(camera)] if camera in before else fresh[i] for i, camera in enumerate(after)]
    return torch.stack(rows)
