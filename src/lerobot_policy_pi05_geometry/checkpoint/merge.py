"""A checkpoint trained with LoRA -> one without, that acts the same and needs neither PEFT nor the policy it came from."""

import shutil
from pathlib import Path

from ..weight_files.files import new_folder
from .load import load_policy

ADAPTER_CONFIG = "adapter_config.json"


def merge(checkpoint: Path, output: Path) -> None:
    """Write `output`: the weights with LoRA folded in, settings and processors.

    Raises FileNotFoundError if `checkpoint` has no LoRA or what it was trained from is gone, FileExistsError if `output`
    is there; then nothing is left behind.
    """
    if not (checkpoint / ADAPTER_CONFIG).is_file():
        raise FileNotFoundError(f"{checkpoint} has no {ADAPTER_CONFIG}: it was not trained with LoRA.")
    policy = load_policy(checkpoint).policy
    size = sum(tensor.numel() * tensor.element_size() for tensor in policy.state_dict().values())
    with new_folder(output, size) as folder:
        policy.save_pretrained(folder)
        for file in sorted(checkpoint.glob("policy_*")):  # the two processors and their tensors
            shutil.copy(file, folder / file.name)
