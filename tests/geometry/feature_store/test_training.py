"""The commands: precompute by two ranks, lerobot-train from the store, stopped and resumed. Each is a process of its own."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from lerobot_policy_pi05_geometry.geometry.da3.weights import backbone_hash
from tests import commands
from tests.datasets import REPO_ID, write_dataset
from tests.geometry.da3.tiny import write_tiny
from tests.geometry.feature_store.test_shards import files

pytestmark = pytest.mark.train

SIZE = 28


def ours(*arguments: str, code: int = 0, **environment: str) -> str:
    return commands.run("pi05_geometry_cli.__main__", *arguments, code=code, **environment)


def training(root: Path, output: Path) -> list[str]:
    return [
        "--policy.type=pi05_geometry",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--policy.paligemma_variant=tiny",
        "--policy.action_expert_variant=tiny",
        f"--policy.image_resolution=[{SIZE},{SIZE}]",
        "--policy.geometry_source=features",
        "--policy.geometry_grid=3",
        "--policy.chunk_size=4",
        "--policy.n_action_steps=2",
        "--policy.max_action_dim=8",
        f"--dataset.repo_id={REPO_ID}",
        f"--dataset.root={root}",
        "--dataset.eval_split=0.34",
        "--eval_steps=2",
        f"--output_dir={output}",
        "--steps=2",
        "--save_freq=1",
        "--log_freq=1",
        "--batch_size=4",
        "--num_workers=0",
        "--wandb.enable=false",
    ]


def test_computed_by_two_ranks_then_trained_and_resumed_bit_for_bit(tmp_path):
    root = write_dataset(tmp_path / "data", size=SIZE)
    encoder = write_tiny(tmp_path / "encoder" / "model.safetensors").parent
    options = [f"--dataset.root={root}", f"--encoder={encoder}", "--grid=3", "--image-size=42", "--device=cpu"]
    options += ["--shard-frames=8", "--batch-size=3"]
    ours("precompute", *options, RANK="1", WORLD_SIZE="2")
    told = ours("precompute", *options, "--verify", RANK="0", WORLD_SIZE="2")
    assert "26 frames x 2 camera(s) x 9 cells x 64 features" in told
    ours("precompute", *options, f"--output={tmp_path / 'alone'}")
    (shared,), (alone,) = (root / "geometry").glob("[!.]*"), (tmp_path / "alone").glob("[!.]*")
    assert files(shared) == files(alone)

    output = tmp_path / "run"
    log = commands.run("lerobot.scripts.lerobot_train", *training(root, output))
    assert "eval_loss" in log
    checkpoints = output / "checkpoints"
    config = json.loads((checkpoints / "last" / "pretrained_model" / "config.json").read_text())
    assert config["da3_encoder"] == str(encoder)
    assert config["da3_hash"] == backbone_hash(encoder / "model.safetensors")
    assert config["da3_image_size"] == 42
    shutil.move(checkpoints / "000002", tmp_path / "uninterrupted")
    (checkpoints / "last").unlink()
    resumed = checkpoints / "000001" / "pretrained_model" / "train_config.json"
    commands.run("lerobot.scripts.lerobot_train", f"--config_path={resumed}", "--resume=true")
    expected = load_file(tmp_path / "uninterrupted" / "pretrained_model" / "model.safetensors")
    found = load_file(checkpoints / "000002" / "pretrained_model" / "model.safetensors")
    assert found.keys() == expected.keys()
    for name, tensor in expected.items():
        assert torch.equal(found[name], tensor), name

    augmented = [*training(root, tmp_path / "augmented"), "--dataset.image_transforms.enable=true"]
    assert "cannot be augmented" in ours("train", *augmented, code=1)
