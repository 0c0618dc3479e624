"""How much memory a GPU has, by name or number, and the margins that a prediction leaves free."""

from .counting import MemorySplit

GIB = 2**30

# MiB, as nvidia-smi reports them, without the share of the driver and of ECC.
GPUS = {
    "rtx3090": 24_576,
    "rtx4090": 24_564,
    "rtx5090": 32_607,
    "a10": 23_028,
    "l4": 23_034,
    "a40": 46_068,
    "l40s": 46_068,
    "rtx6000ada": 49_140,
    "a100-40": 40_960,
    "a100-80": 81_920,
    "h100": 81_559,
    "h200": 143_771,
    "b200": 183_359,
}

# Assumed, not measured here: the memory of CUDA, cuBLAS and cuDNN outside of PyTorch's allocator (context and kernels) and inside
# of it (workspaces, 32 MiB on Hopper), and the memory lost to fragmentation.
CONTEXT = int(0.75 * GIB)
FRAGMENTATION = 0.05  # of the predicted peak


def gpu_bytes(gpu: str) -> int:
    """Bytes of a GPU: "24" (GiB) or a name of the table, written in any way. Raises ValueError for another name."""
    name = "".join(c for c in gpu.lower().replace("nvidia", "").replace("geforce", "") if c not in " _")
    found = GPUS.get(name) or GPUS.get(name.replace("-", ""))
    if found is not None:
        return found * 2**20
    try:
        number = float(name.removesuffix("gib").removesuffix("gb"))
    except ValueError:
        number = 0.0
    if not 0 < number < 10_000:
        raise ValueError(
            f"'{gpu}' is not a GPU that the planner knows; give its memory in GB (--gpu 24), or {', '.join(GPUS)}."
        )
    return int(number * GIB)


def needed(split: MemorySplit) -> int:
    """Bytes that a GPU must have for a prediction, margins included."""
    return int(split.total * (1 + FRAGMENTATION)) + CONTEXT
