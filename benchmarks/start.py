"""Seconds until a command says something, until the first training step and the first action; and what is imported on the way.

    python -m benchmarks.start                 every row in processes of its own, in turn, three times; the median
    python -m benchmarks.start --imports       and where the imports of the package spend their time, by package

Seconds are of a processor, since others may use the machine, beside those that passed. The first round, which reads files from
disk, is not counted. Networks are of the small size, so that what is measured is the start and not the step. Of LeRobot's π0.5
there is the network alone, without processors.
"""

import argparse
import collections
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HELP = ["-m", "pi05_geometry_cli", "--help"]
ROWS = {
    "pi05-geometry --help": HELP,
    "python -c 'import torch'": ["-c", "import torch"],
    "import lerobot.policies": ["-c", "import lerobot.policies"],
    "import lerobot_policy_pi05_geometry (registers the policy)": ["-c", "import lerobot_policy_pi05_geometry"],
    "import of the policy class": ["-c", "from lerobot_policy_pi05_geometry import PI05GeometryPolicy"],
    "import of LeRobot's π0.5 class": ["-c", "from lerobot.policies.pi05.modeling_pi05 import PI05Policy"],
    "import of lerobot-train": ["-c", "import lerobot.scripts.lerobot_train, lerobot_policy_pi05_geometry"],
    "first action, from a checkpoint": ["-m", "benchmarks.start", "--worker", "act"],
    "first training step, from a checkpoint": ["-m", "benchmarks.start", "--worker", "train"],
    "first action of LeRobot's π0.5, random weights": ["-m", "benchmarks.start", "--worker", "act-lerobot"],
    "first training step of LeRobot's π0.5, random weights": ["-m", "benchmarks.start", "--worker", "train-lerobot"],
}


# --- in a process of its own ------------------------------------------------------------------------------------------


def work(kind: str, folder: Path) -> None:
    """Act or train once. Imports are part of what is measured."""
    if kind.endswith("lerobot"):
        _lerobot(kind == "train-lerobot")
        return
    from lerobot_policy_pi05_geometry.checkpoint.load import load_policy
    from lerobot_policy_pi05_geometry.inspect.bench import random_observation

    loaded = load_policy(folder)
    policy, batch = loaded.policy, loaded.preprocess(random_observation(loaded.policy.config))
    if kind == "act":
        loaded.postprocess(policy.select_action(batch))
        return
    import torch

    policy.train()
    batch["action"] = torch.zeros(1, policy.config.chunk_size, policy.config.action_feature.shape[0])
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    policy.forward(batch)[0].backward()
    optimizer.step()


def _lerobot(training: bool) -> None:
    import torch

    from benchmarks.lerobot_pi05 import build_lerobot_pi05

    network = build_lerobot_pi05("small", "small", image_size=84, chunk_size=50, max_action_dim=32)
    images, present = [torch.rand(1, 3, 84, 84) * 2 - 1], [torch.ones(1, dtype=torch.bool)]
    tokens, mask = torch.ones(1, 200, dtype=torch.long), torch.ones(1, 200, dtype=torch.bool)
    if not training:
        network.eval()
        with torch.no_grad():
            network.sample_actions(images, present, tokens, mask)
        return
    optimizer = torch.optim.AdamW(network.parameters())
    actions = torch.zeros(1, 50, 32)
    network(images, present, tokens, mask, actions, torch.randn_like(actions), torch.rand(1)).mean().backward()
    optimizer.step()


# --- around them ------------------------------------------------------------------------------------------------------


def used(arguments: list[str], folder: Path) -> tuple[float, float]:
    """Seconds of a processor and seconds passed, of one process."""
    more = ["--folder", str(folder)] if "--worker" in arguments else []
    before, start = os.times(), time.perf_counter()
    subprocess.run([sys.executable, *arguments, *more], check=True, capture_output=True)
    after = os.times()
    return sum(after[2:4]) - sum(before[2:4]), time.perf_counter() - start


def imported() -> dict[str, float]:
    """Seconds that importing the package spends inside each top-level package, the longest first."""
    command = [sys.executable, "-X", "importtime", "-c", "import lerobot_policy_pi05_geometry"]
    report = subprocess.run(command, check=True, capture_output=True, text=True).stderr
    own: dict[str, float] = collections.defaultdict(float)
    for microseconds, name in re.findall(r"import time:\s+(\d+) \|\s+\d+ \|\s+(\S+)", report):
        own[name.partition(".")[0]] += int(microseconds) / 1e6
    return dict(sorted(own.items(), key=lambda item: -item[1])[:12])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--imports", action="store_true")
    parser.add_argument("--output", help="write the numbers to this JSON file")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker == "write":
        from benchmarks.serving import write_checkpoint

        write_checkpoint(args.folder, "small")
        return
    if args.worker:
        work(args.worker, args.folder)
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        used(["-m", "benchmarks.start", "--worker", "write"], folder)
        times: dict[str, list[tuple[float, float]]] = {row: [] for row in ROWS}
        for _ in range(args.rounds + 1):
            for row, arguments in ROWS.items():
                times[row].append(used(arguments, folder))
    result = {}
    for row, (_, *counted) in times.items():
        processor, passed = (statistics.median(column) for column in zip(*counted, strict=True))
        result[row] = {"processor_seconds": processor, "seconds": passed}
        print(f"{row:62} {processor:6.2f} s of a processor, {passed:6.2f} s passed")
    if args.imports:
        result["imports"] = imported()
        for name, seconds in result["imports"].items():
            print(f"  {name:30} {seconds:6.2f} s")
    if args.output:
        Path(args.output).write_text(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
