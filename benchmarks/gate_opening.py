"""How the geometry gate opens: openness and the actions' attention on geometry against steps, for runs of several lengths.

    python -m benchmarks.gate_opening --output docs/results/gate_opening.json --picture docs/results/gate_opening.png

A policy of the tiny size with the settings of a converted checkpoint, on made-up data: the action is a function of the depth and
the images are noise, so what is taken up is taken up through the gate. It shows the mechanics of gate, rates and schedule (the
warning before a run and the notice at its end are in the log), and says nothing about real tasks.
"""

import argparse
import json
import logging
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from torch import Tensor

from lerobot_policy_pi05_geometry import PI05GeometryConfig
from lerobot_policy_pi05_geometry.checkpoint.conversion.geometry_start import SHUT, TAKE_UP
from lerobot_policy_pi05_geometry.geometry import CameraCalibration
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy

FRONT, DEPTH = "observation.images.front", "observation.images.front_depth"
SIZE, CHUNK, ACTIONS = 28, 6, 4
POSE = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
FAST = TAKE_UP["geometry_gate_lr"]
RUNS = [(500, FAST), (500, 1e-3), (1500, FAST), (3000, FAST)]  # steps, rate of the gate


def build(gate_lr: float) -> PI05GeometryPolicy:
    """A policy as `convert` writes it, but for the rate of the gate."""
    torch.manual_seed(0)
    config = PI05GeometryConfig(
        device="cpu",
        paligemma_variant="tiny",
        action_expert_variant="tiny",
        image_resolution=(SIZE, SIZE),
        chunk_size=CHUNK,
        n_action_steps=CHUNK,
        max_action_dim=ACTIONS,
        geometry_grid=2,
        geometry_positions="parallel",
        geometry_gate_openness=SHUT,
        depth_unit="m",
        calibration={"front": CameraCalibration([20.0, 20.0, 13.5, 13.5], [SIZE, SIZE], POSE)},
        input_features={
            FRONT: PolicyFeature(FeatureType.VISUAL, (3, SIZE, SIZE)),
            DEPTH: PolicyFeature(FeatureType.VISUAL, (1, SIZE, SIZE)),
            "observation.state": PolicyFeature(FeatureType.STATE, (2,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (ACTIONS,))},
        optimizer_lr=1e-3,
        **TAKE_UP | {"geometry_gate_lr": gate_lr},
    )
    return PI05GeometryPolicy(config).train()


def draw(step: int, size: int = 4) -> dict[str, Any]:
    """A batch in which a wall stands at a distance that decides the action."""
    generator = torch.Generator().manual_seed(step)
    distance = 0.4 + torch.rand(size, 1, 1, 1, generator=generator)
    action: Tensor = torch.tanh(4 * (distance - 0.9)).view(size, 1, 1).expand(-1, CHUNK, ACTIONS)
    return {
        FRONT: torch.rand(size, 3, SIZE, SIZE, generator=generator),
        DEPTH: distance.expand(-1, 1, SIZE, SIZE).contiguous(),
        "observation.language.tokens": torch.full((size, 3), 5),
        "observation.language.attention_mask": torch.ones(size, 3, dtype=torch.bool),
        "action": action,
        "index": size * step + torch.arange(size),
    }


def train(steps: int, gate_lr: float) -> dict[str, Any]:
    """One run; numbers every 10 steps."""
    policy = build(gate_lr)
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    schedule = policy.config.get_scheduler_preset().build(optimizer, steps)
    found: dict[str, Any] = {
        "steps": steps,
        "gate_lr": gate_lr,
        "step": [],
        "openness": [],
        "attention": [],
        "loss": [],
    }
    for step in range(steps):
        loss, info = policy.forward(draw(step))
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
        policy.update()
        if step % 10 == 0:
            found["step"].append(step)
            found["openness"].append(info["gate_openness_pct"] / 100)
            found["attention"].append(info["geometry_attention_pct"] / 100)
            found["loss"].append(info["loss"])
    return found


def draw_picture(runs: list[dict[str, Any]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(10, 3.6))
    for run in runs:
        label = f"{run['steps']:,} steps, gate rate {run['gate_lr']:g}"
        for axis, name in zip(axes, ("openness", "attention"), strict=True):
            axis.plot(run["step"], run[name], label=label)
    for axis, title in zip(axes, ("mean openness of the gate", "actions' attention on geometry"), strict=True):
        axis.set(xlabel="step", title=title, yscale="log")
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, help="write the numbers to this JSON file")
    parser.add_argument("--picture", type=Path, help="draw them into this PNG file")
    args = parser.parse_args()
    logging.basicConfig(level=logging.INFO)
    torch.set_num_threads(1)
    runs = []
    for steps, gate_lr in RUNS:
        runs.append(train(steps, gate_lr))
        print(f"{steps} steps, gate rate {gate_lr:g}: openness {runs[-1]['openness'][-1]:.2g}", flush=True)
        if args.output:
            args.output.write_text(json.dumps(runs))
    if args.picture:
        draw_picture(runs, args.picture)


if __name__ == "__main__":
    main()
