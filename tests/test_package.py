"""The packages as a whole: what is exported, which way imports run, what `--help` loads, and that the README's Python runs."""

import ast
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import torch

import lerobot_policy_pi05_geometry as package
from tests.entry_points import CHUNK, FRONT, FRONT_DEPTH, STATE, STATE_DIM, make_config, make_processors, redraw

SRC = Path(package.__file__).parent
ROOT = SRC.parents[1]
# From the bottom up; a module may import from its own layer and from the layers before it.
LAYERS = [
    {"model", "weight_files", "dataset_folder", "compat"},
    {"inference", "geometry", "data", "training"},
    {"configuration_pi05_geometry", "configuration_checks"},
    {"processor_pi05_geometry"},
    {"modeling_pi05_geometry"},
    {"checkpoint", "precompute"},
    {"inspect", "planner", "sim", "robot", "serving"},
    {"study"},
]


def layer_of(module: str) -> int:
    """Index of the layer of a top-level module of the package."""
    found = [index for index, names in enumerate(LAYERS) if module in names]
    assert found, f"{module} has no layer: name it in LAYERS and in docs/architecture.md"
    return found[0]


def imports_at_run_time(path: Path) -> list[str]:
    """Top-level modules of this package that a file imports, anywhere but under TYPE_CHECKING."""
    tree = ast.parse(path.read_text())
    typing_only = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
    }
    folder = path.relative_to(SRC).parts[:-1]
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.level and id(node) not in typing_only:
            target = [*folder[: len(folder) - (node.level - 1)], *(node.module or "").split(".")]
            target = [part for part in target if part]
            found += [target[0]] if target else [alias.name for alias in node.names]
    return found


def test_imports_run_one_way():
    for path in SRC.rglob("*.py"):
        own = path.relative_to(SRC).with_suffix("").parts[0]
        if own == "__init__":
            continue
        for imported in imports_at_run_time(path):
            assert layer_of(imported) <= layer_of(own), f"{path.relative_to(SRC)} imports {imported}, a layer above it"


def test_the_package_does_not_import_its_commands():
    """pi05_geometry_cli stands above the package, and beside it: importing the package imports torch and LeRobot."""
    assert not [path for path in SRC.rglob("*.py") if "pi05_geometry_cli" in path.read_text()]


def test_help_imports_neither_torch_nor_lerobot():
    """Of the command that pip installs, and of every subcommand but `train`, whose --help is lerobot-train's."""
    [entry] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"].values()
    module, _, function = entry.partition(":")
    script = f"""
import json, sys
from importlib import import_module
from typer.main import get_command

def commands(command, path=()):
    yield path
    for name, inner in getattr(command, "commands", {{}}).items():
        yield from commands(inner, (*path, name))

main = getattr(import_module("{module}"), "{function}")
helped = []
for path in commands(get_command(import_module("pi05_geometry_cli").app)):
    if path != ("train",):
        sys.argv = ["pi05-geometry", *path, "--help"]
        try:
            main()
        except SystemExit as exit:
            assert not exit.code, path
        helped.append(" ".join(path))
sys.stderr.write(json.dumps([helped, sorted({{name.partition(".")[0] for name in sys.modules}})]))
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    helped, modules = json.loads(result.stderr)
    assert {"", "study", "plan", "calibrate hand-eye", "serve"} <= set(helped)
    slow = {"torch", "lerobot", "transformers", "numpy", "pandas", "matplotlib", "lerobot_policy_pi05_geometry"}
    assert not slow & set(modules)


def test_mujoco_is_imported_from_one_place():
    """MuJoCo selects its OpenGL on its first import; sim/headless.py makes that EGL, without which nothing renders."""
    first_import = re.compile(r"^\s*(import mujoco$|from mujoco import)", re.MULTILINE)
    files = [*SRC.rglob("*.py"), *(ROOT / "tests" / "robot").rglob("*.py")]
    assert [file.name for file in files if first_import.search(file.read_text())] == ["headless.py"]


def test_the_policy_is_exported_and_the_plugin_scan_does_not_load_it():
    script = (
        "import sys, lerobot_policy_pi05_geometry as p; "
        "assert 'lerobot_policy_pi05_geometry.modeling_pi05_geometry' not in sys.modules; "
        "from lerobot_policy_pi05_geometry import PI05GeometryPolicy; print(PI05GeometryPolicy.name)"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "pi05_geometry"


def test_the_readmes_python_runs(tmp_path):
    """The block of Python in the README, on a tiny checkpoint with one depth camera."""
    [code] = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    config = make_config()
    wrist = [key for key in config.input_features if "wrist" in key]
    config = make_config(
        input_features={key: feature for key, feature in config.input_features.items() if key not in wrist},
        geometry_cameras=["front"],
    )
    preprocess, postprocess = make_processors(config)
    redraw(package.PI05GeometryPolicy(config)).save_pretrained(tmp_path)
    preprocess.save_pretrained(tmp_path)
    postprocess.save_pretrained(tmp_path)
    code = code.replace("outputs/train/.../checkpoints/last/pretrained_model", str(tmp_path)).replace('"cuda"', '"cpu"')
    assert FRONT in code
    assert FRONT_DEPTH in code
    assert STATE in code
    given = {
        "state": torch.zeros(1, STATE_DIM),
        "rgb": torch.rand(1, 3, 30, 40),
        "depth": torch.full((1, 1, 18, 24), 800.0),
    }
    exec(compile(code, "README.md", "exec"), given)
    assert given["actions"].shape[:2] == (1, CHUNK)
    assert given["actions"].isfinite().all()
