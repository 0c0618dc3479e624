"""Weights in, strictly: a checkpoint loads whole or not at all, and says what is wrong with it."""

import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
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


def find_optional_file(model_id: str | Path, name: str, **hub: Any) -> Path | None:
    """A file of a checkpoint that it may lack. Raises FileNotFoundError if the hub cannot be asked."""
    try:
        return find_file(model_id, name, **hub)
    except FileNotFoundError as error:
        unreachable = isinstance(error.__cause__, LocalEntryNotFoundError)
        if Path(model_id).is_dir() or (isinstance(error.__cause__, EntryNotFoundError) and not unreachable):
            return None
        raise


@contextmanager
def new_folder(output: Path, size: int) -> Iterator[Path]:
    """A folder beside `output` that takes its place when the block ends, and is removed if it fails.

    size: bytes that will be written. Raises FileExistsError if `output` is there, OSError if the disk is too full.
    """
    if output.exists():
        raise FileExistsError(f"{output} is there already; name a folder that is not.")
    parent = output.absolute().parent
    missing = [folder for folder in (parent, *parent.parents) if not folder.exists()]
    parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{output.name}.", dir=parent))
    try:
        free = shutil.disk_usage(parent).free
        if free < size:
            raise OSError(f"{output} needs {size / 1e9:.1f} GB, but its disk has {free / 1e9:.1f} GB left.")
        yield partial
        partial.chmod(0o755)  # mkdtemp's folder is its owner's alone
        partial.rename(output)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        if not output.exists():
            for folder in missing:
                folder.rmdir()


def require_policy_type(model_id: str | Path, expected: str, **hub: Any) -> None:
    """Raise ValueError if the checkpoint is of another policy type."""
    path = find_file(model_id, CONFIG_FILE, **hub)
    try:
        found = json.loads(path.read_text())["type"]
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path} is no policy configuration: expected a JSON object with an entry 'type'.") from error
    if found != expected:
        convert = (
            f"convert it with `pi05-geometry convert {model_id} OUTPUT`, and give OUTPUT as --policy.path"
            if found == "pi05"
            else "choose another checkpoint"
        )
        raise ValueError(
            f"{model_id} is a checkpoint of type '{found}', not '{expected}': its weights and processors are laid out "
            f"differently, so it cannot be loaded as it is; {convert}."
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
