"""LeRobot's own commands on a recorded dataset: train, stop, resume, evaluate. Each is a process of its own."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from lerobot_policy_pi05_geometry.checkpoint.conversion import convert
from lerobot_policy_pi05_geometry.geometry.da3.weights import backbone_hash
from lerobot_policy_pi05_geometry.sim.record import record
from tests import commands
from tests.geometry.da3.tiny import write_tiny

from ..checkpoint.conversion.sources import write_lerobot

pytestmark = [pytest.mark.train, pytest.mark.sim]

SIZE = 28


def lerobot(command: str, *arguments: str) -> str:
    """Run `lerobot-train` or `lerobot-eval` without a hub; returns what it logged."""
    return commands.run(f"lerobot.scripts.lerobot_{command}", *arguments)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    """Four short expert episodes."""
    root = tmp_path_factory.mktemp("data") / "tiny"
    list(record(root, "local/tiny", "button-press-topdown-wide", episodes=4, image_size=SIZE))
    return root


@pytest.fixture(scope="module")
def trained(dataset, tmp_path_factory) -> tuple[Path, str]:
    """The output folder of 6 uninterrupted steps, saved after 3 and 6, and the log."""
    output = tmp_path_factory.mktemp("train") / "run"
    return output, lerobot("train", *arguments(dataset, output, steps=6))


def arguments(dataset: Path, output: Path, steps: int) -> list[str]:
    """What to train, saved half way and at the end."""
    return [
        "--policy.type=pi05_geometry",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--policy.paligemma_variant=tiny",
        "--policy.action_expert_variant=tiny",
        f"--policy.image_resolution=[{SIZE},{SIZE}]",
        "--policy.geometry_grid=4",
        "--policy.chunk_size=6",
        "--policy.n_action_steps=3",
        "--policy.num_inference_steps=2",
        "--policy.max_action_dim=4",
        "--policy.optimizer_lr=1e-3",
        "--policy.scheduler_warmup_steps=2",
        "--dataset.repo_id=local/tiny",
        f"--dataset.root={dataset}",
        "--dataset.eval_split=0.25",
        "--eval_steps=3",
        "--max_eval_samples=4",
        f"--output_dir={output}",
        f"--steps={steps}",
        f"--save_freq={steps // 2}",
        "--log_freq=1",
        "--batch_size=4",
        "--num_workers=0",
        "--wandb.enable=false",
    ]


def tensors(folder: Path) -> dict[str, torch.Tensor]:
    """Every tensor of a checkpoint, by file and name, but for the generators: training draws nothing from them."""
    found = {}
    for path in sorted(set(folder.rglob("*.safetensors")) - set(folder.rglob("rng_state.safetensors"))):
        found.update({f"{path.relative_to(folder)}:{name}": tensor for name, tensor in load_file(path).items()})
    return found


def test_training_moves_every_trainable_weight_and_counts_its_steps(trained):
    checkpoints = trained[0] / "checkpoints"
    before = load_file(checkpoints / "000003" / "pretrained_model" / "model.safetensors")
    after = load_file(checkpoints / "000006" / "pretrained_model" / "model.safetensors")
    assert (before["progress.step"], after["progress.step"]) == (3, 6)
    for name in ("model.action_in_proj.weight", "geometry.adapter.fc_in.weight"):
        assert not torch.equal(before[name], after[name]), name
    assert all(tensor.isfinite().all() for tensor in after.values())


def test_the_held_out_loss_is_logged(trained):
    assert trained[1].count("eval_loss") >= 2


def test_the_checkpoint_is_complete(trained):
    """Calibration, depth keys and tokenizer are inside; neither the dataset nor a hub is needed."""
    folder = trained[0] / "checkpoints" / "last" / "pretrained_model"
    config = json.loads((folder / "config.json").read_text())
    assert config["calibration"]["front"]["size"] == [SIZE, SIZE]
    assert set(config["geometry_features"]) == {
        "observation.images.front_depth",
        "observation.calibration.front.extrinsics",
    }
    assert "observation.images.front_depth" not in config["input_features"]
    assert list(folder.glob("*pi05_geometry_tokenizer.safetensors"))


def test_resuming_equals_never_having_stopped_bit_for_bit(trained, tmp_path):
    checkpoints = trained[0] / "checkpoints"
    shutil.move(checkpoints / "000006", tmp_path / "uninterrupted")
    (checkpoints / "last").unlink()
    config = checkpoints / "000003" / "pretrained_model" / "train_config.json"
    lerobot("train", f"--config_path={config}", "--resume=true")
    expected, found = tensors(tmp_path / "uninterrupted"), tensors(checkpoints / "000006")
    assert any("optimizer_state" in name for name in expected)
    assert found.keys() == expected.keys()
    for name, tensor in expected.items():
        assert torch.equal(found[name], tensor), name
    for name in ("scheduler_state.json", "optimizer_param_groups.json"):
        file = Path("training_state") / name
        assert (checkpoints / "000006" / file).read_text() == (tmp_path / "uninterrupted" / file).read_text(), name


def test_a_checkpoint_is_evaluated_in_the_environment(trained, tmp_path):
    moved = shutil.copytree(trained[0] / "checkpoints" / "000003" / "pretrained_model", tmp_path / "moved")
    lerobot(
        "eval",
        f"--policy.path={moved}",
        "--policy.device=cpu",
        "--env.type=metaworld_rgbd",
        f"--env.image_size={SIZE}",
        "--env.episode_length=3",
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        "--eval.use_async_envs=false",
        f"--output_dir={tmp_path / 'evaluation'}",
    )
    info = json.loads((tmp_path / "evaluation" / "eval_info.json").read_text())
    assert info["overall"]["n_episodes"] == 2
    assert info["overall"]["pc_success"] in (0.0, 50.0, 100.0)


def assert_resumes_bit_for_bit(dataset: Path, folder: Path, *options: str) -> Path:
    """Two steps, and one step resumed for another, leave the same tensors behind. Returns the last checkpoint."""
    output = folder / "run"
    lerobot("train", *arguments(dataset, output, steps=2), *options)
    checkpoints = output / "checkpoints"
    shutil.move(checkpoints / "000002", folder / "uninterrupted")
    (checkpoints / "last").unlink()
    lerobot("train", f"--config_path={checkpoints / '000001/pretrained_model/train_config.json'}", "--resume=true")
    expected, found = tensors(folder / "uninterrupted"), tensors(checkpoints / "000002")
    assert any("optimizer_state" in name for name in expected)
    assert found.keys() == expected.keys()
    for name, tensor in expected.items():
        assert torch.equal(found[name], tensor), name
    return checkpoints / "000002"


def test_eight_bits_and_micro_batches_are_trained_and_resumed_bit_for_bit(dataset, tmp_path):
    pytest.importorskip("torchao")
    last = assert_resumes_bit_for_bit(dataset, tmp_path, "--policy.optimizer=adamw8bit", "--policy.micro_batch_size=3")
    assert any(name.endswith("exp_avg_codes") for name in tensors(last))


def test_lora_is_trained_and_resumed_bit_for_bit(trained, dataset, tmp_path):
    """The noise is keyed by a count of steps, which is saved among the adapters."""
    pytest.importorskip("peft")
    base = shutil.copytree(trained[0] / "checkpoints" / "000003" / "pretrained_model", tmp_path / "base")
    options = [a for a in arguments(dataset, tmp_path / "run", 2) if not a.startswith("--policy.")]
    options += ["--policy.device=cpu", "--policy.push_to_hub=false", f"--policy.path={base}", "--peft.r=4"]
    lerobot("train", *options)
    checkpoints = tmp_path / "run" / "checkpoints"
    shutil.move(checkpoints / "000002", tmp_path / "uninterrupted")
    (checkpoints / "last").unlink()
    lerobot("train", f"--config_path={checkpoints / '000001/pretrained_model/train_config.json'}", "--resume=true")
    expected, found = tensors(tmp_path / "uninterrupted"), tensors(checkpoints / "000002")
    assert found.keys() == expected.keys()
    (step,) = (tensor for name, tensor in found.items() if name.endswith("progress.step"))
    assert step == load_file(base / "model.safetensors")["progress.step"] + 2
    for name, tensor in expected.items():
        assert torch.equal(found[name], tensor), name
    lerobot(
        "eval",
        f"--policy.path={checkpoints / '000002' / 'pretrained_model'}",
        "--policy.device=cpu",
        "--env.type=metaworld_rgbd",
        f"--env.image_size={SIZE}",
        "--env.episode_length=2",
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        "--eval.use_async_envs=false",
        f"--output_dir={tmp_path / 'evaluation'}",
    )


def test_geometry_from_rgb_is_trained_and_resumed_bit_for_bit(dataset, tmp_path):
    encoder = write_tiny(tmp_path / "encoder" / "model.safetensors").parent
    rgb = ["--policy.geometry_source=da3", f"--policy.da3_encoder={encoder}", "--policy.da3_image_size=56"]
    last = assert_resumes_bit_for_bit(dataset, tmp_path, *rgb)
    config = json.loads((last / "pretrained_model" / "config.json").read_text())
    assert config["da3_hash"] == backbone_hash(encoder / "model.safetensors")


@pytest.mark.parametrize("from_data", [False, True])
def test_a_converted_pi05_trains_on_depth_that_it_has_never_seen(dataset, tmp_path, from_data):
    """Depth cameras, calibration and statistics come from the data; cameras and state too, if they are left to it."""
    front = {"type": "VISUAL", "shape": [3, SIZE, SIZE]}
    state = {"type": "STATE", "shape": [7]}
    source = write_lerobot(
        tmp_path / "pi05", input_features={"observation.images.front": front, "observation.state": state}
    )
    converted = tmp_path / "converted"
    convert(source, converted, features_from_data=from_data)
    log = lerobot(
        "train",
        f"--policy.path={converted}",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--dataset.repo_id=local/tiny",
        f"--dataset.root={dataset}",
        f"--output_dir={tmp_path / 'run'}",
        "--steps=2",
        "--save_freq=2",
        "--log_freq=1",
        "--batch_size=4",
        "--num_workers=0",
        "--wandb.enable=false",
    )
    assert "gate_openness_pct" in log
    folder = tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"
    config = json.loads((folder / "config.json").read_text())
    assert config["geometry_pending"] == 0
    assert set(config["geometry_features"]) == {
        "observation.images.front_depth",
        "observation.calibration.front.extrinsics",
    }
    assert config["calibration"]["front"]["size"] == [SIZE, SIZE]
    before, after = load_file(converted / "model.safetensors"), load_file(folder / "model.safetensors")
    assert after["progress.step"] == 2
    for name in ("geometry.adapter.fc_in.weight", "model.paligemma_with_expert.geometry_gate.openness"):
        assert not torch.equal(before[name], after[name]), name
    statistics = load_file(next(folder.glob("*preprocessor*_normalizer_processor.safetensors")))
    assert "observation.state.q99" in statistics
