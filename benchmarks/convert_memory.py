"""Peak memory of `pi05-geometry convert` and `export` at the released size, on random weights.

    python -m benchmarks.convert_memory --folder SCRATCH        needs about 15 GB of disk there, and removes what it wrote

A bfloat16 checkpoint in openpi's layout is written from one block of random bytes, converted, and exported again, each in a
process of its own. "peak" is what that process needs above what it held after its imports (Linux's VmHWM).
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

from benchmarks.lerobot_pi05 import build_lerobot_pi05
from benchmarks.network import high_water_mark
from lerobot_policy_pi05_geometry.checkpoint.conversion import convert, export
from lerobot_policy_pi05_geometry.checkpoint.conversion.names import EMBEDDING
from lerobot_policy_pi05_geometry.checkpoint.conversion.tensor_file import StoredTensor, read_tensors, write_tensors

WEIGHTS = "model.safetensors"


def write_source(folder: Path, paligemma: str = "gemma_2b", expert: str = "gemma_300m", pixels: int = 224) -> None:
    """A π0.5, of the released size by default, with random bfloat16 weights, the embedding under its tied head's name."""
    with torch.device("meta"):
        network = build_lerobot_pi05(paligemma, expert, image_size=pixels, chunk_size=50, max_action_dim=32)
    shapes = {name: tuple(t.shape) for name, t in network.state_dict().items() if name != EMBEDDING}
    folder.mkdir()
    block = folder / "block"
    with block.open("wb") as file:
        left = max(torch.Size(shape).numel() for shape in shapes.values())
        generator = torch.Generator().manual_seed(0)
        while left:
            count = min(left, 1 << 22)
            values = (0.02 * torch.randn(count, generator=generator)).bfloat16()
            file.write(values.view(torch.uint8).numpy().tobytes())
            left -= count
    write_tensors(folder / WEIGHTS, {name: StoredTensor(block, "BF16", shape, 0) for name, shape in shapes.items()})
    block.unlink()
    (folder / "config.json").write_text(
        json.dumps({"action_horizon": 50, "paligemma_variant": paligemma, "action_expert_variant": expert})
    )


def measure(step: str, source: Path, output: Path) -> dict[str, float]:
    """Peak GiB above the imports, and seconds, of one step in this process."""
    before, start = high_water_mark(), time.perf_counter()
    if step == "convert":
        convert(source, output, tokenizer="built-in")
    else:
        export(source, output)
    return {"peak_GiB": high_water_mark() - before, "imports_GiB": before, "seconds": time.perf_counter() - start}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="where to write; the system's temporary folder by default")
    parser.add_argument("--output", type=Path, help="write the numbers to this JSON file")
    parser.add_argument("--step", nargs=3, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.step:
        print(json.dumps(measure(args.step[0], Path(args.step[1]), Path(args.step[2]))))
        return

    scratch = Path(tempfile.mkdtemp(prefix="convert_memory_", dir=args.folder))
    result: dict[str, dict[str, float]] = {}
    try:
        source, policy, back = scratch / "source", scratch / "policy", scratch / "back"
        write_source(source)
        for step, before, after in (("convert", source, policy), ("export", policy, back)):
            command = [sys.executable, "-m", "benchmarks.convert_memory", "--step", step, str(before), str(after)]
            output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
            result[step] = json.loads(output.splitlines()[-1])
            result[step] |= {
                "read_GiB": (before / WEIGHTS).stat().st_size / 2**30,
                "written_GiB": (after / WEIGHTS).stat().st_size / 2**30,
                "tensors": len(read_tensors(after / WEIGHTS)),
            }
            shutil.rmtree(before)
    finally:
        shutil.rmtree(scratch)
    for step, numbers in result.items():
        print(f"{step:8}" + "".join(f"{name} {value:.2f}   " for name, value in numbers.items()))
    if args.output:
        args.output.write_text(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
