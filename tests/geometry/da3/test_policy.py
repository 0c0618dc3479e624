"""A policy that sees geometry through a frozen Depth Anything 3: trained, saved, loaded, refused."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from safetensors.torch import load_file

from lerobot_policy_pi05_geometry.geometry.da3.source import pool
from lerobot_policy_pi05_geometry.geometry.da3.weights import backbone_hash
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from tests.entry_points import (
    FRONT,
    GEOMETRY,
    STATE,
    WRIST,
    chunk_of,
    make_batch,
    make_config,
    make_features,
    make_policy,
    redraw,
    without,
)
from tests.geometry.da3.tiny import write_tiny


@pytest.fixture(scope="module")
def encoder(tmp_path_factory) -> Path:
    """The folder of a tiny encoder, as one from the hub would lie in the cache."""
    return write_tiny(tmp_path_factory.mktemp("hub") / "DA3-TINY" / "model.safetensors").parent


def make_da3(encoder: Path, **changes) -> PI05GeometryPolicy:
    settings = {"geometry_source": "da3", "da3_encoder": str(encoder), "da3_image_size": 42, "calibration": {}}
    return make_policy(**{**settings, **changes})


def frozen_tensors(policy: PI05GeometryPolicy) -> dict[str, torch.Tensor]:
    return {k: v.clone() for k, v in policy.geometry.source.encoder.state_dict().items()}


def test_rgb_alone_gives_geometry(encoder):
    policy, batch = make_da3(encoder), make_batch()
    assert policy.geometry.source.cameras == ("front", "wrist")
    assert torch.equal(chunk_of(policy, without(batch, *GEOMETRY)), chunk_of(policy, batch))
    tokens, pad = policy._measure(batch)
    assert tokens.shape[1] == 2 * 3 * 3
    assert pad.all()
    plain = make_policy(geometry_source="none")
    plain.load_state_dict({k: v for k, v in policy.state_dict().items() if k in plain.state_dict()})
    assert (chunk_of(plain, batch) - chunk_of(policy, batch)).abs().max() > 1e-4


def test_the_encoder_sees_the_raw_image_and_not_siglips(encoder):
    """Which is padded and in [-1, 1]: front is 30 x 40 pixels."""
    policy, batch = make_da3(encoder, geometry_cameras=["front"], da3_dtype="float32"), make_batch()
    image = torch.nn.functional.interpolate(batch[FRONT], size=(42, 42), mode="bicubic", antialias=True).clamp(0, 1)
    expected = pool(policy.geometry.source.encoder(image[:, None]), 3)
    torch.testing.assert_close(policy.geometry.source(batch).features, expected)


def test_training_moves_the_adapter_and_never_the_encoder(encoder):
    policy, batch = make_da3(encoder, geometry_dropout=0.0, image_dropout=0.0).train(), make_batch()
    frozen, before = frozen_tensors(policy), {n: p.detach().clone() for n, p in policy.new_parameters().items()}
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    for _ in range(2):
        policy.forward(batch)[0].backward()
        for name, parameter in policy.named_parameters():
            assert (parameter.grad is not None) == parameter.requires_grad, name
        optimizer.step()
        optimizer.zero_grad()
        policy.update()
    for name, parameter in policy.new_parameters().items():
        assert not torch.equal(parameter, before[name]), name
    for name, tensor in policy.geometry.source.encoder.state_dict().items():
        assert torch.equal(tensor, frozen[name]), name
    assert not policy.geometry.source.encoder.training
    ours = {id(p) for p in policy.parameters()} | {id(p) for group in optimizer.param_groups for p in group["params"]}
    assert not ours & {id(p) for p in policy.geometry.source.encoder.parameters()}


@pytest.mark.parametrize("changes", [{}, {"dtype": "bfloat16", "param_dtype": "bfloat16"}], ids=["float32", "bfloat16"])
def test_a_saved_policy_acts_as_before_bit_for_bit(encoder, tmp_path, changes):
    policy, batch = make_da3(encoder, **changes), make_batch()
    policy.save_pretrained(tmp_path)
    loaded = PI05GeometryPolicy.from_pretrained(tmp_path)
    assert loaded.config == policy.config
    assert torch.equal(chunk_of(loaded, batch), chunk_of(policy, batch))
    for name, tensor in loaded.geometry.source.encoder.state_dict().items():
        assert torch.equal(tensor, frozen_tensors(policy)[name]), name
    loaded.train().forward(batch)[0].backward()  # and it can be trained on


def test_the_checkpoint_records_the_encoder_and_holds_nothing_of_it(encoder, tmp_path):
    policy = make_da3(encoder)
    policy.save_pretrained(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    assert config["da3_encoder"] == str(encoder)
    assert config["da3_hash"] == backbone_hash(encoder / "model.safetensors")
    names = set(load_file(tmp_path / "model.safetensors"))
    assert names == {name for name, _ in policy.named_parameters()} | {"progress.step"}
    assert {name for name in names if name.startswith("geometry.")} == {
        f"geometry.{name}" for name, _ in policy.geometry.named_parameters()
    }
    assert all(name.startswith("geometry.adapter.") for name in names if name.startswith("geometry."))


def test_another_encoder_under_the_same_name_is_refused(encoder, tmp_path):
    own = shutil.copytree(encoder, tmp_path / "encoder")
    make_da3(own).save_pretrained(tmp_path / "checkpoint")
    write_tiny(own / "model.safetensors", seed=1)
    with pytest.raises(ValueError, match=rf"trained with another encoder than {own} holds: expected SHA-256 [0-9a-f]"):
        PI05GeometryPolicy.from_pretrained(tmp_path / "checkpoint")


def test_an_encoder_that_moved_is_named_anew(encoder, tmp_path):
    own, batch = shutil.copytree(encoder, tmp_path / "encoder"), make_batch()
    policy = make_da3(own)
    policy.save_pretrained(tmp_path / "checkpoint")
    shutil.rmtree(own)
    with pytest.raises(
        FileNotFoundError, match=rf"encoder is not found: .*{own} does not exist; .*--policy.da3_encoder"
    ):
        PI05GeometryPolicy.from_pretrained(tmp_path / "checkpoint")
    config = PreTrainedConfig.from_pretrained(tmp_path / "checkpoint", cli_overrides=[f"--da3_encoder={encoder}"])
    loaded = PI05GeometryPolicy.from_pretrained(tmp_path / "checkpoint", config=config)
    assert torch.equal(chunk_of(loaded, batch), chunk_of(policy, batch))


# --- cameras ------------------------------------------------------------------------------------------------------


def test_cameras_are_sorted_unless_they_are_named(encoder):
    """So the reference view, the first, does not hang on the order of features, or on which camera may be absent."""
    assert make_da3(encoder, absent_cameras=[FRONT]).geometry.source.cameras == ("front", "wrist")
    assert make_da3(encoder, geometry_cameras=["wrist", "front"]).geometry.source.cameras == ("wrist", "front")
    assert make_da3(encoder, empty_cameras=1).geometry.source.cameras == ("front", "wrist")
    with pytest.raises(ValueError, match=r"geometry_cameras names back, but the data has RGB images from front, wrist"):
        make_da3(encoder, geometry_cameras=["front", "back"])


def test_a_camera_under_lerobots_short_name_is_found(encoder):
    inputs, outputs = make_features()
    features = {"observation.image": inputs[FRONT], STATE: inputs[STATE]}
    policy, batch = make_da3(encoder, input_features=features, output_features=outputs), make_batch()
    batch["observation.image"] = batch.pop(FRONT)
    assert policy.config.rgb_cameras() == {"image": "observation.image"}
    assert chunk_of(policy, batch).isfinite().all()


def test_a_camera_that_may_be_absent_is_left_out(encoder):
    policy, batch = make_da3(encoder, absent_cameras=[WRIST]), make_batch()
    _, pad = policy._measure(without(batch, WRIST))
    assert pad.unflatten(1, (2, 9)).all(dim=2).tolist() == [[True, False]] * 2
    absent = chunk_of(policy, without(batch, WRIST))
    black = chunk_of(policy, batch | {WRIST: torch.zeros_like(batch[WRIST])})
    assert (absent - black).abs().max() > 1e-4
    policy.train().forward(without(batch, WRIST))[0].backward()
    with pytest.raises(ValueError, match=rf"no image.* {FRONT}"):
        policy.forward(without(batch, FRONT))


def test_without_rgb_it_is_refused(encoder):
    inputs, outputs = make_features()
    inputs = {key: feature for key, feature in inputs.items() if key not in (FRONT, WRIST)}
    with pytest.raises(ValueError, match=r"geometry_source=da3 is computed from RGB images.*geometry_source=none"):
        make_da3(encoder, input_features=inputs, output_features=outputs, empty_cameras=1)


def test_an_image_size_that_the_grid_does_not_divide_is_refused(encoder):
    with pytest.raises(ValueError, match=r"da3_image_size must be a multiple of 42 pixels"):
        make_da3(encoder, da3_image_size=28)


def test_a_loaded_encoder_may_be_given(encoder):
    """Several policies may then share one."""
    first = make_da3(encoder)
    second = PI05GeometryPolicy(make_config(**vars(first.config)), encoder=first.geometry.source.encoder)
    second = redraw(second).eval()
    assert second.geometry.source.encoder is first.geometry.source.encoder
    assert torch.equal(chunk_of(second, make_batch()), chunk_of(first, make_batch()))
