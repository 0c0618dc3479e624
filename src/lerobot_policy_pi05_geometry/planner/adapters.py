"""LoRA in a planned policy: PEFT's own layers, added as lerobot-train adds them."""

import importlib.util

from lerobot.policies.pretrained import PreTrainedPolicy

SOMEWHERE = "CHECKPOINT"  # LeRobot refuses LoRA without a pretrained path; nothing is read from it


def unsupported_reason() -> str | None:
    """Why LoRA cannot be planned, as the rest of a sentence; None if it can."""
    if importlib.util.find_spec("peft") is None:
        return "it needs PEFT, which is not installed: `pip install 'lerobot_policy_pi05_geometry[lora]'`"
    return None


def add_lora(policy: PreTrainedPolicy, rank: int) -> None:
    """Freeze what `--peft.r=rank` freezes and add adapters to `config.lora_targets`, in place.

    Raises ValueError without PEFT.
    """
    reason = unsupported_reason()
    if reason is not None:
        raise ValueError(f"LoRA cannot be planned: {reason}.")
    known = policy.config.pretrained_path
    policy.config.pretrained_path = known or SOMEWHERE
    policy.wrap_with_peft(peft_cli_overrides={"r": rank, "method_type": "LORA"})
    policy.config.pretrained_path = known
