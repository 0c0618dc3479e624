"""A π0.5 checkpoint of LeRobot or openpi -> a checkpoint of this policy that acts as it does."""

import json
import logging
import math
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from accelerate import init_empty_weights
from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE

from ...configuration_pi05_geometry import PI05GeometryConfig
from ...geometry import read_calibration_file
from ...model.variants import EXPERT_VARIANTS, PALIGEMMA_VARIANTS
from ...modeling_pi05_geometry import PI05GeometryPolicy
from ...weight_files.files import CONFIG_FILE, find_file, find_optional_file, new_folder
from .names import PREFIX, find_parameters
from .processors import POSTPROCESSOR, PREPROCESSOR, new_processors, processors_from_lerobot
from .settings import LEROBOT_TYPE, from_lerobot, from_openpi, make_config, save_config
from .start import inherited_shapes, start_values
from .tensor_file import StoredTensor, check_weights, read_tensors, total_size, write_tensors

logger = logging.getLogger(__name__)

# Logits on keys that the network has never seen may be well above those on the ones it has: with random weights and an openness
# of 3e-4, actions moved by up to 0.1, at 6e-6 by 3e-3, at 1e-7 by 5e-5 (docs/results.md). Invariant 9 allows 1e-3.
SHUT = 1e-7
# A policy that acts from RGB takes geometry up only if the gate moves fast and images are missing often enough: neither alone
# did (docs/results.md, "Warm start").
TAKE_UP = {"geometry_lr": 3e-3, "geometry_gate_lr": 5e-2, "image_dropout": 0.4, "geometry_dropout": 0.2}


@dataclass(frozen=True)
class GeometryStart:
    """The geometry that a converted checkpoint starts with.

    source: rgbd, random or none. cameras: names of the depth cameras in token order; None for one camera whose name the
    training data tells. calibration: a calibration file, or None if the training data has it. openness: of the gate, see `SHUT`.
    expert: shared, or own, a copy of the action expert. frame, grid: as in the configuration.
    """

    source: str = "rgbd"
    cameras: tuple[str, ...] | None = None
    calibration: Path | None = None
    grid: int = 8
    frame: str = "base"
    expert: str = "shared"
    openness: float = SHUT

    def settings(self) -> dict[str, Any]:
        """Fields of the configuration. Parallel positions leave the actions where π0.5 has them."""
        return {
            "geometry_source": self.source,
            "geometry_cameras": None if self.cameras is None else list(self.cameras),
            "geometry_pending": 0 if self.source == "none" else len(self.cameras or [""]),
            "geometry_grid": self.grid,
            "geometry_frame": self.frame,
            "geometry_expert": self.expert,
            "geometry_gate_openness": self.openness,
            **TAKE_UP,
            "geometry_positions": "parallel",
        }


def convert(
    source: str | Path,
    output: Path,
    geometry: GeometryStart | None = None,
    *,
    features_from_data: bool = False,
    chunk_size: int | None = None,
    tokenizer: str | None = None,
    seed: int = 0,
    **hub: Any,
) -> PI05GeometryConfig:
    """Write `output`, a folder that is not there yet; returns its configuration.

    source: folder or hub id of a π0.5 checkpoint of LeRobot or openpi (PyTorch). features_from_data: leave cameras
    and state to the training data, instead of the source's. chunk_size: actions per chunk, for an openpi checkpoint that
    does not say. tokenizer: folder or hub id, None for the source's. seed: draws the adapter. hub: arguments of
    `hf_hub_download`, such as `revision`.

    Raises ValueError, FileNotFoundError, FileExistsError or OSError, with one sentence; then nothing is left behind.
    """

    def find(name: str) -> Path:
        return find_file(source, name, **hub)

    file = find(SAFETENSORS_SINGLE_FILE)
    described = find_optional_file(source, CONFIG_FILE, **hub)
    described_by = _read_json(described) if described is not None else {}
    kind = described_by.get("type")
    if kind is not None and kind != LEROBOT_TYPE:
        done = " It is converted already." if kind == PI05GeometryPolicy.name else ""
        raise ValueError(
            f"{source} is a checkpoint of type '{kind}', not '{LEROBOT_TYPE}': only π0.5 checkpoints of LeRobot and openpi "
            f"can be converted.{done}"
        )
    stored = read_tensors(file)
    parameters = {name: stored[theirs] for name, theirs in find_parameters(file, stored).items()}
    if kind is None:
        carried = from_openpi(described_by, chunk_size, source) | _sizes_of(parameters)
    else:
        carried = from_lerobot(described_by, described)
    if features_from_data:
        carried |= {"input_features": {}, "output_features": {}}
    config = _configure(carried, geometry or GeometryStart(), source)
    with init_empty_weights(include_buffers=False):
        policy = PI05GeometryPolicy(deepcopy(config))  # a policy completes its configuration
    theirs = {PREFIX + name: tensor for name, tensor in parameters.items()}
    _check_variants(file, config, theirs)
    check_weights(file, inherited_shapes(policy), theirs)
    tensors = theirs | start_values(policy, theirs, seed)
    assert set(tensors) == set(policy.state_dict())

    with new_folder(output, total_size(tensors)) as folder:
        if kind is not None and find_optional_file(source, PREPROCESSOR, **hub) is not None:
            processors_from_lerobot(find, config, tokenizer, folder)
        else:
            logger.warning(
                "%s has no %s: processors are made anew and have no statistics; training brings its dataset's.",
                source, f"{PREPROCESSOR} and {POSTPROCESSOR}" if kind else "settings and processors of LeRobot's",
            )  # fmt: skip
            new_processors(config, tokenizer, folder)
        save_config(config, folder)
        write_tensors(folder / SAFETENSORS_SINGLE_FILE, tensors)
    return config


def _configure(carried: Mapping[str, Any], geometry: GeometryStart, source: object) -> PI05GeometryConfig:
    config = make_config({**carried, **geometry.settings()}, source)
    if geometry.calibration is not None:
        config.calibration = read_calibration_file(geometry.calibration)
        config.calibration_given = True
    return config


def _sizes_of(parameters: Mapping[str, StoredTensor]) -> dict[str, Any]:
    """The settings that weights tell, where they are well formed; what is not is named when the weights are checked."""
    vision = "paligemma_with_expert.paligemma.model.vision_tower.vision_model.embeddings."
    sizes: dict[str, Any] = {}
    action = parameters.get("action_out_proj.bias")
    if action is not None and len(action.shape) == 1:
        sizes["max_action_dim"] = action.shape[0]
    patches = parameters.get(f"{vision}position_embedding.weight")
    kernel = parameters.get(f"{vision}patch_embedding.weight")
    if patches is not None and kernel is not None and patches.shape and kernel.shape:
        side = math.isqrt(patches.shape[0]) * kernel.shape[-1]
        sizes["image_resolution"] = [side, side]
    return sizes


def _check_variants(path: Path, config: PI05GeometryConfig, found: Mapping[str, StoredTensor]) -> None:
    """Name the network that does not fit, where otherwise hundreds of tensors would."""
    network = f"{PREFIX}paligemma_with_expert."
    vlm, expert = f"{network}paligemma.model.language_model.", f"{network}gemma_expert.model."
    vlm_sizes, expert_sizes = (
        PALIGEMMA_VARIANTS[config.paligemma_variant].gemma,
        EXPERT_VARIANTS[config.action_expert_variant],
    )
    for field, variant, layers, width in (  # the width is read from a vector, which cannot be transposed
        ("paligemma_variant", vlm_sizes, f"{vlm}layers.", f"{vlm}norm.weight"),
        ("action_expert_variant", expert_sizes, f"{expert}layers.", f"{PREFIX}time_mlp_out.bias"),
    ):
        depth = len({name.removeprefix(layers).split(".")[0] for name in found if name.startswith(layers)})
        sizes = (found[width].shape[0] if width in found else variant.width, depth)
        if sizes != (variant.width, variant.depth):
            raise ValueError(
                f"Checkpoint {path} does not have the sizes of {field}={getattr(config, field)}: its width and number of "
                f"layers are {sizes[0]} and {sizes[1]}, expected {variant.width} and {variant.depth}; nothing was written."
            )


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is no JSON: {error}.") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} is no policy configuration: expected a JSON object.")
    return content
