"""A checkpoint of this policy gets another geometry: what stays is kept bit for bit, what is new is drawn anew."""

import json
import math
import shutil
from pathlib import Path

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from safetensors.torch import load_file, save_file
from torch import Tensor

from lerobot_policy_pi05_geometry.checkpoint.conversion import GeometryStart, convert
from lerobot_policy_pi05_geometry.checkpoint.load import load_policy
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from tests.entry_points import FRONT_DEPTH, WRIST_DEPTH, chunk_of, make_batch
from tests.geometry.da3.tiny import write_tiny

from .sources import folder_contents, load_on

WEIGHTS = "model.safetensors"
GATE = "model.paligemma_with_expert.geometry_gate.openness"
LOG_GATE = GATE.replace("openness", "log_gate")
MLP = {f"geometry.adapter.{name}" for name in ("norm.weight", "norm.bias", "fc_in.weight", "fc_in.bias",
                                               "fc_out.weight", "fc_out.bias")}  # fmt: skip
PLACES = {"geometry.adapter.row", "geometry.adapter.column"}
VIEW = {"geometry.adapter.view"}


@pytest.fixture(scope="module")
def encoder(tmp_path_factory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("encoders") / "DA3-TINY" / WEIGHTS).parent


def trained(converted: Path, output: Path, **changes) -> Path:
    """A checkpoint with processors, whose geometry is trained: every new parameter drawn anew, the gate open."""
    policy = load_on(converted, **changes)
    generator = torch.Generator().manual_seed(11)
    with torch.no_grad():
        for name, parameter in policy.new_parameters().items():
            parameter.copy_(torch.rand(parameter.shape, generator=generator) + (0.1 if name == GATE else -0.5))
    policy.progress.step.fill_(700)
    policy.save_pretrained(output)
    for path in converted.glob("policy_*"):
        shutil.copy(path, output)
    return output


@pytest.fixture(scope="module")
def rgbd(converted, tmp_path_factory) -> Path:
    """Depth from two cameras, grid 3; do not change it."""
    return trained(converted, tmp_path_factory.mktemp("rgbd") / "policy")


@pytest.fixture(scope="module")
def da3(lerobot_source, encoder, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("da3")
    convert(lerobot_source, folder / "converted", GeometryStart("da3", encoder=str(encoder), grid=3))
    return trained(folder / "converted", folder / "policy", da3_image_size=42)


def change(folder: Path, output: Path, **start) -> tuple[dict[str, Tensor], dict[str, Tensor], dict]:
    """Tensors before and after, and the configuration after."""
    convert(folder, output, GeometryStart(**start))
    return load_file(folder / WEIGHTS), load_file(output / WEIGHTS), json.loads((output / "config.json").read_text())


def differing(before: dict[str, Tensor], after: dict[str, Tensor]) -> set[str]:
    """Names whose tensors are not the same bit for bit, or that only one side has."""
    both = before.keys() & after.keys()
    return {
        name for name in both if before[name].shape != after[name].shape or not torch.equal(before[name], after[name])
    } | (before.keys() ^ after.keys())


# --- what stays, what is new ------------------------------------------------------------------------------------------


def test_another_grid_changes_rows_and_columns_alone(rgbd, tmp_path) -> None:
    before, after, config = change(rgbd, tmp_path / "output", grid=5)
    assert differing(before, after) == PLACES
    assert after["geometry.adapter.row"].shape == (5, 24)
    assert (config["geometry_grid"], config["geometry_gate_lr"]) == (5, 0.05)
    assert after["progress.step"] == 700
    assert folder_contents(rgbd) == folder_contents(tmp_path / "output")
    for path in rgbd.glob("policy_*"):  # processors and statistics
        assert path.suffix == ".json" or path.read_bytes() == (tmp_path / "output" / path.name).read_bytes()
    policy = load_policy(tmp_path / "output").policy
    assert policy.geometry.source.num_tokens == 2 * 25
    assert chunk_of(policy, make_batch(2)).isfinite().all()


def test_other_cameras_keep_their_embeddings_by_name(rgbd, tmp_path) -> None:
    views = load_file(rgbd / WEIGHTS)["geometry.adapter.view"]
    before, after, _ = change(rgbd, tmp_path / "swapped", cameras=("wrist", "front"))
    assert differing(before, after) == VIEW
    assert torch.equal(after["geometry.adapter.view"], views.flip(0))
    policy = load_policy(tmp_path / "swapped").policy
    assert policy.geometry.source.cameras == ("wrist", "front")

    before, after, _ = change(rgbd, tmp_path / "fewer", cameras=("wrist",))
    assert differing(before, after) == VIEW
    assert torch.equal(after["geometry.adapter.view"], views[1:])

    before, after, config = change(rgbd, tmp_path / "more", cameras=("wrist", "top"))
    assert differing(before, after) == VIEW
    assert torch.equal(after["geometry.adapter.view"][0], views[1])
    assert not torch.equal(after["geometry.adapter.view"][1], views[0])
    assert config["geometry_pending"] == 2  # the data says what the new camera's depth is like


def test_a_policy_with_swapped_cameras_acts_as_before(rgbd, tmp_path) -> None:
    """Under parallel positions the cells change places, but each has its embedding: only rotary positions differ."""
    convert(rgbd, tmp_path / "there", GeometryStart(cameras=("wrist", "front")))
    convert(tmp_path / "there", tmp_path / "back", GeometryStart(cameras=("front", "wrist")))
    batch = make_batch(2)
    assert not differing(load_file(rgbd / WEIGHTS), load_file(tmp_path / "back" / WEIGHTS))
    assert torch.equal(
        chunk_of(load_policy(tmp_path / "back").policy, batch), chunk_of(load_policy(rgbd).policy, batch)
    )


def test_another_source_begins_with_a_shut_gate(rgbd, encoder, tmp_path) -> None:
    """The policy goes on acting as it did without geometry; places and views stay, since cells and cameras do."""
    before, after, config = change(rgbd, tmp_path / "output", source="da3", encoder=str(encoder))
    assert differing(before, after) == MLP | {GATE}
    assert after[GATE].unique().tolist() == pytest.approx([1e-7])
    assert (config["geometry_gate_openness"], config["image_dropout"]) == (1e-7, 0.4)
    batch = make_batch(2)
    without = {key: torch.zeros_like(batch[key]) for key in (FRONT_DEPTH, WRIST_DEPTH)}
    expected = chunk_of(load_policy(rgbd).policy, batch | without)
    assert (chunk_of(load_policy(tmp_path / "output").policy, batch) - expected).abs().max() < 1e-3


def test_without_geometry_and_back(rgbd, tmp_path) -> None:
    before, plain, _ = change(rgbd, tmp_path / "plain", source="none")
    assert differing(before, plain) == MLP | PLACES | VIEW | {GATE}
    batch = make_batch(2)
    without = {key: torch.zeros_like(batch[key]) for key in (FRONT_DEPTH, WRIST_DEPTH)}
    acted = chunk_of(load_policy(tmp_path / "plain").policy, batch)
    assert (acted - chunk_of(load_policy(rgbd).policy, batch | without)).abs().max() < 1e-5
    _, again, config = change(tmp_path / "plain", tmp_path / "again", source="rgbd", grid=3, cameras=("front", "wrist"))
    assert again.keys() == before.keys()
    assert (config["geometry_positions"], config["geometry_gate_openness"]) == ("parallel", 1e-7)
    policy = load_on(tmp_path / "again")
    assert policy.geometry.source.cameras == ("front", "wrist")
    assert (chunk_of(policy, batch) - acted).abs().max() < 1e-3


def test_features_and_da3_are_the_same_adapter(da3, tmp_path) -> None:
    before, stored, config = change(da3, tmp_path / "stored", source="features")
    assert not differing(before, stored)
    hash_before = PreTrainedConfig.from_pretrained(da3).da3_hash
    assert (config["geometry_source"], config["da3_hash"]) == ("features", hash_before)
    _, live, config = change(tmp_path / "stored", tmp_path / "live", source="da3")
    assert not differing(before, live)
    assert config["da3_image_size"] == 42
    batch = make_batch(2)
    assert torch.equal(chunk_of(load_policy(tmp_path / "live").policy, batch), chunk_of(load_policy(da3).policy, batch))


def test_an_encoder_is_known_by_its_content(da3, encoder, tmp_path) -> None:
    copy = shutil.copytree(encoder, tmp_path / "copy")
    before, after, config = change(da3, tmp_path / "moved", encoder=str(copy))
    assert not differing(before, after)
    assert config["da3_encoder"] == str(copy)
    other = write_tiny(tmp_path / "other" / WEIGHTS, seed=5).parent
    before, after, _ = change(da3, tmp_path / "changed", encoder=str(other))
    assert differing(before, after) == MLP | {GATE}


def test_from_depth_anything_to_a_depth_camera(da3, calibration, tmp_path) -> None:
    """The data names the depth camera, unless a name and a calibration are given."""
    before, after, config = change(da3, tmp_path / "output", source="rgbd", cameras=("front",), calibration=calibration)
    assert differing(before, after) == MLP | VIEW | {GATE}
    assert torch.equal(after["geometry.adapter.view"], before["geometry.adapter.view"][:1])
    assert (config["geometry_pending"], config["da3_hash"]) == (1, None)
    assert load_on(tmp_path / "output").geometry.source.cameras == ("front",)
    _, _, config = change(da3, tmp_path / "unnamed", source="rgbd")
    assert (config["geometry_pending"], config["geometry_cameras"]) == (1, None)


def test_another_frame_is_another_meaning(rgbd, tmp_path) -> None:
    before, after, config = change(rgbd, tmp_path / "output", frame="camera")
    assert differing(before, after) == MLP | {GATE}
    assert config["geometry_frame"] == "camera"


@pytest.mark.parametrize(
    ("start", "left"),
    [({"frame": "camera"}, (0.01, 0.0)), ({"source": "none"}, (0.0, 0.0)), ({"grid": 2}, (0.01, 0.02))],
)
def test_augmentation_of_depth_is_kept_where_there_is_such_depth(rgbd, tmp_path, start, left) -> None:
    policy = shutil.copytree(rgbd, tmp_path / "policy")
    config = json.loads((policy / "config.json").read_text())
    config["depth_augmentation"] |= {"noise": 0.01, "shift": 0.02}
    (policy / "config.json").write_text(json.dumps(config))
    _, _, after = change(policy, tmp_path / "output", **start)
    assert (after["depth_augmentation"]["noise"], after["depth_augmentation"]["shift"]) == left


def test_points_instead_of_statistics(rgbd, tmp_path) -> None:
    before, after, config = change(rgbd, tmp_path / "output", tokens="points")
    pooling = {f"geometry.adapter.point_{side}.{name}" for side in ("in", "out") for name in ("weight", "bias")}
    assert differing(before, after) == MLP | {GATE} | pooling
    assert config["geometry_tokens"] == "points"
    assert load_policy(tmp_path / "output").policy.geometry.source.points == 16
    again, back, _ = change(tmp_path / "output", tmp_path / "back", grid=2)
    assert differing(again, back) == PLACES


def test_an_own_expert_is_added_and_left_out(rgbd, tmp_path) -> None:
    before, own, _ = change(rgbd, tmp_path / "own", expert="own")
    added = differing(before, own)
    assert added
    assert all("geometry_expert." in name for name in added)
    policy = load_policy(tmp_path / "own").policy
    assert torch.equal(chunk_of(policy, make_batch(2)), chunk_of(load_policy(rgbd).policy, make_batch(2)))
    _, again, _ = change(tmp_path / "own", tmp_path / "shared", expert="shared")
    assert not differing(before, again)


def test_the_gate_alone(rgbd, tmp_path) -> None:
    before, after, config = change(rgbd, tmp_path / "output", openness=0.25)
    assert differing(before, after) == {GATE}
    assert after[GATE].unique().tolist() == [0.25]
    assert config["geometry_gate_openness"] == 0.25


def test_features_from_the_data(rgbd, tmp_path) -> None:
    """Cameras and state are left to the data that it is trained on next; their number stays."""
    convert(rgbd, tmp_path / "output", features_from_data=True)
    assert not differing(load_file(rgbd / WEIGHTS), load_file(tmp_path / "output" / WEIGHTS))
    config = PreTrainedConfig.from_pretrained(tmp_path / "output")
    assert (config.input_features, config.output_features, config.geometry_features) == ({}, {}, {})
    assert config.geometry_pending == 2


# --- of an earlier version --------------------------------------------------------------------------------------------


def outdated(folder: Path, output: Path) -> Path:
    """The same checkpoint as an earlier version wrote it: with a log-gate, drawn anew."""
    shutil.copytree(folder, output)
    tensors = load_file(output / WEIGHTS)
    tensors[LOG_GATE] = 3 * torch.randn(tensors.pop(GATE).shape, generator=torch.Generator().manual_seed(2))
    save_file(tensors, output / WEIGHTS)
    config = json.loads((output / "config.json").read_text())
    del config["geometry_gate_openness"]
    (output / "config.json").write_text(json.dumps(config | {"geometry_gate_init": -16.0}))
    return output


def test_a_log_gate_becomes_its_exponential(rgbd, tmp_path) -> None:
    old = outdated(rgbd, tmp_path / "old")
    before, after, config = change(old, tmp_path / "new")
    assert differing(before, after) == {LOG_GATE, GATE}
    torch.testing.assert_close(after[GATE], before[LOG_GATE].exp())
    assert config["geometry_gate_openness"] == pytest.approx(math.exp(-16))
    assert config["geometry_gate_init"] is None
    assert load_policy(tmp_path / "new").policy.geometry.source.num_tokens == 18


def test_a_log_gate_is_refused_anywhere_else(rgbd, tmp_path) -> None:
    """With the command that helps, so its optimiser's state is never met."""
    old = outdated(rgbd, tmp_path / "old")
    said = "whose gate was stored as a logarithm .* write a new one with `pi05-geometry convert"
    with pytest.raises(ValueError, match=said):
        PI05GeometryPolicy.from_pretrained(old)
    with pytest.raises(ValueError, match=said):
        load_policy(old)


# --- what is refused --------------------------------------------------------------------------------------------------


def spoil(folder: Path, output: Path, edit) -> Path:
    shutil.copytree(folder, output)
    tensors = load_file(output / WEIGHTS)
    edit(tensors)
    save_file(tensors, output / WEIGHTS)
    return output


def lose(tensors: dict) -> None:
    del tensors["model.action_in_proj.weight"]


def add(tensors: dict) -> None:
    tensors["geometry.adapter.stranger"] = torch.zeros(3)


def shorten(tensors: dict) -> None:
    tensors["geometry.adapter.fc_in.bias"] = torch.zeros(3)


def break_one(tensors: dict) -> None:
    tensors["geometry.adapter.fc_in.bias"][2] = float("nan")


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lose, "lacks tensors: model.action_in_proj.weight"),
        (add, "has unknown tensors: geometry.adapter.stranger"),
        (shorten, "has wrong tensors: geometry.adapter.fc_in.bias"),
        (break_one, "has NaN or infinity in geometry.adapter.fc_in.bias"),
    ],
)
def test_weights_that_are_not_whole_are_named(edit, said, rgbd, tmp_path) -> None:
    source = spoil(rgbd, tmp_path / "source", edit)
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        convert(source, tmp_path / "output", GeometryStart(grid=2))
    assert said in str(caught.value)
    assert folder_contents(tmp_path) == {"source"}


def test_nothing_to_change_is_said(rgbd, tmp_path) -> None:
    with pytest.raises(ValueError, match="is a checkpoint of this policy already; say what its geometry should become"):
        convert(rgbd, tmp_path / "output")


def test_lora_is_merged_first(rgbd, tmp_path) -> None:
    source = shutil.copytree(rgbd, tmp_path / "lora")
    (source / "adapter_config.json").write_text("{}")
    with pytest.raises(ValueError, match="was trained with LoRA; merge it first"):
        convert(source, tmp_path / "output", GeometryStart(grid=2))


@pytest.mark.parametrize(
    ("geometry", "options", "said"),
    [
        ({"grid": 0}, {}, "--geometry-grid must be at least 1, got 0"),
        ({"frame": ""}, {}, "geometry_frame must be one of .*, got ''"),
        ({"source": ""}, {}, "geometry-source must be one of .*, got ''"),
        ({"grid": 4}, {"chunk_size": 4}, "--chunk-size is for an openpi checkpoint"),
        ({"grid": 4}, {"tokenizer": "./mine"}, "carries its tokenizer; leave --tokenizer-path out"),
    ],
)
def test_what_is_given_is_never_left_as_it_was(geometry, options, said, converted, tmp_path):
    with pytest.raises(ValueError, match=said):
        convert(converted, tmp_path / "output", GeometryStart(**geometry), **options)
    assert not folder_contents(tmp_path)
