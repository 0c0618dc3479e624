"""A π0.5 of LeRobot or openpi becomes a checkpoint of this policy, whole, or nothing is left behind."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from safetensors.torch import load_file

from lerobot_policy_pi05_geometry.checkpoint.conversion import GeometryStart, convert
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from tests.entry_points import FRONT, STATE, WRIST

from .sources import (
    EMBEDDING,
    ONLY_0_6_2,
    VLM_HEAD,
    Tensors,
    folder_contents,
    lerobot_policy,
    load_on,
    without_prefix,
    write_lerobot,
    write_openpi,
)

WEIGHTS = "model.safetensors"
PROJECTION = "model.time_mlp_in.weight"
QUERY = "model.paligemma_with_expert.paligemma.model.language_model.layers.1.self_attn.q_proj.weight"


def retie(tensors: Tensors) -> Tensors:
    """As safetensors' `save_model` leaves tied matrices: only the head's name."""
    tensors = without_prefix(tensors)
    tensors[VLM_HEAD] = tensors.pop(EMBEDDING)
    return tensors


def stripped(tensors: Tensors) -> Tensors:
    return {name: tensor for name, tensor in tensors.items() if "lm_head" not in name}


def pi0_names(tensors: Tensors) -> Tensors:
    return {name.replace("time_mlp", "action_time_mlp"): t for name, t in without_prefix(tensors).items()}


def with_leftovers(tensors: Tensors) -> Tensors:
    return tensors | {"state_proj.weight": torch.ones(24, 8), "state_proj.bias": torch.ones(24)}


def some_prefixed(tensors: Tensors) -> Tensors:
    return {n.removeprefix("model.") if i % 2 else n: t for i, (n, t) in enumerate(sorted(tensors.items()))}


def in_other_dtypes(tensors: Tensors) -> Tensors:
    kinds = (torch.float64, torch.float32, torch.bfloat16, torch.float16)
    return {name: tensor.to(kinds[i % 4]) for i, (name, tensor) in enumerate(tensors.items())}


VARIANTS = [without_prefix, retie, stripped, pi0_names, with_leftovers, some_prefixed]


def assert_same_weights(folder: Path) -> None:
    """Every tensor of π0.5 is in the checkpoint bit for bit, in the source's dtype, and nothing else but what is new."""
    found, theirs = load_file(folder / WEIGHTS), lerobot_policy().state_dict()
    for name, tensor in theirs.items():
        if "lm_head" not in name:
            assert found[name].dtype == tensor.dtype
            assert torch.equal(found.pop(name), tensor), name
    assert all(name == "progress.step" or "geometry" in name for name in found)


@pytest.mark.parametrize("change", VARIANTS, ids=lambda change: change.__name__)
def test_every_layout_that_lerobot_loads(change, tmp_path, two_cameras):
    convert(write_lerobot(tmp_path / "source", change), tmp_path / "output", two_cameras)
    assert_same_weights(tmp_path / "output")
    policy = load_on(tmp_path / "output")
    for name, tensor in lerobot_policy().state_dict().items():
        if "lm_head" not in name:
            assert torch.equal(policy.state_dict()[name], tensor), name


def test_openpi(tmp_path, two_cameras):
    convert(write_openpi(tmp_path / "source"), tmp_path / "output", two_cameras)
    assert_same_weights(tmp_path / "output")
    config = PreTrainedConfig.from_pretrained(tmp_path / "output")
    assert (config.chunk_size, config.n_action_steps, config.max_action_dim) == (6, 6, 8)
    assert not config.input_features  # the training data's, then
    assert not list((tmp_path / "output").glob("*normalizer*.safetensors"))


def test_openpi_without_a_config_needs_a_chunk_size(tmp_path):
    source = write_openpi(tmp_path / "source")
    config = json.loads((source / "config.json").read_text())
    (source / "config.json").unlink()
    with pytest.raises(ValueError, match=r"source does not say how many actions a chunk has .* --chunk-size"):
        convert(source, tmp_path / "output")
    del config["action_horizon"]
    (source / "config.json").write_text(json.dumps(config))
    convert(source, tmp_path / "output", chunk_size=11)
    assert PreTrainedConfig.from_pretrained(tmp_path / "output").chunk_size == 11


@pytest.mark.parametrize(
    ("geometry", "options", "said"),
    [
        ({"grid": 0}, {}, "--geometry-grid must be at least 1, got 0"),
        ({"frame": ""}, {}, "geometry_frame must be one of .*, got ''"),
        ({"expert": ""}, {}, "geometry_expert must be one of .*, got ''"),
        ({"tokens": ""}, {}, "geometry_tokens must be one of .*, got ''"),
        ({"source": ""}, {}, "geometry-source must be one of .*, got ''"),
        ({}, {"chunk_size": 4}, "--chunk-size is for an openpi checkpoint"),
    ],
)
def test_what_is_given_is_never_replaced_by_a_default(geometry, options, said, lerobot_source, tmp_path):
    with pytest.raises(ValueError, match=said):
        convert(lerobot_source, tmp_path / "output", GeometryStart(**geometry), **options)
    assert not folder_contents(tmp_path)


def test_a_chunk_of_no_actions_is_refused(tmp_path):
    with pytest.raises(ValueError, match="chunk_size must be at least 1, got 0"):
        convert(write_openpi(tmp_path / "source"), tmp_path / "output", chunk_size=0)


@pytest.mark.parametrize("features", [["front"], {FRONT: ["VISUAL"]}, {FRONT: {"shape": [3, 28, 28]}}])
def test_input_features_that_are_none_are_named(features, tmp_path):
    source = write_lerobot(tmp_path / "source", input_features=features)
    with pytest.raises(ValueError, match="input_features"):
        convert(source, tmp_path / "output")


def test_dtypes_stay_as_they_are_stored(tmp_path):
    source = write_lerobot(tmp_path / "source", in_other_dtypes)
    convert(source, tmp_path / "output", GeometryStart(source="none"))
    before, after = load_file(source / WEIGHTS), load_file(tmp_path / "output" / WEIGHTS)
    assert {t.dtype for t in after.values()} > {torch.float64, torch.bfloat16, torch.float16}
    for name in after.keys() - {"progress.step"}:
        assert after[name].dtype == before[name].dtype
        assert torch.equal(after[name], before[name])


def test_settings_carry_over(lerobot_source, converted):
    theirs = json.loads((lerobot_source / "config.json").read_text())
    ours = json.loads((converted / "config.json").read_text())
    changed = {name for name in theirs.keys() & ours.keys() if theirs[name] != ours[name]}
    assert changed == {"type", "device"}
    assert set(theirs) - set(ours) - ONLY_0_6_2 <= {"compile_model", "compile_mode"}
    assert (ours["type"], ours["device"], ours["optimizer_lr"]) == ("pi05_geometry", None, 1.25e-5)
    assert list(ours["input_features"]) == [FRONT, WRIST, STATE]
    assert (ours["geometry_positions"], ours["geometry_gate_openness"]) == ("parallel", 1e-7)
    assert ours["calibration"].keys() == {"front", "wrist"}


@pytest.mark.parametrize("switch", ["use_visual_memory", "use_proprioceptive_memory"])
def test_a_source_with_memory_is_refused(tmp_path, switch):
    """LeRobot 0.6.2's π0.5 may look at earlier observations; without them its weights act differently."""
    convert(write_lerobot(tmp_path / "off", **{switch: False}, memory_frames=6), tmp_path / "output")
    with pytest.raises(ValueError, match="remembers earlier observations"):
        convert(write_lerobot(tmp_path / "on", **{switch: True}), tmp_path / "refused")
    assert not (tmp_path / "refused").exists()


def test_what_belongs_to_the_source_alone_does_not_carry_over(tmp_path, caplog):
    """A repository to push to, or the device of a machine, would surprise whoever trains the result."""
    empty = {"type": "VISUAL", "shape": [3, 28, 28]}
    source = write_lerobot(
        tmp_path / "source",
        repo_id="them/theirs",
        device="cuda",
        empty_cameras=1,
        novelty=3,
        input_features={STATE: {"type": "STATE", "shape": [7]}, "observation.images.empty_camera_0": empty},
    )
    convert(source, tmp_path / "output")
    assert "settings that this policy does not have, left out: novelty" in caplog.text
    config = json.loads((tmp_path / "output" / "config.json").read_text())
    assert (config["repo_id"], config["device"], config["empty_cameras"]) == (None, None, 1)
    assert list(config["input_features"]) == [STATE]
    policy = PI05GeometryPolicy.from_pretrained(tmp_path / "output")
    assert policy.config.may_be_absent("observation.images.empty_camera_0")


@pytest.mark.parametrize("geometry", ["random", "rgbd"])
@pytest.mark.parametrize("cameras", [None, ("front", "wrist", "third")])
def test_it_loads_before_any_data_named_its_cameras(geometry, cameras, lerobot_source, tmp_path):
    convert(lerobot_source, tmp_path / "output", GeometryStart(source=geometry, cameras=cameras, grid=2))
    policy = PI05GeometryPolicy.from_pretrained(tmp_path / "output")
    assert policy.geometry.source.num_tokens == 4 * len(cameras or [""])


def test_it_loads_without_geometry(lerobot_source, tmp_path):
    convert(lerobot_source, tmp_path / "output", GeometryStart(source="none"))
    assert PI05GeometryPolicy.from_pretrained(tmp_path / "output").geometry is None


def test_an_own_expert_starts_as_the_action_expert(lerobot_source, tmp_path):
    convert(lerobot_source, tmp_path / "output", GeometryStart(expert="own"))
    assert_same_weights(tmp_path / "output")
    network = PI05GeometryPolicy.from_pretrained(tmp_path / "output").model.paligemma_with_expert
    for name, tensor in network.expert.state_dict().items():
        assert torch.equal(network.geometry_expert.state_dict()[name], tensor), name


def test_a_seed_draws_the_adapter(lerobot_source, tmp_path):
    drawn = []
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        torch.randn(3)  # whatever was drawn before does not matter
        convert(lerobot_source, tmp_path / name, seed=seed)
        drawn.append(load_file(tmp_path / name / WEIGHTS)["geometry.adapter.fc_in.weight"])
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[0], drawn[2])


# --- what is refused ----------------------------------------------------------------------------------------------


def transpose(tensors: Tensors) -> None:
    tensors["model.action_in_proj.weight"] = tensors["model.action_in_proj.weight"].T


def shorten(tensors: Tensors) -> None:
    tensors[QUERY] = tensors[QUERY][:-1]


def integer(tensors: Tensors) -> None:
    tensors[PROJECTION] = tensors[PROJECTION].int()


def boolean(tensors: Tensors) -> None:
    tensors[QUERY] = tensors[QUERY] > 0


def integer_head(tensors: Tensors) -> Tensors:
    return retie(tensors) | {VLM_HEAD: retie(tensors)[VLM_HEAD].long()}


def missing(tensors: Tensors) -> None:
    del tensors[QUERY]


def missing_embedding(tensors: Tensors) -> Tensors:
    return stripped({name: t for name, t in tensors.items() if EMBEDDING not in name})


def extra(tensors: Tensors) -> None:
    tensors["model.stranger"] = torch.zeros(3)


def not_a_number(tensors: Tensors) -> None:
    tensors[QUERY][3, 5] = float("nan")


def infinite(tensors: Tensors) -> Tensors:
    return {n: t.bfloat16() for n, t in tensors.items()} | {PROJECTION: torch.full((24, 24), -float("inf")).bfloat16()}


def twice(tensors: Tensors) -> None:
    tensors["time_mlp_in.weight"] = tensors[PROJECTION].clone()


def as_pi0(tensors: Tensors) -> Tensors:
    plain = {
        n.replace("norm.dense.weight", "norm.weight"): t for n, t in tensors.items() if not n.endswith("dense.bias")
    }
    return pi0_names(plain) | {"state_proj.weight": torch.ones(24, 8)}


def a_layer_less(tensors: Tensors) -> Tensors:
    return {name: t for name, t in tensors.items() if "language_model.layers.2" not in name}


BAD = [
    (missing, f"lacks tensors: {QUERY}"),
    (missing_embedding, f"lacks tensors: model.{EMBEDDING}"),
    (extra, "has unknown tensors: model.stranger"),
    (transpose, "has wrong tensors: model.action_in_proj.weight (shape (8, 24), expected (24, 8))"),
    (shorten, f"has wrong tensors: {QUERY} (shape (63, 32), expected (64, 32))"),
    (integer, f"has wrong tensors: {PROJECTION} (dtype I32, expected one of"),
    (boolean, f"has wrong tensors: {QUERY} (dtype BOOL, expected one of"),
    (integer_head, f"has wrong tensors: model.{EMBEDDING} (dtype I64, expected one of"),
    (not_a_number, f"has NaN or infinity in {QUERY}: its training had failed"),
    (infinite, f"has NaN or infinity in {PROJECTION}"),
    (twice, "has time_mlp_in.weight twice"),
    (as_pi0, "is a π0, not a π0.5"),
    (a_layer_less, "does not have the sizes of paligemma_variant=tiny: its width and number of layers are 32 and 2"),
]  # fmt: skip


def assert_refused(source: Path, said: str, error: type[Exception] = ValueError) -> None:
    """One sentence that says this, and neither a checkpoint nor a leftover where it would have been."""
    before = folder_contents(source.parent)
    with pytest.raises(error) as caught:
        convert(source, source.parent / "output", GeometryStart(grid=2))
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
    assert folder_contents(source.parent) == before


@pytest.mark.parametrize(("change", "said"), BAD, ids=[change.__name__ for change, _ in BAD])
def test_a_bad_source_is_named(change, said, tmp_path):
    assert_refused(write_lerobot(tmp_path / "source", change), said)


@pytest.mark.parametrize("kept", [0.999, 0.5, 0.01, 0.0])
def test_a_truncated_file_is_named(kept, tmp_path):
    path = write_lerobot(tmp_path / "source") / WEIGHTS
    path.write_bytes(path.read_bytes()[: int(kept * path.stat().st_size)])
    assert_refused(path.parent, f"{path} is truncated or no safetensors file")


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"paligemma_variant": "small", "action_expert_variant": "small"}, "does not have the sizes of paligemma_variant=small"),
        ({"paligemma_variant": "gemma_2b", "action_expert_variant": "gemma_300m"}, "sizes of paligemma_variant=gemma_2b"),
        ({"paligemma_variant": "gemma_300m"}, "paligemma_variant must be one of"),
        ({"action_expert_variant": "small"}, "need the same depth"),
        ({"image_resolution": [56, 56]}, "position_embedding.weight (shape (4, 32), expected (16, 32))"),
        ({"max_action_dim": 7}, "action_in_proj.weight (shape (24, 8), expected (24, 7))"),
        ({"chunk_size": "many"}, "chunk_size"),
        ({"use_peft": True}, "PEFT"),
        ({"type": "pi0"}, "of type 'pi0', not 'pi05'"),
    ],
)  # fmt: skip
def test_settings_that_do_not_fit_are_named(settings, said, tmp_path):
    assert_refused(write_lerobot(tmp_path / "source", **settings), said)


def test_a_pi05_that_calls_itself_ours_is_refused(tmp_path):
    """By its tensors, or by settings that LeRobot's next release adds."""
    source = write_lerobot(tmp_path / "source", type="pi05_geometry")
    with pytest.raises(ValueError, match=r"has unknown tensors: .*lm_head|not valid for PI05GeometryConfig"):
        convert(source, tmp_path / "output", GeometryStart(grid=2))
    assert not (tmp_path / "output").exists()


def test_files_that_are_missing_are_named(tmp_path):
    source = write_lerobot(tmp_path / "source")
    state = next(source.glob("*_normalizer_processor.safetensors"))
    for name in (state.name, "policy_postprocessor.json", WEIGHTS):  # the first two fail when writing has begun
        (source / name).rename(tmp_path / "kept")
        assert_refused(source, f"{source} has no {name}", FileNotFoundError)
        (tmp_path / "kept").rename(source / name)
    convert(source, tmp_path / "output")


def test_a_processor_of_another_policy_is_named(tmp_path):
    source = write_lerobot(tmp_path / "source")
    path = source / "policy_preprocessor.json"
    path.write_text(path.read_text().replace("pi05_prepare_state_tokenizer_processor_step", "other"))
    assert_refused(source, "needs exactly one step 'pi05_prepare_state_tokenizer_processor_step'")
    path.write_text("{}")
    assert_refused(source, "is no processor pipeline")


def test_without_processors_they_are_made_anew(tmp_path, caplog):
    source = write_lerobot(tmp_path / "source")
    for path in source.glob("policy_*processor*"):
        path.unlink()
    convert(source, tmp_path / "output")
    assert "processors are made anew" in caplog.text
    assert list((tmp_path / "output").glob("*tokenizer.safetensors"))


def test_what_is_there_is_not_overwritten(lerobot_source, tmp_path):
    output = tmp_path / "output"
    for make in (lambda: output.mkdir(), lambda: (output.rmdir(), output.write_text("mine"))):
        make()
        with pytest.raises(FileExistsError, match=f"{output} exists already"):
            convert(lerobot_source, output)
    assert output.read_text() == "mine"
    assert folder_contents(tmp_path) == {"output"}


def test_a_full_disk_is_said_before_it_is(lerobot_source, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=1000))
    with pytest.raises(OSError, match=r"new/output needs .* GB, but its disk has 0.0 GB left"):
        convert(lerobot_source, tmp_path / "new" / "output")
    assert folder_contents(tmp_path) == set()


def test_a_failure_while_writing_leaves_nothing(lerobot_source, tmp_path, monkeypatch):
    def fail(*_):
        raise OSError("No space left on device")

    monkeypatch.setattr("lerobot_policy_pi05_geometry.checkpoint.conversion.to_ours.write_tensors", fail)
    with pytest.raises(OSError, match="No space left"):
        convert(lerobot_source, tmp_path / "a" / "b")
    assert folder_contents(tmp_path) == set()
