"""Weights in, strictly: a checkpoint loads whole or not at all, and says what is wrong with it."""

import json
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import hf_hub_download
from huggingface_hub.errors import EntryNotFoundError, LocalEntryNotFoundError, RepositoryNotFoundError
from safetensors import SafetensorError, safe_open
from torch import nn

CONFIG_FILE = "config.json"
_NAMED = 5  # how many tensors an error names


def find_file(model_id: str | Path, name: str, **hub: Any) -> Path:
    """A file of a checkpoint, from a local folder or the hub. Raises FileNotFoundError naming it."""
    folder = Path(model_id)
    if folder.is_dir():
        if not (folder / name).is_file():
            raise FileNotFoundError(
                f"Checkpoint {folder} has no {name}; give the folder that holds it (pretrained_model)."
            )
        return folder / name
    if folder.is_absolute() or str(model_id).startswith((".", "~")) or str(model_id).count("/") != 1:
        raise FileNotFoundError(f"Checkpoint folder {model_id} is not there.")
    try:
        return Path(hf_hub_download(repo_id=str(model_id), filename=name, **hub))
    except LocalEntryNotFoundError as error:
        raise FileNotFoundError(
            f"Checkpoint {model_id} is no folder here, and the hub cannot be reached for its {name}, which is not cached."
        ) from error
    except EntryNotFoundError as error:
        raise FileNotFoundError(f"Checkpoint {model_id} on the hub has no {name}.") from error
    except RepositoryNotFoundError as error:
        raise FileNotFoundError(
            f"There is no {model_id} on the hub, or your token does not open it; check the name, or log in with `hf auth login`."
        ) from error


def require_policy_type(model_id: str | Path, expected: str, **hub: Any) -> None:
    """Raise ValueError if the checkpoint is of another policy type."""
    path = find_file(model_id, CONFIG_FILE, **hub)
    try:
        found = json.loads(path.read_text())["type"]
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path} is no policy configuration: expected a JSON object with an entry 'type'.") from error
    if found != expected:
        raise ValueError(
            f"{model_id} is a checkpoint of type '{found}', not '{expected}': its weights and processors are laid out "
            "differently, so it cannot be loaded as it is."
        )


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
            _complain(path, "lacks", sorted(set(expected) - names))
            _complain(path, "has unknown", sorted(names - set(expected)))
            wrong = []
            for name, target in expected.items():
                stored = file.get_slice(name)
                shape, dtype = tuple(stored.get_shape()), stored.get_dtype()
                if shape != tuple(target.shape):
                    wrong.append(f"{name} (shape {shape}, expected {tuple(target.shape)})")
                elif dtype.startswith(("F", "BF")) != target.is_floating_point():
                    wrong.append(f"{name} (dtype {dtype}, expected {target.dtype})")
            _complain(path, "has wrong", wrong)
            for name, target in expected.items():
                # A clone, not the memory-mapped file, which could be overwritten beneath a running policy.
                _assign(module, name.removeprefix(prefix), file.get_tensor(name).to(target.dtype).clone())
    except SafetensorError as error:
        raise ValueError(f"{path} is truncated or no safetensors file ({error}); copy or download it again.") from error


def _complain(path: str | Path, what: str, names: list[str]) -> None:
    if names:
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        raise ValueError(f"Checkpoint {path} {what} tensors: {', '.join(names[:_NAMED])}{more}; nothing was loaded.")


def _assign(module: nn.Module, name: str, tensor: torch.Tensor) -> None:
    parent_name, _, leaf = name.rpartition(".")
    parent = module.get_submodule(parent_name)
    old = getattr(parent, leaf)
    if isinstance(old, nn.Parameter):
        tensor = nn.Parameter(tensor, requires_grad=old.requires_grad)
    setattr(parent, leaf, tensor)
