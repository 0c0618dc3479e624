"""Held-out loss against training time, for several values of one training option, in one run.

    python -m benchmarks.learning --vary flow_samples 1 2 4 8
    python -m benchmarks.learning --vary optimizer adamw adamw8bit

A small policy with a depth camera is trained on the demo's task from scripted experts (recorded on first use to `--data`). Every
value is trained from the same seeds in one process, a few steps in turn, at a constant learning rate after a short warm-up, so
that losses at equal steps are comparable. The loss is measured on held-out episodes, with the same noise and flow times for
all values. Time is the process's CPU time of training only, so other load on the machine has little effect.
"""

import argparse
import itertools
import json
import platform
import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_policy, make_pre_post_processors
from torch.utils.data import DataLoader, default_collate

from lerobot_policy_pi05_geometry import PI05GeometryConfig
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from lerobot_policy_pi05_geometry.sim.record import record
from lerobot_policy_pi05_geometry.study.frames_in_memory import FramesInMemory

TASK, REPO_ID, CHUNK = "button-press-topdown-wide", "local/learning", 8
HELD_OUT = 0.1  # of the episodes
EVALUATED = 256  # frames
STEPS_IN_TURN = 10
EVALUATION_SAMPLES = 4  # flow samples per held-out frame


@dataclass
class Learner:
    """One policy in training, and its curve: (CPU seconds of training, held-out loss) from step 0 on."""

    value: str
    seed: int
    policy: PI05GeometryPolicy
    preprocess: Any
    optimizer: torch.optim.Optimizer
    warm_up: torch.optim.lr_scheduler.LRScheduler
    batches: Iterator[dict]
    seconds: float = 0.0
    curve: list[tuple[float, float]] = field(default_factory=list)

    def train(self, steps: int) -> None:
        start = time.process_time()
        self.policy.train()
        for batch in itertools.islice(self.batches, steps):
            loss, _ = self.policy(self.preprocess(batch))
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self.policy.parameters(), 1.0)
            self.optimizer.step()
            self.optimizer.zero_grad()
            self.warm_up.step()
            self.policy.update()
        self.seconds += time.process_time() - start

    @torch.no_grad()
    def evaluate(self, batches: list[dict]) -> None:
        self.policy.eval()
        with _flow_samples(self.policy, EVALUATION_SAMPLES):
            losses = [self.policy(self.preprocess(dict(batch)))[0].item() for batch in batches]
        self.curve.append((self.seconds, statistics.mean(losses)))


@contextmanager
def _flow_samples(policy: PI05GeometryPolicy, count: int) -> Iterator[None]:
    """Evaluate with a fixed number of flow samples, whatever the option's value."""
    trained_with, policy.config.flow_samples = policy.config.flow_samples, count
    try:
        yield
    finally:
        policy.config.flow_samples = trained_with


def dataset(root: Path, episodes: list[int] | None, fps: int) -> FramesInMemory:
    deltas = {"action": [step / fps for step in range(CHUNK)]}
    return FramesInMemory(
        LeRobotDataset(REPO_ID, root=root, episodes=episodes, delta_timestamps=deltas, depth_output_unit="m")
    )


def endless(frames: FramesInMemory, batch_size: int, seed: int) -> Iterator[dict]:
    """Shuffled batches without end; the seed determines the order."""
    order = torch.Generator().manual_seed(seed)
    while True:
        yield from DataLoader(frames, batch_size=batch_size, shuffle=True, drop_last=True, generator=order)


def make_learner(args: argparse.Namespace, value: str, seed: int, frames: FramesInMemory, meta: Any) -> Learner:
    options = {args.vary[0]: int(value) if value.isdigit() else value}
    torch.manual_seed(seed)
    config = PI05GeometryConfig(
        paligemma_variant=args.variant,
        action_expert_variant=args.variant,
        geometry_source="rgbd",
        image_resolution=(84, 84),
        chunk_size=CHUNK,
        n_action_steps=CHUNK,
        max_action_dim=4,
        optimizer_lr=args.rate,
        depth_unit="m",
        device="cpu",
        push_to_hub=False,
        **{"flow_samples": 4, **options},
    )
    policy = make_policy(config, ds_meta=meta)
    preprocess, _ = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    warm_up = torch.optim.lr_scheduler.LinearLR(optimizer, 0.02, total_iters=50)
    return Learner(value, seed, policy, preprocess, optimizer, warm_up, endless(frames, args.batch_size, seed))


def seconds_to(curve: list[tuple[float, float]], loss: float) -> float | None:
    """CPU seconds until a curve first reaches a loss, with linear interpolation between its points; None if never."""
    for (t0, l0), (t1, l1) in itertools.pairwise(curve):
        if l1 <= loss:
            return t1 if l0 <= loss else t0 + (t1 - t0) * (l0 - loss) / (l0 - l1)
    return None


def table(learners: list[Learner], steps: int) -> dict[str, dict]:
    """Per value: final held-out loss (mean and standard deviation over seeds), and time relative to the first value's."""
    values = list(dict.fromkeys(learner.value for learner in learners))
    first = {learner.seed: learner for learner in learners if learner.value == values[0]}
    rows = {}
    for value in values:
        of_value = [learner for learner in learners if learner.value == value]
        last = [learner.curve[-1][1] for learner in of_value]
        reached = [seconds_to(learner.curve, first[learner.seed].curve[-1][1]) for learner in of_value]
        whole = [first[learner.seed].seconds for learner in of_value]
        times = [r / w for r, w in zip(reached, whole, strict=True) if r is not None]
        rows[value] = {
            "loss": statistics.mean(last),
            "spread": statistics.stdev(last) if len(last) > 1 else None,
            "difference": statistics.mean(x.curve[-1][1] - first[x.seed].curve[-1][1] for x in of_value),
            "step_ms": 1e3 * statistics.mean(learner.seconds for learner in of_value) / steps,
            "step_ratio": statistics.mean(x.seconds / w for x, w in zip(of_value, whole, strict=True)),
            "reached": len(times),
            "time_to_same_loss": statistics.mean(times) if times else None,
            "curves": {learner.seed: learner.curve for learner in of_value},
        }
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vary", nargs="+", required=True, metavar=("OPTION", "VALUE"), help="a policy option")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--evaluate-every", type=int, default=50)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--batch-size", type=int, default=16)
    parser.add_argument("--rate", type=float, default=5e-4)
    parser.add_argument("--variant", default="small")
    parser.add_argument("--data", type=Path, default=Path("outputs/learning_data"))
    parser.add_argument("--output", type=Path, help="JSON file for results and curves")
    args = parser.parse_args()

    if not args.data.exists():
        for done, _ in record(args.data, REPO_ID, TASK, args.episodes):
            print(f"\rrecorded {done}/{args.episodes}", end="", flush=True)
        print()
    meta = LeRobotDataset(REPO_ID, root=args.data).meta
    cut = round(meta.total_episodes * (1 - HELD_OUT))
    frames = dataset(args.data, list(range(cut)), meta.fps)
    unseen = dataset(args.data, list(range(cut, meta.total_episodes)), meta.fps)
    chosen = torch.linspace(0, len(unseen) - 1, min(EVALUATED, len(unseen))).long().tolist()
    held_out = [default_collate([unseen[i] for i in chosen[at : at + 64]]) for at in range(0, len(chosen), 64)]

    learners = [make_learner(args, value, seed, frames, meta) for seed in args.seeds for value in args.vary[1:]]
    for step in range(0, args.steps + 1, STEPS_IN_TURN):
        for learner in learners:
            if step:
                learner.train(STEPS_IN_TURN)
            if step % args.evaluate_every == 0:
                learner.evaluate(held_out)
        if step % args.evaluate_every == 0:
            print(step, " ".join(f"{learner.value}: {learner.curve[-1][1]:.4f}" for learner in learners), flush=True)

    rows = table(learners, args.steps)
    for value, row in rows.items():
        print(f"{value:10}", {name: row[name] for name in row if name != "curves"})
    if args.output:
        machine = f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads"
        settings = {k: str(v) if isinstance(v, Path) else v for k, v in vars(args).items() if k != "output"}
        args.output.write_text(json.dumps({"machine": machine, "settings": settings, "values": rows}, indent=2))


if __name__ == "__main__":
    main()
