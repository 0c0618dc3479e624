"""A file's variant is read from its tensors; whether its numbers are right is for test_upstream.py to say."""

import pytest
import torch

from lerobot_policy_pi05_geometry.geometry.da3 import BACKBONE_PREFIX, VARIANTS, Da3Backbone, variant_of


def shapes_of(name: str) -> dict[str, tuple[int, ...]]:
    with torch.device("meta"):
        backbone = Da3Backbone(VARIANTS[name])
    return {BACKBONE_PREFIX + key: tuple(tensor.shape) for key, tensor in backbone.state_dict().items()}


@pytest.mark.parametrize("name", VARIANTS)
def test_every_variant_is_recognised(name):
    assert variant_of(shapes_of(name), "file") is VARIANTS[name]


def test_only_large_and_giant_are_not_for_commercial_use():
    assert {name for name, variant in VARIANTS.items() if variant.non_commercial} == {"large", "giant"}


def test_a_nested_model_is_refused_with_what_to_use():
    shapes = {f"model.da3.{key.removeprefix('model.')}": shape for key, shape in shapes_of("giant").items()}
    with pytest.raises(ValueError, match=r"file is a nested Depth Anything 3.*use .*DA3-GIANT.*DA3-BASE\.$"):
        variant_of(shapes | {"model.da3_metric.head.bias": (1,)}, "file")


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({f"{BACKBONE_PREFIX}cls_token": (1, 1, 512)}, "found 512"),
        ({f"{BACKBONE_PREFIX}cls_token": None}, "found no such tensor"),
        ({f"{BACKBONE_PREFIX}camera_token": None}, "found 768"),  # there is no single-view model of this width
    ],
)
def test_another_kind_of_file_is_refused(change, found):
    shapes = {name: shape for name, shape in (shapes_of("base") | change).items() if shape is not None}
    with pytest.raises(ValueError, match=rf"file holds no Depth Anything 3 encoder of a known size.*768.*{found}"):
        variant_of(shapes, "file")
