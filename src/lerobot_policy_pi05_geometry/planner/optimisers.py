"""What an optimiser keeps per parameter, and what a step needs on top of that, by its name."""

from collections.abc import Sequence

from torch import Tensor

# bitsandbytes: smaller tensors keep 32-bit states; the others share one scale per block, and two maps of 256 numbers.
EIGHT_BIT_FROM = 4096  # elements
EIGHT_BIT_BLOCK = 256  # elements
EIGHT_BIT_MAPS = 2 * 256 * 4  # bytes


def state_bytes(optimizer: str, parameter: Tensor) -> list[int]:
    """Bytes of each tensor that the optimiser keeps on the device for this parameter.

    adamw: two moments in the parameter's dtype (torch.optim.AdamW; its step count stays on the CPU). adamw8bit: two moments
    of one byte and a float32 scale per block (bitsandbytes' AdamW8bit), for small tensors two of four.
    Raises ValueError for another name.
    """
    count = parameter.numel()
    if optimizer == "adamw":
        return [count * parameter.element_size()] * 2
    if optimizer == "adamw8bit":
        if count < EIGHT_BIT_FROM:
            return [4 * count] * 2
        return [count] * 2 + [-(-count // EIGHT_BIT_BLOCK) * 4] * 2
    raise ValueError(f"The planner knows the optimisers adamw and adamw8bit, not '{optimizer}'.")


def step_bytes(optimizer: str, parameters: Sequence[Tensor], block: int = 1, foreach: bool = True) -> tuple[int, int]:
    """Bytes of all state, and of what a step needs beside it.

    foreach: PyTorch's AdamW updates all tensors of one group at once, its default on CUDA, and holds the square roots of all
    second moments meanwhile, once the parameters' size again; one by one (on a CPU), twice the largest parameter. 8-bit
    kernels work in place. block: what the allocator rounds up to.
    """
    states = sum(_rounded(size, block) for parameter in parameters for size in state_bytes(optimizer, parameter))
    if optimizer == "adamw8bit":
        return states + EIGHT_BIT_MAPS, 0
    sizes = [_rounded(parameter.numel() * parameter.element_size(), block) for parameter in parameters]
    return states, sum(sizes) if foreach else 2 * max(sizes, default=0)


def _rounded(size: int, block: int) -> int:
    return -(-size // block) * block
