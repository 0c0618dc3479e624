"""The two ways of `model/attention.py`, side by side: scaled_dot_product_attention and two written-out products.

    python -m benchmarks.attention [--device cuda]

Per case the median over rounds of written-out / SDPA time, forward alone and with backward; above 1 SDPA is faster.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from lerobot_policy_pi05_geometry.model.attention import attention_weights, fold_heads, logit_bias

# name: batch, heads, queries, keys, head_dim, dtype
CASES = {
    "small, suffix in training": (16, 8, 32, 153, 16, torch.float32),
    "small, geometry in training": (16, 8, 64, 121, 16, torch.float32),
    "small, denoising": (10, 8, 8, 129, 16, torch.float32),
    "released, prefix": (1, 8, 968, 968, 256, torch.bfloat16),
    "released, denoising": (1, 8, 50, 1082, 256, torch.bfloat16),
}


def written_out(q: Tensor, k: Tensor, v: Tensor, mask: Tensor) -> Tensor:
    return torch.matmul(fold_heads(attention_weights(q, k, mask), v.shape[1]), v).view_as(q)


def sdpa(q: Tensor, k: Tensor, v: Tensor, mask: Tensor) -> Tensor:
    k, v = (x.expand(-1, q.shape[1], -1, -1) for x in (k, v))
    return F.scaled_dot_product_attention(q, k, v, attn_mask=logit_bias(mask, None, q.dtype))


def seconds(function: Callable[[], Tensor], backward: bool, repeat: int, device: str) -> float:
    start = time.perf_counter()
    for _ in range(repeat):
        output = function()
        if backward:
            output.sum().backward()
    if device == "cuda":
        torch.cuda.synchronize()
    return (time.perf_counter() - start) / repeat


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--output", help="write the numbers to this JSON file")
    args = parser.parse_args()
    results = {}
    for name, (batch, heads, queries, keys, dim, dtype) in CASES.items():
        generator = torch.Generator().manual_seed(0)
        q, k, v = (
            torch.randn(batch, h, n, dim, generator=generator).to(args.device, dtype).requires_grad_()
            for h, n in ((heads, queries), (1, keys), (1, keys))
        )
        mask = torch.ones(batch, 1, keys, dtype=torch.bool, device=args.device)
        row = {}
        for part, backward in (("forward", False), ("forward and backward", True)):
            with torch.set_grad_enabled(backward):
                ratios = []
                for _ in range(args.rounds + 1):
                    ours = seconds(lambda: written_out(q, k, v, mask), backward, args.repeat, args.device)  # noqa: B023
                    theirs = seconds(lambda: sdpa(q, k, v, mask), backward, args.repeat, args.device)  # noqa: B023
                    ratios.append(ours / theirs)
            row[part] = statistics.median(ratios[1:])
        results[name] = row
        print(f"{name:30} forward {row['forward']:5.2f}   with backward {row['forward and backward']:5.2f}")
    if args.output:
        with open(args.output, "w") as file:
            json.dump(results, file, indent=2)


if __name__ == "__main__":
    main()
