"""lerobot-train's arguments for a budget: the same for pretraining, training from scratch and fine-tuning."""

from pathlib import Path
from typing import Any

from .conditions import DENOISING_STEPS
from .spec import Budget

WARMUP_STEPS = 50


def network_options(budget: Budget, action_dim: int) -> dict[str, Any]:
    """Options that define a new policy. A checkpoint that is trained further has them already."""
    return {
        "policy.type": "pi05_geometry",
        "policy.paligemma_variant": budget.variant,
        "policy.action_expert_variant": budget.variant,
        "policy.image_resolution": f"[{budget.image_size}, {budget.image_size}]",
        "policy.chunk_size": budget.chunk_size,
        "policy.max_action_dim": action_dim,
    }


def training_options(budget: Budget, steps: int, learning_rate: float, seed: int, log_every: int) -> dict[str, Any]:
    """Options of one training: schedule, batches and logging."""
    return {
        "policy.device": budget.device,
        "policy.push_to_hub": "false",
        "policy.n_action_steps": budget.action_steps,
        "policy.num_inference_steps": DENOISING_STEPS,
        "policy.flow_samples": budget.flow_samples,
        "policy.optimizer_lr": learning_rate,
        "policy.scheduler_decay_lr": learning_rate / 20,
        "policy.scheduler_warmup_steps": min(WARMUP_STEPS, steps),
        "policy.scheduler_decay_steps": steps,
        "batch_size": budget.batch_size,
        "steps": steps,
        "num_workers": 0,
        "log_freq": log_every,
        "save_freq": steps,
        "seed": seed,
    }


def dataset_options(root: Path, repo_id: str, output: Path) -> dict[str, Any]:
    """Options that name the dataset and LeRobot's output folder."""
    return {"dataset.repo_id": repo_id, "dataset.root": root, "output_dir": output}
