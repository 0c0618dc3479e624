"""Parity with the upstream package, which cannot be installed beside LeRobot: in a throw-away folder, another process."""

import dataclasses
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from lerobot_policy_pi05_geometry.geometry.da3 import (
    BACKBONE_PREFIX,
    OTHER_PREFIXES,
    VARIANTS,
    Da3Backbone,
    Da3Variant,
    variant_of,
)
from lerobot_policy_pi05_geometry.geometry.da3.weights import read_variant
from lerobot_policy_pi05_geometry.weight_files.strict_load import load_strictly

pytestmark = pytest.mark.upstream

PACKAGES = ("depth-anything-3==0.1.1", "einops==0.8.2", "omegaconf==2.4.0", "addict==2.4.0")
REGISTRY = {
    "small": "da3-small",
    "base": "da3-base",
    "large": "da3-large",
    "giant": "da3-giant",
    "mono-large": "da3mono-large",
    "metric-large": "da3metric-large",
}


@pytest.fixture(scope="module")
def packages(tmp_path_factory) -> Path:
    """A folder with the upstream package. Name one that you keep in DA3_UPSTREAM to install it once."""
    if kept := os.environ.get("DA3_UPSTREAM"):
        return Path(kept)
    folder = tmp_path_factory.mktemp("upstream")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(folder), *PACKAGES]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr[-2000:]
    return folder


def upstream(packages: Path, *arguments: str | Path) -> None:
    script = Path(__file__).with_name("upstream_process.py")
    command = [sys.executable, str(script), str(packages), *map(str, arguments)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert result.returncode == 0, result.stderr[-2000:]
    assert importlib.util.find_spec("depth_anything_3") is None


@pytest.fixture(scope="module")
def released(packages, tmp_path_factory) -> dict[str, dict[str, tuple[int, ...]]]:
    """Names and shapes of every released model."""
    path = tmp_path_factory.mktemp("keys") / "keys.json"
    upstream(packages, "keys", path)
    return {
        name: {key: tuple(shape) for key, shape in keys.items()} for name, keys in json.loads(path.read_text()).items()
    }


@pytest.mark.parametrize("name", REGISTRY)
def test_a_released_file_holds_our_tensors_and_declared_heads(released, name):
    keys = released[REGISTRY[name]]
    variant = variant_of(keys, name)
    assert variant is VARIANTS["mono-large" if name == "metric-large" else name]
    with torch.device("meta"):
        ours = Da3Backbone(variant).state_dict()
    assert {BACKBONE_PREFIX + key: tuple(tensor.shape) for key, tensor in ours.items()} == {
        key: shape for key, shape in keys.items() if key.startswith(BACKBONE_PREFIX)
    }
    rest = [key for key in keys if not key.startswith(BACKBONE_PREFIX)]
    assert rest
    assert all(key.startswith(OTHER_PREFIXES) for key in rest)


def assert_equal_features(
    packages: Path, folder: Path, variant: Da3Variant, net: str | dict, images: list[tuple]
) -> None:
    """Every layer that the depth head reads is within 1e-5 of upstream's, for the same weights and images."""
    case = {"net": net, "out_layers": variant.out_layers, "images": images}
    (folder / "case.json").write_text(json.dumps(case))
    upstream(packages, "features", folder / "case.json", folder)
    with torch.device("meta"):
        backbone = Da3Backbone(variant).requires_grad_(False)
    load_strictly(backbone, folder / "model.safetensors", BACKBONE_PREFIX, OTHER_PREFIXES)
    expected = load_file(folder / "features.safetensors")
    for i, shape in enumerate(images):
        found = backbone(expected[f"{i}.images"])
        assert len(found) == len(variant.out_layers)
        for layer, features in zip(variant.out_layers, found, strict=True):
            reference = expected[f"{i}.{layer}"]
            assert 0.1 < reference.std() < 100
            torch.testing.assert_close(
                features.flatten(2, 3), reference, atol=1e-5, rtol=1e-5, msg=lambda m, at=(shape, layer): f"{at}: {m}"
            )


# Batch, views, height and width in pixels; 518 is the size of the position embedding itself.
IMAGES = {
    "small": [
        (2, 1, 196, 196), (1, 2, 224, 224), (2, 3, 224, 196), (1, 3, 252, 252), (1, 2, 196, 392), (1, 1, 392, 392),
        (1, 2, 504, 224), (1, 1, 504, 504), (1, 1, 518, 518), (1, 1, 518, 252),
    ],
    "base": [(1, 1, 224, 224), (2, 3, 196, 196), (1, 2, 252, 392), (1, 1, 504, 280)],
    "large": [(1, 1, 196, 504), (1, 2, 224, 224), (1, 3, 252, 196), (1, 1, 392, 392)],
}  # fmt: skip


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name == "small" else pytest.mark.long) for name in IMAGES]
)
def test_features_equal_upstreams(packages, tmp_path, name):
    variant = VARIANTS[name]
    assert_equal_features(packages, tmp_path, variant, REGISTRY[name], IMAGES[name])
    assert read_variant(tmp_path / "model.safetensors") is variant


# What the sizes that are too large for a test have of their own, in a small net: giant's gated MLP and odd start of
# alternation, and no alternation at all.
SHRUNK = {
    "giant": (
        dataclasses.replace(VARIANTS["giant"], width=96, depth=7, heads=3, out_layers=(3, 6), alt_start=3),
        {"ffn_layer": "swiglufused", "cat_token": True},
    ),
    "mono-large": (
        dataclasses.replace(VARIANTS["mono-large"], width=128, depth=4, heads=2, out_layers=(1, 3)),
        {"cat_token": False},
    ),
}


@pytest.mark.parametrize("name", SHRUNK)
def test_features_of_the_other_kinds_equal_upstreams_in_a_small_net(packages, tmp_path, name):
    variant, settings = SHRUNK[name]
    start = -1 if variant.alt_start is None else variant.alt_start
    starts = dict.fromkeys(("alt_start", "qknorm_start", "rope_start"), start)
    net = {"embed_dim": variant.width, "depth": variant.depth, "num_heads": variant.heads, **starts, **settings}
    images = [(2, views, *size) for views in (1, 2, 3) for size in ((196, 196), (224, 392), (252, 504), (518, 518))]
    assert_equal_features(packages, tmp_path, variant, net, images)
