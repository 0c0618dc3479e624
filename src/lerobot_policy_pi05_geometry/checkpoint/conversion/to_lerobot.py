"""A checkpoint of this policy -> LeRobot's π0.5, geometry dropped."""

import json
import logging
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

from accelerate import init_empty_weights
from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE

from ...geometry.depth_augmentation import DepthAugmentation
from ...model.variants import EXPERT_VARIANTS
from ...modeling_pi05_geometry import PI05GeometryPolicy
from ...weight_files.files import CONFIG_FILE, find_file, new_folder
from ..load import read_config
from .names import EMBEDDING, EXPERT_HEAD, PREFIX, VLM_HEAD
from .processors import processors_to_lerobot
from .settings import to_lerobot
from .start import inherited_shapes, is_new
from .tensor_file import StoredTensor, Zeros, check_weights, read_tensors, total_size, write_tensors

logger = logging.getLogger(__name__)


def export(source: str | Path, output: Path, **hub: Any) -> None:
    """Write `output`, a folder that is not there yet, in LeRobot's pi05 layout.

    LeRobot's network has two output matrices that it never reads and does not load without: the VLM's is written as a copy
    of its embedding, as openpi ties them, the expert's as zeros.

    source: folder or hub id of a checkpoint of this policy. hub: arguments of `hf_hub_download`.
    Raises ValueError, FileNotFoundError, FileExistsError or OSError, with one sentence; then nothing is left behind.
    """
    config = read_config(source, **hub)

    def find(name: str) -> Path:
        return find_file(source, name, **hub)

    file = find(SAFETENSORS_SINGLE_FILE)
    if config.paligemma_variant != "gemma_2b":
        logger.warning(
            "LeRobot builds the released sizes only, so it will not load this checkpoint of paligemma_variant=%s.",
            config.paligemma_variant,
        )
    with init_empty_weights(include_buffers=False):  # without geometry: neither its weights nor its encoder are needed
        plain = replace(deepcopy(config), geometry_source="none", depth_augmentation=DepthAugmentation())
        policy = PI05GeometryPolicy(plain)
    stored = {name: tensor for name, tensor in read_tensors(file).items() if not is_new(name)}
    check_weights(file, inherited_shapes(policy), stored)
    embedding = stored[PREFIX + EMBEDDING]
    width = EXPERT_VARIANTS[config.action_expert_variant].width
    heads: dict[str, StoredTensor | Zeros] = {
        PREFIX + VLM_HEAD: embedding,
        PREFIX + EXPERT_HEAD: Zeros(embedding.dtype, (embedding.shape[0], width)),
    }
    tensors = stored | heads
    with new_folder(output, total_size(tensors)) as folder:
        processors_to_lerobot(find, folder)
        (folder / CONFIG_FILE).write_text(json.dumps(to_lerobot(config), indent=4))
        write_tensors(folder / SAFETENSORS_SINGLE_FILE, tensors)
