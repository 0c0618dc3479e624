"""Merge LoRA into the weights: the new checkpoint acts the same, and needs neither PEFT nor the base policy."""

import shutil
from pathlib import Path

from ..weight_files.files import ADAPTER_CONFIG, new_folder
from .conversion.settings import save_config
from .load import load_policy


def merge(checkpoint: Path, output: Path) -> None:
    """Write `output`: the weights with LoRA merged into them, the settings and the processors.

    Raises FileNotFoundError if `checkpoint` has no LoRA or its base policy does not exist, FileExistsError if `output`
    exists. Then nothing is written.
    """
    if not (checkpoint / ADAPTER_CONFIG).is_file():
        raise FileNotFoundError(f"{checkpoint} has no {ADAPTER_CONFIG}: it was not trained with LoRA.")
    policy = load_policy(checkpoint).policy
    size = sum(tensor.numel() * tensor.element_size() for tensor in policy.state_dict().values())
    with new_folder(output, size) as folder:
        policy.save_pretrained(folder)
        policy.config.pretrained_path = None
        save_config(policy.config, folder)  # without the device that it was merged on
        for file in sorted(checkpoint.glob("policy_*")):  # the two processors and their tensors
            shutil.copy(file, folder / file.name)
