"""The path of a user who starts from a π0.5, at the released size, on random weights: time and peak memory of each command.

    python -m benchmarks.warm_start_path --folder SCRATCH [--geometry rgbd] [--size tiny]

convert -> precompute (for features) -> lerobot-train --peft, two steps -> merge -> one action chunk. At the released size in
bfloat16 it needs some 16 GB of memory and 25 GB of disk at SCRATCH, which it leaves as it found it. The encoder has DA3-BASE's
architecture and random weights. Every command is the one that a user types, in a process of its own; "peak" is that process's
largest resident set. The data are one episode of the simulated RGB-D environment, or `--data`. With `--device cuda` training and
the chunk are on a GPU.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch
from safetensors.torch import save_file

from benchmarks.convert_memory import WEIGHTS, write_source
from lerobot_policy_pi05_geometry.geometry.da3 import BACKBONE_PREFIX, VARIANTS, Da3Backbone

SIZES = {"gemma_2b": ("gemma_2b", "gemma_300m", 224), "small": ("small", "small", 224), "tiny": ("tiny", "tiny", 28)}


def write_encoder(folder: Path, variant: str) -> Path:
    """A Depth Anything 3 with random weights, as released."""
    torch.manual_seed(0)
    folder.mkdir()
    tensors = {BACKBONE_PREFIX + name: tensor for name, tensor in Da3Backbone(VARIANTS[variant]).state_dict().items()}
    save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, folder / WEIGHTS)
    return folder


def run(name: str, command: list[str], log: Path) -> dict[str, float]:
    """Seconds and peak GiB of a command. Raises RuntimeError with the end of its output if it fails."""
    print(f"{name}: {' '.join(command)}", flush=True)
    start = time.perf_counter()
    with log.open("wb") as file:
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)  # or Popen would wait for it once more
    if process.returncode:
        raise RuntimeError(f"{name} failed with {process.returncode}:\n{log.read_text()[-3000:]}")
    found = {"seconds": time.perf_counter() - start, "peak_GiB": usage.ru_maxrss / 2**20}
    print(f"  {found['seconds']:.0f} s, {found['peak_GiB']:.2f} GiB", flush=True)
    return found


def program(name: str) -> str:
    """A command of this environment. Raises FileNotFoundError."""
    beside = Path(sys.executable).parent / name
    if found := str(beside) if beside.exists() else shutil.which(name):
        return found
    raise FileNotFoundError(f"There is no command {name}; install this project as the README says.")


def commands(geometry: str, size: str, scratch: Path, data: Path, device: str) -> list[tuple[str, list[str]]]:
    """Names and commands of the path, in order."""
    run_ = scratch / "run"
    ours, train = program("pi05-geometry"), program("lerobot-train")
    policy, merged, encoder = scratch / "policy", scratch / "merged", scratch / "encoder"
    last = run_ / "checkpoints" / "last" / "pretrained_model"
    convert = [
        ours,
        "convert",
        str(scratch / "source"),
        str(policy),
        "--geometry-source",
        geometry,
        "--features-from-data",
    ]
    convert += ["--tokenizer-path", "built-in"]
    precompute = []
    if geometry == "features":
        convert += ["--da3-encoder", str(encoder)]
        precompute = [
            (
                "precompute",
                [ours, "precompute", f"--dataset.root={data}", "--encoder", str(encoder), "--batch-size", "4"],
            )
        ]
    return [
        ("convert", convert),
        *precompute,
        (
            "train",
            [
                train, f"--policy.path={policy}", f"--policy.device={device}", "--policy.push_to_hub=false",
                "--policy.gradient_checkpointing=true", "--policy.lora_targets=expert", "--peft.r=8",
                "--dataset.repo_id=local/data", f"--dataset.root={data}", f"--output_dir={run_}", "--steps=2", "--save_freq=2",
                "--log_freq=1", "--batch_size=1", "--num_workers=0", "--wandb.enable=false",
            ],
        ),
        ("merge", [ours, "merge", str(last), str(merged)]),
        ("chunk", [ours, "bench", str(merged), "--rounds", "1", f"--dataset.root={data}", "--device", device]),
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="where to write; the system's temporary folder by default")
    parser.add_argument("--geometry", default="features", choices=["features", "da3", "rgbd"])
    parser.add_argument("--size", default="gemma_2b", choices=SIZES)
    parser.add_argument("--data", type=Path, help="a LeRobotDataset with the simulated environment's features")
    parser.add_argument("--device", default="cpu", help="of training and of the chunk")
    parser.add_argument("--output", type=Path, help="write the numbers to this JSON file")
    args = parser.parse_args()
    if args.folder is not None:
        args.folder.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix="warm_start_", dir=args.folder))
    try:
        paligemma, expert, pixels = SIZES[args.size]
        write_source(scratch / "source", paligemma, expert, pixels)
        if args.geometry != "rgbd":
            write_encoder(scratch / "encoder", "base" if args.size == "gemma_2b" else "tiny")
        data = scratch / "data"
        if args.data:
            shutil.copytree(args.data, data)  # precompute adds features to it
        else:
            run("record", [program("pi05-geometry"), "record", "--episodes", "1", f"--output={data}"], scratch / "log")
        steps = commands(args.geometry, args.size, scratch, data, args.device)
        result = {name: run(name, command, scratch / "log") for name, command in steps}
        print((scratch / "log").read_text()[-1500:])
    finally:
        shutil.rmtree(scratch)
    if args.output:
        args.output.write_text(
            json.dumps({"geometry": args.geometry, "size": args.size, "device": args.device, **result}, indent=2)
        )


if __name__ == "__main__":
    main()
