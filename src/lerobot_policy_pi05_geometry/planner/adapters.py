"""LoRA over a planned policy: PEFT's own layers, laid as lerobot-train lays them."""

import importlib.util

from lerobot.policies.pretrained import PreTrainedPolicy

SOMEWHERE = "CHECKPOINT"  # LoRA wants to know where it starts from; nothing is read there


def why_not() -> str | None:
    """Why LoRA cannot be planned, as the rest of a sentence; None if it can."""
    if importlib.util.find_spec("peft") is None:
        return "it needs PEFT, which is not installed: `pip install 'lerobot_policy_pi05_geometry[lora]'`"
    return None


def add_lora(policy: PreTrainedPolicy, rank: int) -> None:
    """Freeze what `--peft.r=rank` freezes and lay adapters over `config.lora_targets`, on the spot.

    Raises ValueError without PEFT.
    """
    reason = why_not()
    if reason is not None:
        raise ValueError(f"LoRA cannot be planned: {reason}.")
    known = policy.config.pretrained_path
    policy.config.pretrained_path = known or SOMEWHERE
    policy.wrap_with_peft(peft_cli_overrides={"r": rank, "method_type": "LORA"})
    policy.config.pretrained_path = known
