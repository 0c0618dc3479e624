"""Strict loading: a safetensors file fills a module whole or not at all, and the error says what is wrong with it."""

from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from torch import nn

_NAMED = 5  # how many tensors an error names


def load_strictly(module: nn.Module, path: str | Path, prefix: str = "", others: tuple[str, ...] = ()) -> None:
    """Fill `module` from a safetensors file, tensor by tensor, cast to the dtype each parameter is stored in.

    Everything is checked before anything is written. Parameters on the meta device become real ones, so no second copy
    of the model is ever held. prefix: what the module's names stand behind in the file. others: how the names of tensors
    begin that the file may hold beside them, and that are left out.

    Raises ValueError for a file that is truncated, or tensors that are missing, unknown, or of a wrong shape or dtype.
    """
    expected = {prefix + name: tensor for name, tensor in module.state_dict().items()}
    try:
        with safe_open(path, framework="pt") as file:
            names = {name for name in file.keys() if not name.startswith(others)}  # noqa: SIM118
            complain(path, "lacks", sorted(set(expected) - names))
            complain(path, "has unknown", sorted(names - set(expected)))
            wrong = []
            for name, target in expected.items():
                stored = file.get_slice(name)
                shape, dtype = tuple(stored.get_shape()), stored.get_dtype()
                if shape != tuple(target.shape):
                    wrong.append(f"{name} (shape {shape}, expected {tuple(target.shape)})")
                elif dtype.startswith(("F", "BF")) != target.is_floating_point():
                    wrong.append(f"{name} (dtype {dtype}, expected {target.dtype})")
            complain(path, "has wrong", wrong)
            for name, target in expected.items():
                # A clone, not the memory-mapped file, which could be overwritten beneath a running policy.
                _assign(module, name.removeprefix(prefix), file.get_tensor(name).to(target.dtype).clone())
    except SafetensorError as error:
        raise ValueError(f"{path} is truncated or no safetensors file ({error}); copy or download it again.") from error


def complain(path: str | Path, what: str, names: list[str], left: str = "nothing was loaded") -> None:
    """Raise ValueError if there are `names`, tensors of a file that `what` is wrong with; `left` says what it led to."""
    if names:
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        raise ValueError(f"Checkpoint {path} {what} tensors: {', '.join(names[:_NAMED])}{more}; {left}.")


def _assign(module: nn.Module, name: str, tensor: torch.Tensor) -> None:
    parent_name, _, leaf = name.rpartition(".")
    parent = module.get_submodule(parent_name)
    old = getattr(parent, leaf)
    if isinstance(old, nn.Parameter):
        tensor = nn.Parameter(tensor, requires_grad=old.requires_grad)
    setattr(parent, leaf, tensor)
