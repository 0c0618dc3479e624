"""Strict loading: a safetensors file fills a module completely, or is refused with the reason."""

from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from torch import nn

_NAMED = 5  # how many tensors an error names


def load_strictly(module: nn.Module, path: str | Path, prefix: str = "", others: tuple[str, ...] = ()) -> None:
    """Fill `module` from a safetensors file, tensor by tensor, cast to the dtype each parameter is stored in.

    Everything is checked before anything is written. Parameters on the meta device become real ones, so memory
    never holds a second copy of the model. prefix: of the module's names in the file. others: prefixes of tensors that the file
    may hold in addition; they are skipped.

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
                # A clone, not the memory map: the file could be overwritten while the policy runs.
                _assign(module, name.removeprefix(prefix), file.get_tensor(name).to(target.dtype).clone())
    except SafetensorError as error:
        raise ValueError(f"{path} is truncated or no safetensors file ({error}); copy or download it again.") from error


def complain(path: str | Path, what: str, names: list[str], left: str = "nothing was loaded") -> None:
    """Raise ValueError if there are `names`: tensors of a file with the fault `what`. left: the consequence."""
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
