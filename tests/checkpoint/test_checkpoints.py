"""A checkpoint loads whole or not at all, and the error says what is wrong with it."""

import json
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from lerobot_policy_pi05_geometry.weight_files.files import find_file, find_optional_file, new_folder
from lerobot_policy_pi05_geometry.weight_files.strict_load import load_strictly
from tests.entry_points import make_policy

Tensors = dict[str, torch.Tensor]

ADAPTER = "geometry.adapter.fc_in.weight"
PROJECTION = "model.action_in_proj.weight"
STEP = "progress.step"


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    """The folder of a good checkpoint."""
    folder = tmp_path_factory.mktemp("checkpoint")
    make_policy(seed=1).save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def policy() -> PI05GeometryPolicy:
    """A policy with other weights than the checkpoint's."""
    return make_policy(seed=2)


def copy_of(saved: Path, tmp_path: Path, change: Callable[[Tensors], None]) -> Path:
    """A copy of the checkpoint whose tensors were changed."""
    folder = shutil.copytree(saved, tmp_path / "changed")
    tensors = load_file(folder / "model.safetensors")
    change(tensors)
    save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, folder / "model.safetensors")
    return folder


def assert_refused(folder: Path, policy: PI05GeometryPolicy, *said: str) -> None:
    """Both ways in refuse the checkpoint with one sentence that says all this, and leave the policy as it was."""
    before = {name: tensor.clone() for name, tensor in policy.state_dict().items()}
    identities = {name: id(parameter) for name, parameter in policy.named_parameters()}
    for load in (
        lambda: load_strictly(policy, folder / "model.safetensors"),
        lambda: PI05GeometryPolicy.from_pretrained(folder),
    ):
        with pytest.raises(ValueError) as caught:  # noqa: PT011
            load()
        message = str(caught.value)
        assert "\n" not in message
        for words in (str(folder / "model.safetensors"), *said):
            assert words in message
    assert {name: id(parameter) for name, parameter in policy.named_parameters()} == identities
    for name, tensor in policy.state_dict().items():
        assert torch.equal(tensor, before[name]), name


def test_a_good_checkpoint_replaces_every_tensor(saved):
    target, source = make_policy(seed=2), make_policy(seed=1)
    target.training_step.add_(5)
    load_strictly(target, saved / "model.safetensors")
    for name, tensor in target.state_dict().items():
        assert torch.equal(tensor, source.state_dict()[name]), name
    assert all(isinstance(parameter, torch.nn.Parameter) for parameter in target.parameters())
    assert {n: p.requires_grad for n, p in target.named_parameters()} == {
        n: p.requires_grad for n, p in source.named_parameters()
    }


def test_tensors_are_cast_to_the_dtype_they_are_stored_in(saved, tmp_path):
    folder = copy_of(saved, tmp_path, lambda tensors: tensors.update({PROJECTION: tensors[PROJECTION].double()}))
    target = make_policy(seed=2, dtype="bfloat16", param_dtype="bfloat16")
    dtypes = {name: parameter.dtype for name, parameter in target.named_parameters()}
    load_strictly(target, folder / "model.safetensors")
    assert {name: parameter.dtype for name, parameter in target.named_parameters()} == dtypes
    stored = load_file(saved / "model.safetensors")
    for name, parameter in target.named_parameters():
        assert torch.equal(parameter, stored[name].to(parameter.dtype)), name


def test_a_loaded_policy_does_not_follow_its_file(saved, tmp_path):
    """Weights that stayed mapped to the file would change, or crash, with whatever is written there next."""
    folder = shutil.copytree(saved, tmp_path / "copy")
    loaded = PI05GeometryPolicy.from_pretrained(folder)
    before = {name: tensor.clone() for name, tensor in loaded.state_dict().items()}
    size = (folder / "model.safetensors").stat().st_size
    with (folder / "model.safetensors").open("r+b") as file:
        file.write(b"\xff" * size)
    for name, tensor in loaded.state_dict().items():
        assert torch.equal(tensor, before[name]), name


def test_a_missing_tensor_is_named(saved, tmp_path, policy):
    folder = copy_of(saved, tmp_path, lambda tensors: tensors.pop(ADAPTER))
    assert_refused(folder, policy, f"lacks tensors: {ADAPTER}", "nothing was loaded")


def test_an_extra_tensor_is_named(saved, tmp_path, policy):
    folder = copy_of(saved, tmp_path, lambda tensors: tensors.update(stranger=torch.zeros(3)))
    assert_refused(folder, policy, "has unknown tensors: stranger", "nothing was loaded")


def test_many_tensors_are_counted_and_not_all_named(saved, tmp_path, policy):
    folder = copy_of(
        saved, tmp_path, lambda tensors: tensors.update({f"stranger{i}": torch.zeros(1) for i in range(9)})
    )
    assert_refused(folder, policy, "stranger0, stranger1, stranger2, stranger3, stranger4 and 4 more")


def test_a_wrong_shape_is_named(saved, tmp_path, policy):
    rows, columns = policy.state_dict()[PROJECTION].shape
    folder = copy_of(saved, tmp_path, lambda tensors: tensors.update({PROJECTION: tensors[PROJECTION][:-1]}))
    assert_refused(folder, policy, f"{PROJECTION} (shape ({rows - 1}, {columns}), expected ({rows}, {columns}))")


def test_a_transposed_tensor_is_named(saved, tmp_path, policy):
    rows, columns = policy.state_dict()[PROJECTION].shape
    folder = copy_of(saved, tmp_path, lambda tensors: tensors.update({PROJECTION: tensors[PROJECTION].T}))
    assert_refused(folder, policy, f"{PROJECTION} (shape ({columns}, {rows}), expected ({rows}, {columns}))")


def test_an_integer_tensor_for_a_weight_is_named(saved, tmp_path, policy):
    folder = copy_of(saved, tmp_path, lambda tensors: tensors.update({PROJECTION: tensors[PROJECTION].int()}))
    assert_refused(folder, policy, f"{PROJECTION} (dtype I32, expected torch.float32)")


def test_a_float_for_a_counter_is_named(saved, tmp_path, policy):
    folder = copy_of(saved, tmp_path, lambda tensors: tensors.update({STEP: tensors[STEP].float()}))
    assert_refused(folder, policy, f"{STEP} (dtype F32, expected torch.int64)")


@pytest.mark.parametrize("kept", [0.999, 0.5, 0.01, 0.0])
def test_a_truncated_file_is_refused(saved, tmp_path, policy, kept):
    folder = shutil.copytree(saved, tmp_path / "truncated")
    content = (saved / "model.safetensors").read_bytes()
    (folder / "model.safetensors").write_bytes(content[: int(kept * len(content))])
    assert_refused(folder, policy, "is truncated or no safetensors file")


@pytest.mark.parametrize(
    "content", [b"not a checkpoint", b"PK\x03\x04" + bytes(5000), b"\xff" * 100], ids=["text", "zip", "ones"]
)
def test_what_is_no_safetensors_file_is_refused(saved, tmp_path, policy, content):
    folder = shutil.copytree(saved, tmp_path / "other")
    (folder / "model.safetensors").write_bytes(content)
    assert_refused(folder, policy, "is truncated or no safetensors file")


@pytest.mark.parametrize("name", ["model.safetensors", "config.json"])
def test_a_missing_file_is_named(saved, tmp_path, name):
    folder = shutil.copytree(saved, tmp_path / "incomplete")
    (folder / name).unlink()
    with pytest.raises(FileNotFoundError, match=rf"{folder} has no {name}"):
        PI05GeometryPolicy.from_pretrained(folder)


def test_a_missing_folder_is_named(tmp_path):
    for folder in (tmp_path / "nowhere", "./nowhere"):
        with pytest.raises(FileNotFoundError, match=r"Checkpoint folder .*nowhere does not exist"):
            PI05GeometryPolicy.from_pretrained(folder)


def test_another_policy_type_is_refused(saved, tmp_path):
    folder = shutil.copytree(saved, tmp_path / "pi05")
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"type": "pi05"}))
    with pytest.raises(ValueError, match=rf"{folder} is a checkpoint of type 'pi05', not 'pi05_geometry'") as caught:
        PI05GeometryPolicy.from_pretrained(folder)
    assert f"pi05-geometry convert {folder} OUTPUT" in str(caught.value)
    (folder / "config.json").write_text(json.dumps(config | {"type": "act"}))
    with pytest.raises(ValueError, match="is a checkpoint of type 'act'") as caught:
        PI05GeometryPolicy.from_pretrained(folder)
    assert "convert" not in str(caught.value)


@pytest.mark.parametrize("content", ["", "{", "[]"], ids=["empty", "cut", "list"])
def test_a_config_that_is_no_json_object_is_refused(saved, tmp_path, content):
    folder = shutil.copytree(saved, tmp_path / "broken")
    (folder / "config.json").write_text(content)
    with pytest.raises(ValueError, match=r"config.json"):
        PI05GeometryPolicy.from_pretrained(folder)


def test_geometry_settings_that_do_not_fit_the_weights_are_refused(saved):
    """The grid is part of the adapter's shape."""
    config = make_policy(geometry_grid=4).config
    with pytest.raises(ValueError, match=r"geometry.adapter.column \(shape \(3, 24\), expected \(4, 24\)\)"):
        PI05GeometryPolicy.from_pretrained(saved, config=config)


def test_a_file_is_found_in_its_folder(saved):
    assert find_file(saved, "config.json") == saved / "config.json"
    assert find_file(str(saved), "model.safetensors") == saved / "model.safetensors"


def test_a_file_that_may_be_missing(saved, tmp_path):
    assert find_optional_file(saved, "config.json") == saved / "config.json"
    assert find_optional_file(saved, "other.json") is None
    with pytest.raises(FileNotFoundError, match="nowhere does not exist"):
        find_optional_file(tmp_path / "nowhere", "config.json")


@pytest.mark.parametrize("error", [None, RuntimeError, KeyboardInterrupt])
def test_a_new_folder_appears_whole_or_not_at_all(tmp_path, error):
    output = tmp_path / "a" / "b" / "output"
    (tmp_path / "a").mkdir()
    raised = pytest.raises(error) if error else nullcontext()
    with raised, new_folder(output, 10) as folder:
        (folder / "file").write_text("content")
        assert not output.exists()
        if error:
            raise error
    if error:
        assert list((tmp_path / "a").iterdir()) == []
    else:
        assert [path.name for path in output.parent.iterdir()] == ["output"]
        assert (output / "file").read_text() == "content"
        assert output.stat().st_mode & 0o777 == 0o755


def test_a_folder_that_is_there_is_left_alone(tmp_path):
    with pytest.raises(FileExistsError, match=f"{tmp_path} exists already"), new_folder(tmp_path, 0):
        pass
    assert tmp_path.is_dir()
