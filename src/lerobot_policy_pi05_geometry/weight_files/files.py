"""Files of a checkpoint: found in a local folder or on the hub, and folders that are written whole or not at all."""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from huggingface_hub import hf_hub_download
from huggingface_hub.errors import EntryNotFoundError, LocalEntryNotFoundError, RepositoryNotFoundError

CONFIG_FILE = "config.json"
ADAPTER_CONFIG = "adapter_config.json"  # of LoRA, as PEFT names it


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
        raise FileNotFoundError(f"Checkpoint folder {model_id} does not exist.")
    try:
        return Path(hf_hub_download(repo_id=str(model_id), filename=name, **hub))
    except LocalEntryNotFoundError as error:
        raise FileNotFoundError(
            f"Checkpoint {model_id} is no local folder, and the hub cannot be reached for its {name}, which is not cached."
        ) from error
    except EntryNotFoundError as error:
        raise FileNotFoundError(f"Checkpoint {model_id} on the hub has no {name}.") from error
    except RepositoryNotFoundError as error:
        raise FileNotFoundError(
            f"There is no {model_id} on the hub, or your token has no access; check the name, or log in with `hf auth login`."
        ) from error


def find_optional_file(model_id: str | Path, name: str, **hub: Any) -> Path | None:
    """A file that a checkpoint may lack; None if it does. Raises FileNotFoundError if the hub cannot be reached."""
    try:
        return find_file(model_id, name, **hub)
    except FileNotFoundError as error:
        unreachable = isinstance(error.__cause__, LocalEntryNotFoundError)
        if Path(model_id).is_dir() or (isinstance(error.__cause__, EntryNotFoundError) and not unreachable):
            return None
        raise


@contextmanager
def new_folder(output: Path, size: int) -> Iterator[Path]:
    """A folder beside `output` that is renamed to it when the block ends, and removed if the block fails.

    size: bytes that will be written. Raises FileExistsError if `output` exists, OSError if the disk has too little space.
    """
    if output.exists():
        raise FileExistsError(f"{output} exists already; name a folder that does not.")
    parent = output.absolute().parent
    missing = [folder for folder in (parent, *parent.parents) if not folder.exists()]
    parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{output.name}.", dir=parent))
    try:
        free = shutil.disk_usage(parent).free
        if free < size:
            raise OSError(f"{output} needs {size / 1e9:.1f} GB, but its disk has {free / 1e9:.1f} GB left.")
        yield partial
        partial.chmod(0o755)  # mkdtemp makes it accessible to its owner only
        partial.rename(output)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        if not output.exists():
            for folder in missing:
                folder.rmdir()


def write_whole(path: Path, text: str) -> None:
    """Write a small text file so that it is there whole or not at all, whenever the process or the machine stops.

    For one process at a time: the name of the unfinished file is fixed, so that one left behind is overwritten.
    """
    unfinished = path.with_name(f".{path.name}.unfinished")
    with unfinished.open("w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(unfinished, path)


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
            f"{model_id} is a checkpoint of type '{found}', not '{expected}': its weights and processors have another "
            f"layout, so it cannot be loaded unchanged; {convert}."
        )
