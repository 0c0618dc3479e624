"""The steps of the demo. Each leaves a finished file or folder behind and is skipped when that is there already."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from ..loading import load_policy
from ..sim.configuration import MetaworldRgbdEnv
from ..sim.evaluate import Evaluation, evaluate
from ..sim.record import record

ARMS = {
    "geometry": "RGB, and a geometry segment from depth",
    "rgb": "RGB only: plain π0.5",
    "blind": "no camera at all, the floor that every figure is read against",
}
CONDITIONS = {
    "train": "camera within the training range",
    "outside": "camera outside the training range",
}
_STATE_ONLY = '{"observation.state": {"type": "STATE", "shape": [4]}}'


@dataclass(frozen=True)
class DemoSettings:
    """What the demo does. docs/results.md says how long the defaults took."""

    task: str = "button-press-topdown-wide"
    variant: str = "small"
    episodes: int = 120
    steps: int = 1000
    blind_steps: int = 500
    batch_size: int = 16
    learning_rate: float = 2e-3
    flow_samples: int = 4
    chunk_size: int = 8
    action_steps: int = 4
    image_size: int = 84
    evaluation_episodes: int = 50
    parallel: int = 10
    videos: int = 3
    seed: int = 0


Progress = Callable[[str, int, int], None]  # step's name, done, total


def run_demo(folder: Path, settings: DemoSettings, progress: Progress) -> dict[str, dict[str, Evaluation]]:
    """Record, train three policies, evaluate each under both conditions. Returns evaluations by arm and condition."""
    folder.mkdir(parents=True, exist_ok=True)
    _keep_settings(folder, settings)
    dataset = folder / "dataset"
    if not dataset.exists():
        episodes = record(dataset, "local/demo", settings.task, settings.episodes, image_size=settings.image_size)
        for done, _ in episodes:
            progress("record expert episodes", done, settings.episodes)
    for arm in ARMS:
        train_arm(folder, arm, settings, partial(progress, f"train {arm}"))
    results: dict[str, dict[str, Evaluation]] = {arm: {} for arm in ARMS}
    for condition in CONDITIONS:
        environment = MetaworldRgbdEnv(task=settings.task, cameras=condition, image_size=settings.image_size)
        for arm in ARMS:
            saved = folder / f"evaluation_{arm}_{condition}.npz"
            if not saved.exists():
                evaluate(
                    load_policy(checkpoint(folder, arm), environment=environment),
                    environment,
                    settings.evaluation_episodes,
                    parallel=settings.parallel,
                    videos=settings.videos,
                    progress=_of(partial(progress, f"evaluate {arm}, {condition}"), settings.evaluation_episodes),
                ).save(saved)
            results[arm][condition] = Evaluation.load(saved)
    return results


def _of(progress: Callable[[int, int], None], total: int) -> Callable[[int], None]:
    return lambda done: progress(done, total)


def _keep_settings(folder: Path, settings: DemoSettings) -> None:
    """A folder belongs to one set of settings: mixing two would mislabel what is already there."""
    path = folder / "settings.json"
    wanted = json.dumps(asdict(settings), indent=2)
    if not path.exists():
        path.write_text(wanted)
    elif path.read_text() != wanted:
        raise ValueError(f"{folder} holds a demo with other settings; choose another --output, or remove it.")


def checkpoint(folder: Path, arm: str) -> Path:
    """Where an arm's trained policy stands."""
    return folder / arm / "checkpoints" / "last" / "pretrained_model"


def arguments(folder: Path, arm: str, settings: DemoSettings) -> list[str]:
    """lerobot-train's arguments for an arm."""
    steps = settings.blind_steps if arm == "blind" else settings.steps
    options = {
        "policy.type": "pi05_geometry",
        "policy.device": "cpu",
        "policy.push_to_hub": "false",
        "policy.paligemma_variant": settings.variant,
        "policy.action_expert_variant": settings.variant,
        "policy.image_resolution": f"[{settings.image_size}, {settings.image_size}]",
        "policy.geometry_source": "rgbd" if arm == "geometry" else "none",
        "policy.chunk_size": settings.chunk_size,
        "policy.n_action_steps": settings.action_steps,
        "policy.max_action_dim": 4,
        "policy.num_inference_steps": 5,
        "policy.flow_samples": settings.flow_samples,
        "policy.optimizer_lr": settings.learning_rate,
        "policy.scheduler_decay_lr": settings.learning_rate / 20,
        "policy.scheduler_warmup_steps": 50,
        "policy.scheduler_decay_steps": steps,
        "dataset.repo_id": "local/demo",
        "dataset.root": folder / "dataset",
        "batch_size": settings.batch_size,
        "steps": steps,
        "num_workers": 0,
        "log_freq": max(1, steps // 60),
        "save_freq": steps,
        "seed": settings.seed,
        "output_dir": folder / arm,
    }
    if arm == "blind":
        options["policy.input_features"] = _STATE_ONLY
    return [f"--{name}={value}" for name, value in options.items()]


def train_arm(folder: Path, arm: str, settings: DemoSettings, progress: Callable[[int, int], None]) -> None:
    """Train one arm through LeRobot's training in a process of its own, its log beside it."""
    if checkpoint(folder, arm).exists():
        return
    output, log = folder / arm, folder / f"{arm}.log"
    shutil.rmtree(output, ignore_errors=True)  # what is left of a training that was cut off, made anew in minutes
    command = [sys.executable, "-m", "lerobot_policy_pi05_geometry.cli", "train", *arguments(folder, arm, settings)]
    total = settings.blind_steps if arm == "blind" else settings.steps
    environment = {**os.environ, "HF_HUB_OFFLINE": "1"}
    with log.open("w", buffering=1) as file:
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment, bufsize=1
        )
        assert process.stdout is not None
        for line in process.stdout:
            file.write(line)
            step = read_log_line(line)
            if step is not None:
                progress(step["step"], total)
        if process.wait() != 0:
            raise RuntimeError(f"Training '{arm}' failed; its last words are in {log}.")


def read_log_line(line: str) -> dict | None:
    """Step and loss of a line of LeRobot's training log; None for any other line."""
    if " step:" not in line or " loss:" not in line:
        return None
    fields = dict(entry.split(":", 1) for entry in line.split(" step:", 1)[1].split()[1:] if ":" in entry)
    digits = line.split(" step:", 1)[1].split()[0]
    scale = {"K": 1_000, "M": 1_000_000}.get(digits[-1], 1)
    return {"step": int(float(digits.rstrip("KM")) * scale), "loss": float(fields["loss"])}


def read_curve(folder: Path, arm: str) -> dict[str, list[float]]:
    """Training loss of an arm, from its log."""
    points = [p for p in map(read_log_line, (folder / f"{arm}.log").read_text().splitlines()) if p]
    return {"step": [p["step"] for p in points], "loss": [p["loss"] for p in points]}
