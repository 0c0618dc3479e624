"""The way back: what is exported is LeRobot's π0.5, and what was converted comes back bit for bit."""

import json
import shutil

import pytest
import torch
from benchmarks.lerobot_pi05 import LM_HEADS, load_lerobot_policy
from safetensors.torch import load_file, save_file

from lerobot_policy_pi05_geometry.checkpoint.conversion import GeometryStart, convert, export
from lerobot_policy_pi05_geometry.geometry.depth_augmentation import DepthAugmentation
from tests.entry_points import GEOMETRY, chunk_of, make_batch, make_policy, make_processors, without
from tests.geometry.da3.tiny import write_tiny

from .sources import EMBEDDING, EXPERT_HEAD, ONLY_0_6_2, VLM_HEAD, folder_contents, lerobot_chunk, write_lerobot

WEIGHTS = "model.safetensors"
HEADS = {f"model.{name}" for name in LM_HEADS}


@pytest.fixture
def exported(converted, tmp_path):
    export(converted, tmp_path / "exported")
    return tmp_path / "exported"


def test_there_and_back_is_equal_bit_for_bit(lerobot_source, exported):
    before, after = load_file(lerobot_source / WEIGHTS), load_file(exported / WEIGHTS)
    assert after.keys() == before.keys() >= HEADS
    for name in before.keys() - HEADS:
        assert after[name].dtype == before[name].dtype
        assert torch.equal(after[name], before[name]), name
    assert torch.equal(after[f"model.{VLM_HEAD}"], after[f"model.{EMBEDDING}"])
    assert not after[f"model.{EXPERT_HEAD}"].any()


def test_settings_come_back(lerobot_source, exported):
    before, after = (json.loads((folder / "config.json").read_text()) for folder in (lerobot_source, exported))
    assert before.keys() - after.keys() - ONLY_0_6_2 <= {"compile_model", "compile_mode"}
    assert after.keys() <= before.keys()
    assert {name for name in after if after[name] != before[name]} == {"device"}


def test_lerobot_loads_it_strictly(exported):
    """LeRobot goes on with random weights when loading fails, so what it loaded is compared with the file."""
    policy = load_lerobot_policy(exported)
    stored = load_file(exported / WEIGHTS)
    assert policy.state_dict().keys() == stored.keys()
    for name, tensor in policy.state_dict().items():
        assert torch.equal(tensor, stored[name]), name


@pytest.mark.parametrize(
    "changes",
    [{"geometry_source": "random"}, {"geometry_expert": "own"}, {"absent_cameras": ["observation.images.wrist"]}],
    ids=str,
)
def test_a_trained_policy_acts_as_with_its_geometry_masked(changes, tmp_path):
    """Whatever was learnt, what is exported is the policy without geometry."""
    policy = make_policy(seed=5, geometry_positions="parallel", **changes)
    policy.save_pretrained(tmp_path / "policy")
    for pipeline in make_processors(policy.config):
        pipeline.save_pretrained(tmp_path / "policy")
    export(tmp_path / "policy", tmp_path / "exported")
    theirs, batch = load_lerobot_policy(tmp_path / "exported"), make_batch(2)
    plain = make_policy(seed=5, geometry_source="none")
    plain.load_state_dict({k: v for k, v in policy.state_dict().items() if "geometry" not in k})
    torch.testing.assert_close(
        lerobot_chunk(theirs, batch), chunk_of(plain, without(batch, *GEOMETRY)), rtol=0, atol=1e-5
    )


def test_a_policy_made_from_an_export_is_the_same(converted, exported, two_cameras, tmp_path):
    convert(exported, tmp_path / "again", two_cameras)
    before, after = load_file(converted / WEIGHTS), load_file(tmp_path / "again" / WEIGHTS)
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)


@pytest.mark.parametrize("what", ["lacks", "has unknown", "has wrong"])
def test_a_bad_checkpoint_is_named_and_nothing_is_left(what, lerobot_source, tmp_path):
    convert(lerobot_source, tmp_path / "policy", GeometryStart(source="none"))
    path = tmp_path / "policy" / WEIGHTS
    tensors = load_file(path)
    if what == "lacks":
        del tensors["model.time_mlp_in.bias"]
    elif what == "has unknown":
        tensors["model.stranger"] = torch.zeros(2)
    else:
        tensors["model.time_mlp_in.bias"] = tensors["model.time_mlp_in.bias"].int()
    save_file(tensors, path)
    with pytest.raises(ValueError, match=rf"{path} {what} tensors: model\.(time_mlp_in\.bias|stranger)"):
        export(tmp_path / "policy", tmp_path / "output")
    assert folder_contents(tmp_path) == {"policy"}


def test_what_is_no_checkpoint_of_ours_is_refused(tmp_path):
    write_lerobot(tmp_path / "source")
    with pytest.raises(ValueError, match="of type 'pi05', not 'pi05_geometry'"):
        export(tmp_path / "source", tmp_path / "output")
    assert folder_contents(tmp_path) == {"source"}


def test_a_policy_trained_with_depth_augmentation_is_exported(tmp_path):
    """It belongs to depth, which an export does not have."""
    policy = make_policy(depth_augmentation=DepthAugmentation(noise=0.004, holes=0.1, shift=0.005))
    policy.save_pretrained(tmp_path / "trained")
    for pipeline in make_processors(policy.config):
        pipeline.save_pretrained(tmp_path / "trained")
    export(tmp_path / "trained", tmp_path / "exported")
    assert (tmp_path / "exported" / WEIGHTS).is_file()


def test_an_export_needs_no_depth_anything_3(tmp_path):
    """It drops geometry, so it does not look for its encoder."""
    encoder = write_tiny(tmp_path / "encoder" / "model.safetensors").parent
    policy = make_policy(geometry_source="da3", da3_encoder=str(encoder), da3_image_size=42, calibration={})
    policy.save_pretrained(tmp_path / "trained")
    for pipeline in make_processors(policy.config):
        pipeline.save_pretrained(tmp_path / "trained")
    shutil.rmtree(encoder)
    export(tmp_path / "trained", tmp_path / "exported")
    assert (tmp_path / "exported" / WEIGHTS).is_file()
