"""A π0.5 checkpoint of LeRobot or openpi -> a checkpoint of this policy that acts as it does."""

import json
import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from torch import Tensor

from ...configuration_pi05_geometry import PI05GeometryConfig
from ...model.variants import EXPERT_VARIANTS, PALIGEMMA_VARIANTS
from ...modeling_pi05_geometry import PI05GeometryPolicy
from ...weight_files.files import ADAPTER_CONFIG, CONFIG_FILE, find_file, find_optional_file, new_folder
from .geometry_start import GeometryStart, has_images
from .names import PREFIX, find_parameters
from .other_geometry import other_geometry
from .processors import POSTPROCESSOR, PREPROCESSOR, copy_processors, new_processors, processors_from_lerobot
from .settings import LEROBOT_TYPE, from_lerobot, from_openpi, make_config, save_config
from .start import inherited_shapes, meta_policy, start_values
from .tensor_file import StoredTensor, check_weights, read_tensors, total_size, write_tensors

logger = logging.getLogger(__name__)

# Its dtype is the one that a network's matrices are stored in.
_A_MATRIX = "paligemma_with_expert.gemma_expert.model.layers.0.self_attn.q_proj.weight"


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

    source: folder or hub id of a π0.5 checkpoint of LeRobot or openpi (PyTorch), or of a checkpoint of this policy that is to
    get another geometry. features_from_data: leave cameras and state to the training data, instead of the source's.
    chunk_size: actions per chunk, for an openpi checkpoint that does not say. tokenizer: folder or hub id, None for the source's.
    seed: draws the adapter. hub: arguments of `hf_hub_download`, such as `revision`.

    Raises ValueError, FileNotFoundError, FileExistsError or OSError, with one sentence; then nothing is left behind.
    """

    def find(name: str) -> Path:
        return find_file(source, name, **hub)

    start = geometry or GeometryStart()
    described = find_optional_file(source, CONFIG_FILE, **hub)
    described_by = _read_json(described) if described is not None else {}
    kind = described_by.get("type")
    if kind not in (None, LEROBOT_TYPE, PI05GeometryPolicy.name):
        raise ValueError(
            f"{source} is a checkpoint of type '{kind}', not '{LEROBOT_TYPE}': only π0.5 checkpoints of LeRobot and openpi, "
            "and those of this policy, can be converted."
        )
    ours = kind == PI05GeometryPolicy.name
    if ours and find_optional_file(source, ADAPTER_CONFIG, **hub) is not None:
        raise ValueError(f"{source} was trained with LoRA; merge it first (`pi05-geometry merge {source} MERGED`).")
    if chunk_size is not None and kind is not None:
        raise ValueError(
            f"--chunk-size is for an openpi checkpoint; the actions of a chunk of {source} are its own setting, so leave "
            "it out."
        )
    if ours and tokenizer is not None:
        raise ValueError(
            f"{source} is a checkpoint of this policy and carries its tokenizer; leave --tokenizer-path out."
        )
    file = find(SAFETENSORS_SINGLE_FILE)
    stored = read_tensors(file)
    if ours:
        config, tensors = other_geometry(source, described_by, file, stored, start, features_from_data, seed)
    else:
        parameters = {name: stored[theirs] for name, theirs in find_parameters(file, stored).items()}
        if kind is None:
            carried = from_openpi(described_by, chunk_size, source) | _sizes_of(parameters)
        else:
            carried = from_lerobot(described_by, described)
        if features_from_data:
            carried |= {"input_features": {}, "output_features": {}}
        config, tensors = _with_geometry(
            source, carried | _dtypes(parameters, carried, source), file, parameters, start, seed
        )

    with new_folder(output, total_size(tensors)) as folder:
        if kind is None or find_optional_file(source, PREPROCESSOR, **hub) is None:
            logger.warning(
                "%s has no %s: processors are made anew and have no statistics; training brings its dataset's.",
                source, f"{PREPROCESSOR} and {POSTPROCESSOR}" if kind else "settings and processors of LeRobot's",
            )  # fmt: skip
            new_processors(config, tokenizer, folder)
        elif kind == LEROBOT_TYPE:
            processors_from_lerobot(find, config, tokenizer, folder)
        else:
            copy_processors(find, folder)
        save_config(config, folder)
        write_tensors(folder / SAFETENSORS_SINGLE_FILE, tensors)
    return config


def _with_geometry(
    source: object,
    carried: Mapping[str, Any],
    file: Path,
    parameters: Mapping[str, StoredTensor],
    start: GeometryStart,
    seed: int,
) -> tuple[PI05GeometryConfig, dict[str, StoredTensor | Tensor]]:
    """Configuration and tensors of a π0.5 with geometry. parameters: by the network's names, all that there are."""
    config = make_config({**carried, **start.settings(has_images(carried))}, source)
    start.calibrate(config)
    policy = meta_policy(config)
    theirs = {PREFIX + name: tensor for name, tensor in parameters.items()}
    _check_variants(file, config, theirs)
    check_weights(file, inherited_shapes(policy), theirs)
    tensors = theirs | start_values(policy, theirs, seed)
    assert set(tensors) == set(policy.state_dict())
    return config, tensors


def _dtypes(parameters: Mapping[str, StoredTensor], carried: Mapping[str, Any], source: object) -> dict[str, Any]:
    """Weights that are stored in bfloat16 stay so in memory, where the source computes in bfloat16 or does not say."""
    matrix = parameters.get(_A_MATRIX)
    if matrix is None or matrix.dtype != "BF16":
        return {}
    if carried.get("dtype", "bfloat16") == "bfloat16":
        return {"dtype": "bfloat16", "param_dtype": "bfloat16"}
    logger.warning(
        "%s stores its weights in bfloat16 and computes in %s (its setting dtype), so they take twice the memory once loaded; "
        "--policy.dtype=bfloat16 --policy.param_dtype=bfloat16 keeps them as they are.", source, carried["dtype"],
    )  # fmt: skip
    return {}


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
