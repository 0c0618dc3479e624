"""The encoder's weights: found, known by content, whole or not at all."""

import logging
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from lerobot_policy_pi05_geometry import PI05GeometryConfig
from lerobot_policy_pi05_geometry.geometry.da3 import BACKBONE_PREFIX, VARIANTS, Da3Backbone, weights
from lerobot_policy_pi05_geometry.geometry.da3.weights import backbone_hash, load_da3, read_variant
from tests.geometry.da3.tiny import HEAD, tiny_backbone, write_tiny

WEIGHT = f"{BACKBONE_PREFIX}blocks.3.attn.q_norm.weight"


def config_of(encoder: str | Path, **changes) -> PI05GeometryConfig:
    return PI05GeometryConfig(geometry_source="da3", da3_encoder=str(encoder), device="cpu", **changes)


def refusal(path: Path, **changes) -> str:
    """What loading this file is refused with, in one sentence."""
    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        load_da3(config_of(path, **changes))
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith(".")
    return message


@pytest.mark.parametrize("named_by", ["file", "folder"])
def test_every_tensor_of_the_backbone_is_loaded_and_the_heads_are_left_out(tmp_path, named_by):
    path = write_tiny(tmp_path / "model.safetensors", seed=3)
    encoder = load_da3(config_of(path if named_by == "file" else tmp_path, da3_dtype="float32"))
    expected = tiny_backbone(3).state_dict()
    assert encoder.backbone.state_dict().keys() == expected.keys()
    for name, tensor in encoder.backbone.state_dict().items():
        assert torch.equal(tensor, expected[name]), name
    assert not any(parameter.requires_grad for parameter in encoder.parameters())
    assert not encoder.training


def test_the_encoder_computes_in_the_dtype_of_the_configuration(tmp_path):
    path, images = write_tiny(tmp_path / "model.safetensors"), torch.rand(1, 1, 3, 28, 28)
    exact, rounded = (load_da3(config_of(path, da3_dtype=dtype))(images) for dtype in ("float32", "bfloat16"))
    assert exact.dtype == rounded.dtype == torch.float32
    assert 0 < (exact - rounded).norm() / exact.norm() < 0.1
    assert PI05GeometryConfig().da3_dtype == "bfloat16"


@pytest.mark.parametrize("wrong", ["missing", "extra", "shape", "dtype"])
def test_a_tensor_that_does_not_fit_is_named(tmp_path, wrong):
    tensor = tiny_backbone().state_dict()[WEIGHT.removeprefix(BACKBONE_PREFIX)]
    extra = f"{BACKBONE_PREFIX}blocks.6.norm1.weight"
    change, said = {
        "missing": ({WEIGHT: None}, f"lacks tensors: {WEIGHT}"),
        "extra": ({extra: tensor}, f"has unknown tensors: {extra}"),
        "shape": ({WEIGHT: tensor[:-1]}, f"{WEIGHT} (shape (15,), expected (16,))"),
        "dtype": ({WEIGHT: tensor.int()}, f"{WEIGHT} (dtype I32, expected torch.float32)"),
    }[wrong]
    path = write_tiny(tmp_path / "model.safetensors", **change)
    message = refusal(path)
    assert said in message
    assert str(path) in message


@pytest.mark.parametrize("name", ["stranger", "model.header.weight", "backbone.pretrained.cls_token", "model.net.norm"])
def test_only_declared_heads_are_left_out(tmp_path, name):
    path = write_tiny(tmp_path / "model.safetensors", **{name: torch.ones(2)})
    assert f"has unknown tensors: {name}" in refusal(path)


def test_a_truncated_file_is_refused(tmp_path):
    path = write_tiny(tmp_path / "model.safetensors")
    content = path.read_bytes()
    for kept in (0.9, 0.01, 0.0):
        path.write_bytes(content[: int(kept * len(content))])
        assert "truncated or no safetensors file" in refusal(path)


@pytest.mark.parametrize(
    ("encoder", "said"),
    [
        ("nowhere/to/be/found", "folder nowhere/to/be/found does not exist"),
        (
            "depth-anything/NO-SUCH-MODEL",
            "depth-anything/NO-SUCH-MODEL is no local folder, and the hub cannot be reached",
        ),
    ],
)
def test_an_encoder_that_cannot_be_had_is_named(encoder, said, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    message = refusal(encoder)
    assert said in message
    assert "--policy.da3_encoder" in message


def test_a_folder_without_weights_is_named(tmp_path):
    assert f"{tmp_path} has no model.safetensors" in refusal(tmp_path)


# --- the hash -----------------------------------------------------------------------------------------------------


def test_the_hash_is_of_the_backbone_alone(tmp_path):
    """Not of the file: without the heads, in another order, with a note in its header, it is the same encoder."""
    path = write_tiny(tmp_path / "a.safetensors")
    tensors = load_file(path)
    alone = {name: tensors[name] for name in sorted(tensors, reverse=True) if name not in HEAD}
    save_file(alone, tmp_path / "b.safetensors", metadata={"format": "pt", "note": "a copy"})
    assert path.read_bytes() != (tmp_path / "b.safetensors").read_bytes()
    assert backbone_hash(path) == backbone_hash(tmp_path / "b.safetensors")
    assert len(backbone_hash(path)) == 64


def test_the_hash_changes_with_every_tensor(tmp_path):
    path = write_tiny(tmp_path / "a.safetensors")
    hashes, tensors = {backbone_hash(path)}, load_file(path)
    names = sorted(set(tensors) - set(HEAD))
    for name in names:
        changed = tensors[name].clone()
        changed.view(-1)[-1] = changed.view(-1)[-1].nextafter(torch.tensor(9.0))  # the last bit of the last number
        save_file(tensors | {name: changed}, tmp_path / "b.safetensors")
        hashes.add(backbone_hash(tmp_path / "b.safetensors"))
    save_file({k: v.half() for k, v in tensors.items()}, tmp_path / "b.safetensors")
    hashes.add(backbone_hash(tmp_path / "b.safetensors"))
    assert len(hashes) == len(names) + 2


def test_the_hash_is_told_at_first_use_and_verified_ever_after(tmp_path):
    path, other = write_tiny(tmp_path / "a" / "model.safetensors"), write_tiny(tmp_path / "b" / "model.safetensors", 1)
    config = config_of(path)
    assert config.da3_hash is None
    found = load_da3(config).content_hash
    assert found == backbone_hash(path)
    assert config.da3_hash is None, "loading changes no configuration"
    load_da3(config_of(path, da3_hash=found))
    copy = shutil.copytree(path.parent, tmp_path / "c")
    load_da3(config_of(copy, da3_hash=found))
    message = refusal(other, da3_hash=found)
    assert found in message
    assert backbone_hash(other) in message
    assert f"another encoder than {other}" in message


# --- licences -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", VARIANTS)
def test_a_non_commercial_encoder_is_said_once(name, caplog, monkeypatch, tmp_path):
    monkeypatch.setattr(weights, "_warned", set())
    with torch.device("meta"):
        shapes = {k: v.shape for k, v in Da3Backbone(VARIANTS[name]).state_dict().items() if "blocks" not in k}
    # A real giant is 4.5 GB; the tensors outside its blocks are enough to recognise it.
    save_file({BACKBONE_PREFIX + k: torch.zeros(shape) for k, shape in shapes.items()}, tmp_path / "model.safetensors")
    assert read_variant(tmp_path / "model.safetensors") is VARIANTS[name]
    for _ in range(2):
        if name == "tiny":
            write_tiny(tmp_path / "model.safetensors")
            load_da3(config_of(tmp_path))
        else:
            assert "lacks tensors" in refusal(tmp_path)
    messages = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert len(messages) == (name in ("large", "giant"))
    for message in messages:
        assert f"{tmp_path} is Depth Anything 3's '{name}'" in message
        assert "CC BY-NC 4.0" in message
