"""What fewer denoising steps change in the chunks of a trained policy: error against recorded actions, bias and spread.

    python -m benchmarks.denoising_steps --policy outputs/train/checkpoints/last/pretrained_model --data HELD_OUT

--data is a LeRobotDataset that the policy was not trained on. At each of `--frames` frames, evenly spaced over it, the policy
predicts `--draws` chunks from as many draws of noise, the same for every number of steps. Over frames, draws and action
dimensions, for the actions that would be executed (`n_action_steps`), in the policy's normalised units (quantiles at -1 and 1):

- error: root mean square of predicted - recorded, of a single chunk, which is what a robot executes.
- bias: the same of the mean over draws. It is what the policy does not know.
- spread: standard deviation over draws. error^2 = bias^2 + spread^2, up to the spread's share in a mean of few draws.

One Euler step from noise ends at the mean of the actions that the policy holds for possible, whatever the noise. Many steps end
at one of them, drawn at random. For demonstrations with one way to act, the spread is therefore doubt about the scene, and a
draw from it has twice the mean's squared error if the doubt is well calibrated.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor
from torch.utils.data import default_collate

from lerobot_policy_pi05_geometry.checkpoint.load import LoadedPolicy, load_policy

FRAMES_AT_ONCE = 8


def held_out_frames(policy: LoadedPolicy, root: Path, count: int) -> list[dict[str, Any]]:
    """Batches of evenly spaced frames with their actions as chunks (N, S, A), in the dataset's units."""
    config = policy.policy.config
    fps = LeRobotDatasetMetadata("local/data", root=root).fps
    dataset = LeRobotDataset(
        "local/data",
        root=root,
        delta_timestamps={ACTION: [step / fps for step in range(config.chunk_size)]},
        depth_output_unit=config.depth_unit,
    )
    rows = np.unique(np.linspace(0, len(dataset) - 1, count).astype(int))
    return [
        default_collate([dataset[int(row)] for row in part])
        for part in np.array_split(rows, -(-len(rows) // FRAMES_AT_ONCE))
    ]


@torch.no_grad()
def errors(loaded: LoadedPolicy, batch: dict[str, Any], steps: int, draws: int, noise: Tensor) -> Tensor:
    """Predicted minus recorded actions (draws, N, T, A), normalised; NaN at padding. noise: (draws, N, S, max_action_dim)."""
    config = loaded.policy.config
    prepared = loaded.preprocess(batch)
    recorded = prepared[ACTION][
        ..., : config.action_feature.shape[0]
    ]  # (N, S, A), normalised as the policy predicts them
    loaded.policy.reset()
    chunks = [
        loaded.policy.predict_action_chunk(prepared, noise=noise[draw].to(config.device), num_steps=steps)
        for draw in range(draws)
    ]
    difference = (torch.stack(chunks) - recorded.to(chunks[0])).cpu()
    difference = difference.masked_fill(batch["action_is_pad"][None, :, :, None], float("nan"))
    return difference[:, :, : config.n_action_steps]


def summary(difference: Tensor) -> dict[str, float]:
    """Root mean squares of errors (draws, N, T, A)."""
    mean = difference.mean(dim=0)
    return {
        "error": difference.square().nanmean().sqrt().item(),
        "bias": mean.square().nanmean().sqrt().item(),
        "spread": (difference - mean).square().nanmean().sqrt().item(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", type=Path, required=True, help="checkpoint folder")
    parser.add_argument("--data", type=Path, required=True, help="a LeRobotDataset that it was not trained on")
    parser.add_argument("--steps", type=int, nargs="+", default=[1, 2, 3, 5, 10, 20])
    parser.add_argument("--frames", type=int, default=64)
    parser.add_argument("--draws", type=int, default=16)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--output", type=Path, help="write the numbers to this JSON file")
    args = parser.parse_args()

    loaded = load_policy(args.policy, args.device)
    config = loaded.policy.config
    batches = held_out_frames(loaded, args.data, args.frames)
    generator = torch.Generator().manual_seed(0)
    found: dict[int, list[Tensor]] = {steps: [] for steps in args.steps}
    for batch in track(batches, "predict chunks"):
        shape = (args.draws, len(batch["action_is_pad"]), config.chunk_size, config.max_action_dim)
        noise = torch.randn(shape, generator=generator)
        for steps in args.steps:
            found[steps].append(errors(loaded, dict(batch), steps, args.draws, noise))
    result = {steps: summary(torch.cat(parts, dim=1)) for steps, parts in found.items()}

    table = Table("denoising steps", "error", "bias", "spread")
    for steps, values in result.items():
        table.add_row(str(steps), *(f"{value:.3f}" for value in values.values()))
    Console().print(table)
    if args.output:
        settings = {"policy": args.policy.name, "frames": args.frames, "draws": args.draws}
        args.output.write_text(json.dumps({"settings": settings, "steps": result}, indent=2))


if __name__ == "__main__":
    main()
