"""Memory of an optimiser, by its name in the policy's configuration: its state per parameter, and the workspace of a step."""

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from ..training.optim import OPTIMIZERS
from ..training.parameter_groups import FULL_STATE

# torchao: tensors of at least so many numbers, and of whole blocks, keep both moments in 8 bits, with a float32 scale per block
# and a table of 256 numbers each.
EIGHT_BIT_FROM = 4096
EIGHT_BIT_BLOCK = 256
# Workspace of torchao's step for one quantised parameter, in float32 copies of it, measured with PyTorch's CPU allocator: without
# a compiler (as on a CPU), and compiled (as on a GPU, where it has not been measured).
EAGER_COPIES, COMPILED_COPIES = 13.26, 2.01


def state_bytes(optimizer: str, parameter: Tensor, full: bool = False) -> list[int]:
    """Bytes of each tensor that the optimiser keeps on the device for this parameter; step counts stay on the CPU.

    adamw: two moments in the parameter's dtype (torch.optim.AdamW). adamw8bit: codes, scales and tables of two moments
    (torchao), or two moments as AdamW's for small tensors, and with `full`. Raises ValueError for another name.
    """
    count = parameter.numel()
    if optimizer not in OPTIMIZERS:
        raise ValueError(f"The planner knows the optimisers {' and '.join(OPTIMIZERS)}, not '{optimizer}'.")
    if optimizer == "adamw8bit" and not full and _quantised(parameter):
        return [count, count // EIGHT_BIT_BLOCK * 4, 256 * 4] * 2
    return [count * parameter.element_size()] * 2


def step_bytes(
    optimizer: str, groups: Sequence[Mapping[str, Any]], block: int = 1, foreach: bool = True
) -> tuple[int, int]:
    """Bytes of all state, and of the workspace of a step, for parameter groups as an optimiser takes them.

    foreach: as on CUDA. There PyTorch's AdamW updates all tensors of one group at once and holds the square roots of all their
    second moments, as much as the parameters. On a CPU it updates one by one, and holds twice the largest parameter.
    block: bytes that the allocator rounds up to.
    """
    states, workspace = 0, 0
    for group in groups:
        parameters, full = group["params"], bool(group.get(FULL_STATE))
        states += sum(rounded(size, block) for p in parameters for size in state_bytes(optimizer, p, full))
        sizes = [rounded(p.nbytes, block) for p in parameters]
        if optimizer == "adamw":
            needed = sum(sizes) if foreach else 2 * max(sizes, default=0)
        else:
            largest = max((p.numel() for p in parameters if not full and _quantised(p)), default=0)
            needed = int((COMPILED_COPIES if foreach else EAGER_COPIES) * 4 * largest)
        workspace = max(workspace, needed)
    return states, workspace


def rounded(size: int, block: int) -> int:
    return -(-size // block) * block


def _quantised(parameter: Tensor) -> bool:
    return parameter.numel() >= EIGHT_BIT_FROM and parameter.numel() % EIGHT_BIT_BLOCK == 0
