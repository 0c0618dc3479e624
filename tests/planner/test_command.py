"""The command: what it prints, what it refuses, and that it takes seconds and no memory at the released size."""

import json
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from lerobot_policy_pi05_geometry.geometry.da3 import VARIANTS
from lerobot_policy_pi05_geometry.planner.command import start_option
from lerobot_policy_pi05_geometry.planner.options import configuration, da3_variant, policy_options, typed
from pi05_geometry_cli import app
from pi05_geometry_cli.app import console

TINY = ["--policy.paligemma_variant=tiny", "--policy.action_expert_variant=tiny", "--policy.image_resolution=[28,28]"]
SHORT = ["--policy.gradient_checkpointing=true", "--policy.geometry_source=none"]


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    """Tables that break no words, whatever the width was when the console was made."""
    monkeypatch.setattr(console, "width", 200)


def test_a_part_of_a_setting_is_a_setting():
    options = policy_options([*TINY, "--policy.depth_augmentation.noise=0.01", "--policy.geometry_source=rgbd"])
    config = configuration(options)
    assert config.depth_augmentation.noise == 0.01
    assert typed(options, config)["depth_augmentation"] == config.depth_augmentation


def plan(*arguments: str) -> str:
    result = CliRunner().invoke(app, ["plan", *arguments])
    assert result.exit_code == 0, result.output + repr(result.exception)
    return " ".join(result.output.split())


def refused(*arguments: str) -> str:
    result = CliRunner().invoke(app, ["plan", *TINY, *arguments])
    assert result.exit_code == 1
    assert isinstance(result.exception, ValueError | FileNotFoundError)
    return str(result.exception)


def test_training_and_inference_side_by_side():
    shown = plan(*TINY, "--explain", "--image-size", "60x80", "--cameras", "3")
    for word in (
        "weights",
        "gradients",
        "optimiser",
        "activations",
        "cache",
        "peak",
        "GPU needed",
        "training",
        "inference",
    ):
        assert word in shown
    assert "60 x 80, 60 x 80, 60 x 80" in shown


def test_proposals_with_the_command_that_trains_them():
    shown = plan(*TINY, "--gpu", "8", "--batch_size", "4", "--proposals", "1", "--explain", "--policy.max_depth=7")
    assert "full fine-tuning" in shown
    told = "1. lerobot-train --policy.type=pi05_geometry --policy.dtype=bfloat16 --policy.paligemma_variant=tiny"
    assert told in shown
    assert "--policy.max_depth=7.0 --batch_size=4 ..." in shown
    assert "optimiser" in shown


def test_lora_starts_from_a_checkpoint_and_needs_less():
    pytest.importorskip("peft")
    shown = plan(*TINY, "--gpu", "8", "--proposals", "1", "--peft.r=3", "--policy.lora_targets=expert+vlm", *SHORT)
    assert "LoRA on VLM and expert" in shown
    assert "1. lerobot-train --policy.path=CHECKPOINT " in shown
    assert "--policy.lora_targets=expert+vlm" in shown
    assert "--peft.r=3 --batch_size=8" in shown


@pytest.mark.parametrize(
    ("path", "variant", "lora", "begins"),
    [
        (None, "small", False, "--policy.type=pi05_geometry"),
        (None, "small", True, "--policy.path=CHECKPOINT"),
        (None, "gemma_2b", False, "--policy.path=CHECKPOINT"),  # 2.9 billion random weights are nobody's wish
        ("mine", "gemma_2b", False, "--policy.path=mine"),
        ("mine", "small", False, "--policy.path=mine"),
    ],
)
def test_a_proposed_command_trains_random_weights_at_small_sizes_only(path, variant, lora, begins):
    assert start_option(path, variant, lora) == begins


def test_features_from_a_store_need_no_encoder_in_training():
    shown = plan(*TINY, "--policy.geometry_source=features")
    training, inference = shown.split("Depth Anything 3 │ ")[1].split(" │ ")[:2]
    assert (training, inference) == ("0.00", "0.16")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--gpu", "0.01"], "Nothing fits 0.0 GiB"),
        (["--gpu", "banana"], "'banana' is not a GPU that the planner knows"),
        (["--gpu", "24", "--policy.train_expert_only=true", "--peft.r=4"], "no recipe agrees with the given settings"),
        (["--peft.r=none"], "--peft.r must be a whole number from 1 on, got 'none'"),
        (["--peft.method_type=MISS"], "--peft.method_type=LORA only"),
        (["--peft.init_type=x"], "'--peft.init_type=x' cannot be planned"),
        (["--policy.lora_targets=all"], "--policy.lora_targets must be one of expert, expert+vlm"),
        (["--policy.optimizer=lion"], "--policy.optimizer must be one of adamw, adamw8bit"),
        (["--policy.speed=3"], "--policy.speed is not a setting of this policy"),
        (["--steps=3"], "'--steps=3' is not an option of this command"),
        (["--policy.type=act"], "--policy.type=pi05_geometry only"),
        (["--policy.dtype=float8"], "--policy.dtype must be one of"),
        (["--policy.chunk_size=many"], "A setting of the policy cannot be read"),
        (["--image-size", "big"], "height x width"),
        (["--policy.path=/nowhere"], "/nowhere"),
        (["--policy.geometry_source=da3", "--policy.da3_encoder=other/model"], "does not know the size of the encoder"),
    ],
)
def test_one_sentence_for_what_cannot_be(arguments, message):
    assert message in refused(*arguments)


def test_a_checkpoints_own_settings(tmp_path):
    from lerobot_policy_pi05_geometry.configuration_pi05_geometry import PI05GeometryConfig
    from tests.entry_points import make_config

    make_config(geometry_source="random")._save_pretrained(tmp_path)
    assert json.loads((tmp_path / "config.json").read_text())["type"] == PI05GeometryConfig.get_choice_name(
        PI05GeometryConfig
    )
    assert "30 x 40, 28 x 28" in plan(f"--policy.path={tmp_path}", "--explain", "--policy.chunk_size=9")


def test_a_proposal_says_what_the_checkpoint_has_otherwise(tmp_path):
    """What a checkpoint brings along stays unless it is said; what agrees with it is left out."""
    from tests.entry_points import make_config

    brought = {"dtype": "bfloat16", "param_dtype": "bfloat16", "train_expert_only": True, "optimizer": "adamw8bit"}
    make_config(geometry_source="none", gradient_checkpointing=True, **brought)._save_pretrained(tmp_path)
    shown = plan(f"--policy.path={tmp_path}", "--gpu", "8", "--proposals", "1")
    said = set(shown.split("lerobot-train ")[1].split())
    assert {f"--policy.path={tmp_path}", "--policy.param_dtype=float32", "--policy.train_expert_only=false"} <= said
    assert {"--policy.optimizer=adamw", "--policy.gradient_checkpointing=false"} <= said
    assert not {option for option in said if option.startswith(("--policy.dtype", "--policy.micro", "--policy.freeze"))}


@pytest.mark.parametrize("name", [n for n in VARIANTS if n != "tiny"])
def test_encoders_by_their_released_names(name):
    assert da3_variant(f"depth-anything/DA3-{name.upper()}") is VARIANTS[name]
    assert da3_variant("depth-anything/DA3METRIC-LARGE").name == "mono-large"


@pytest.mark.slow
def test_the_released_size_without_its_memory():
    """Peak resident set below 2 GiB, of which PyTorch and LeRobot have some 0.8, for a model of 12.5.

    By hand: 3.355 B parameters; AdamW keeps two moments of all but the 0.11 B that feed nothing.
    """
    program = (
        "import sys; sys.argv = ['pi05-geometry', 'plan', '--policy.gradient_checkpointing=true', '--batch_size=1'];"
        "from pi05_geometry_cli import app; app(standalone_mode=False);"
        "print('HWM', next(l.split()[1] for l in open('/proc/self/status') if l.startswith('VmHWM')))"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=600)
    shown, resident = result.stdout.split("HWM ")
    table = {row.split("│")[1].strip(): row.split("│")[2].strip() for row in shown.splitlines() if row.count("│") == 4}
    assert (table["weights"], table["gradients"], table["optimiser"]) == ("12.50", "12.09", "24.18")
    assert int(resident) < 2 * 2**20


@pytest.mark.parametrize(
    "options",
    [
        ["--policy.geometry_cameras=[front]"],
        ["--policy.geometry_cameras=[front]", "--policy.geometry_source=rays"],
        ["--policy.geometry_cameras=[camera1]", "--policy.geometry_source=rays"],
        ["--policy.geometry_source=rays"],
        ["--policy.geometry_source=da3", "--policy.geometry_cameras=[front, side, wrist]"],
        ["--policy.geometry_source=da3", "--policy.geometry_tokens=rays"],
    ],
    ids=lambda options: " ".join(options),
)
def test_what_can_be_trained_can_be_planned(options):
    """The data of a plan is made up, so it has the cameras and the calibration that the settings ask for."""
    assert "peak" in plan(*TINY, *options)


def test_the_calibration_of_cameras_that_are_made_up_is_not_read():
    """It stays in the command that trains."""
    given = "--policy.calibration_path=of_my_robot.json"
    assert "peak" in plan(*TINY, given)
    assert given in plan(*TINY, given, "--gpu", "8", "--proposals", "1")
