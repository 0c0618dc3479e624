"""Processors carry over: the same observation becomes the same prompt and state, the same actions come out."""

import json
import shutil

import pytest
import torch
from lerobot.policies import make_pre_post_processors
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.processor import RelativeActionsProcessorStep
from safetensors.torch import load_file, save_file

from lerobot_policy_pi05_geometry import PI05GeometryConfig
from lerobot_policy_pi05_geometry.checkpoint.conversion import GeometryStart, convert, export
from lerobot_policy_pi05_geometry.checkpoint.conversion.steps import (
    ABSOLUTE,
    RELATIVE,
    postprocessor_to_ours,
    preprocessor_to_ours,
    to_lerobot,
)
from lerobot_policy_pi05_geometry.data.relative_actions import ACTION_ANCHOR
from tests.entry_points import ACTION_DIM, CHUNK, FRONT_DEPTH, STATE, STATE_DIM, TOKEN_MASK, TOKENS, make_observation

from .sources import lerobot_pipelines, lerobot_policy, write_lerobot


def load(folder, config=None, **overrides):
    """A checkpoint's processors as LeRobot loads them."""
    return make_pre_post_processors(config or PI05GeometryConfig(device="cpu"), str(folder), **overrides)


def observation(size: int, seed: int, spread: float = 2.0):
    """States within the range of the statistics, where the prompts of both must agree, or beyond."""
    state = spread * torch.rand(size, STATE_DIM, generator=torch.Generator().manual_seed(seed)) - spread / 2
    return make_observation(size, seed) | {STATE: state, "action": torch.randn(size, CHUNK, ACTION_DIM)}


@pytest.mark.parametrize("seed", range(4))
def test_observations_and_actions_become_the_same(seed, converted, tmp_path):
    before, after = lerobot_pipelines(lerobot_policy(), tmp_path / "tokenizer"), load(converted)
    batch = observation(1 + seed % 3, seed)
    theirs, ours = before[0](dict(batch)), after[0](dict(batch))
    for key in (STATE, "action", FRONT_DEPTH):
        torch.testing.assert_close(ours[key], theirs[key], rtol=0, atol=0)
    length = ours[TOKENS].shape[1]  # ours pads to the longest prompt, theirs to the maximum
    assert length < theirs[TOKENS].shape[1]
    assert torch.equal(ours[TOKENS], theirs[TOKENS][:, :length])
    assert torch.equal(ours[TOKEN_MASK], theirs[TOKEN_MASK][:, :length])
    assert not theirs[TOKEN_MASK][:, length:].any()
    action = torch.randn(2, ACTION_DIM)
    torch.testing.assert_close(after[1](action), before[1](action), rtol=0, atol=0)


def test_settings_of_steps_carry_over(tmp_path):
    source = write_lerobot(tmp_path / "source")
    path = source / "policy_preprocessor.json"
    pipeline = json.loads(path.read_text())
    steps = {step["registry_name"]: step for step in pipeline["steps"]}
    steps["rename_observations_processor"]["config"]["rename_map"] = {"theirs": "ours"}
    steps["normalizer_processor"]["config"]["eps"] = 0.25
    steps["tokenizer_processor"]["config"]["max_length"] = 33
    steps["device_processor"]["config"]["device"] = "cuda"
    path.write_text(json.dumps(pipeline))
    convert(source, tmp_path / "output")
    found, _ = load(tmp_path / "output")
    by_type = {type(step).__name__: step for step in found.steps}
    assert by_type["RenameObservationsProcessorStep"].rename_map == {"theirs": "ours"}
    assert by_type["NormalizerProcessorStep"].eps == 0.25
    assert by_type["PortableTokenizerProcessorStep"].max_length == 33
    assert by_type["DeviceProcessorStep"].device == "cpu"
    theirs = [step["registry_name"] for step in pipeline["steps"]]
    kept = [name for step in found.steps if (name := getattr(type(step), "_registry_name", "")) in theirs]
    assert kept == [name for name in theirs if "pi05" not in name and name not in ("tokenizer_processor", RELATIVE)]


def test_the_tokenizer_travels_in_the_checkpoint(converted):
    """Nothing is looked up by name any more."""
    path = converted / "policy_preprocessor.json"
    steps = json.loads(path.read_text())["steps"]
    step = next(s for s in steps if s.get("registry_name") == "pi05_geometry_tokenizer")
    assert set(load_file(converted / step["state_file"])) == {"tokenizer.json", "tokenizer_config.json"}


def test_a_tokenizer_that_is_not_there_is_named(lerobot_source, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"Tokenizer folder \./nowhere is not there"):
        convert(lerobot_source, tmp_path / "output", tokenizer="./nowhere")
    assert not list(tmp_path.iterdir())


def test_a_new_tokenizer_is_taken(lerobot_source, tmp_path):
    folder = lerobot_source / "tokenizer_of_the_test"
    convert(lerobot_source, tmp_path / "output", GeometryStart(source="none"), tokenizer=str(folder))
    text = (tmp_path / "output" / "policy_preprocessor.json").read_text()
    (step,) = (s for s in json.loads(text)["steps"] if s.get("registry_name") == "pi05_geometry_tokenizer")
    assert step["config"]["tokenizer_name"] == str(folder)


@pytest.mark.parametrize("seed", range(2))
def test_exported_processors_are_lerobots(seed, converted, tmp_path):
    export(converted, tmp_path / "output")
    assert "pi05_geometry" not in (tmp_path / "output" / "policy_preprocessor.json").read_text()
    tokenizer = {"tokenizer_processor": {"tokenizer_name": str(tmp_path / "output" / "tokenizer")}}
    found = load(tmp_path / "output", PI05Config(device="cpu"), preprocessor_overrides=tokenizer)
    expected = lerobot_pipelines(lerobot_policy(), tmp_path / "tokenizer")
    assert [type(step) for step in found[0].steps] == [type(step) for step in expected[0].steps]
    batch = observation(2, seed, spread=6.0)
    theirs, ours = expected[0](dict(batch)), found[0](dict(batch))
    for key in (STATE, "action", TOKENS, TOKEN_MASK):
        assert torch.equal(ours[key], theirs[key]), key
    action = torch.randn(2, ACTION_DIM)
    assert torch.equal(found[1](action), expected[1](action))


def without_relative_actions(folder):
    """A checkpoint whose processors were saved before LeRobot had relative actions."""
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        pipeline = json.loads((folder / name).read_text())
        pipeline["steps"] = [step for step in pipeline["steps"] if step["registry_name"] not in (RELATIVE, ABSOLUTE)]
        (folder / name).write_text(json.dumps(pipeline))
    return folder


@pytest.mark.parametrize("early", [False, True], ids=["with the steps", "saved before they existed"])
@pytest.mark.parametrize("excluded", [[], ["grip"]])
def test_relative_actions_can_be_switched_on_in_a_converted_checkpoint(early, excluded, tmp_path):
    """lerobot-train does it by overrides of the saved steps; without them that was a KeyError."""
    source = write_lerobot(tmp_path / "source")
    convert(without_relative_actions(source) if early else source, tmp_path / "output", GeometryStart(source="none"))
    names = ["x", "y", "z", "turn", "grip"]
    settings = {"enabled": True, "exclude_joints": excluded, "action_names": names}
    preprocess, _ = load(
        tmp_path / "output",
        preprocessor_overrides={RELATIVE: settings},
        postprocessor_overrides={ABSOLUTE: {"enabled": True}},
    )
    theirs = lerobot_pipelines(lerobot_policy(), tmp_path / "tokenizer")[0]
    (step,) = (step for step in theirs.steps if isinstance(step, RelativeActionsProcessorStep))
    step.enabled, step.exclude_joints, step.action_names = True, excluded, names
    batch = observation(2, 5)
    found, expected = preprocess(dict(batch)), theirs(dict(batch))
    for key in (STATE, "action"):
        assert torch.equal(found[key], expected[key])
    assert found[ACTION_ANCHOR].shape == (2, ACTION_DIM)


def test_relative_actions_of_the_source_stay_relative_both_ways(tmp_path):
    source = write_lerobot(tmp_path / "source", use_relative_actions=True, relative_exclude_joints=["grip"])
    for name, key in (("policy_preprocessor.json", RELATIVE), ("policy_postprocessor.json", ABSOLUTE)):
        pipeline = json.loads((source / name).read_text())
        (step,) = (step for step in pipeline["steps"] if step["registry_name"] == key)
        step["config"]["enabled"] = True
        (source / name).write_text(json.dumps(pipeline))
    convert(source, tmp_path / "output", GeometryStart(source="none"))
    config = PI05GeometryConfig(device="cpu", use_relative_actions=True)
    assert ACTION_ANCHOR in load(tmp_path / "output", config)[0](observation(2, 1))
    export(tmp_path / "output", tmp_path / "back")
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        before, after = (json.loads((folder / name).read_text())["steps"] for folder in (source, tmp_path / "back"))
        assert [step["registry_name"] for step in after] == [step["registry_name"] for step in before]
        for theirs, ours in zip(before, after, strict=True):
            if theirs["registry_name"] in (RELATIVE, ABSOLUTE):
                assert ours == theirs


def test_a_checkpoint_of_an_earlier_version_gets_the_steps(converted):
    """Its relative actions were LeRobot's steps, and it had none around the normaliser; what is there already stays."""
    for name, to_ours in (
        ("policy_preprocessor.json", preprocessor_to_ours),
        ("policy_postprocessor.json", postprocessor_to_ours),
    ):
        steps = json.loads((converted / name).read_text())["steps"]
        assert to_ours(steps) == steps
        assert to_ours(to_lerobot(steps)) == steps


@pytest.mark.parametrize(
    "named", ["../../theirs.safetensors", "/tmp/x.safetensors", "model.safetensors", "notes.txt", 3]
)
@pytest.mark.parametrize("kind", ["lerobot", "ours"])
def test_a_step_whose_file_is_no_file_of_the_checkpoint_is_refused(named, kind, lerobot_source, converted, tmp_path):
    """A checkpoint from elsewhere could otherwise have any file read, and written beside the output."""
    source = tmp_path / "a" / "b" / "source"
    shutil.copytree(lerobot_source if kind == "lerobot" else converted, source)
    victim = tmp_path / "home" / "theirs.safetensors"
    victim.parent.mkdir()
    victim.write_text("mine")
    (tmp_path / "a" / "theirs.safetensors").write_text("evil")
    path = source / "policy_preprocessor.json"
    pipeline = json.loads(path.read_text())
    next(step for step in pipeline["steps"] if "state_file" in step)["state_file"] = named
    path.write_text(json.dumps(pipeline))
    with pytest.raises(ValueError, match="expected the name of a safetensors file in the same folder"):
        convert(source, tmp_path / "home" / "x" / "output", GeometryStart(grid=2))
    assert victim.read_text() == "mine"


def test_an_export_writes_the_tokenizers_files_only(converted, tmp_path):
    """Names of tensors come with a checkpoint; as paths they could lead anywhere."""
    source, outside = tmp_path / "source", tmp_path / "authorized_keys"
    shutil.copytree(converted, source)
    (tokenizer,) = source.glob("*tokenizer*.safetensors")
    save_file({**load_file(tokenizer), str(outside): torch.zeros(3, dtype=torch.uint8)}, tokenizer)
    with pytest.raises(ValueError, match="A saved tokenizer has the files"):
        export(source, tmp_path / "output")
    assert not outside.exists()


@pytest.mark.parametrize(("ours", "constant"), [([], 0.0), ([{}], -1.0), ([{"constant": 0.0}], 0.0)])
def test_a_policy_of_ours_keeps_the_constant_that_it_was_trained_with(ours, constant):
    """Of a state dimension without width under MEAN_STD: 0 for LeRobot's π0.5, -1 in ours of an earlier version."""
    steps = [{"registry_name": "normalizer_processor", "config": {"norm_map": {"STATE": "MEAN_STD"}}}]
    steps += [{"registry_name": "pi05_geometry_normaliser_scale", "config": config} for config in ours]
    scale = [s for s in preprocessor_to_ours(steps) if s.get("registry_name") == "pi05_geometry_normaliser_scale"]
    assert [step["config"] for step in scale] == [{"constant": constant}]
