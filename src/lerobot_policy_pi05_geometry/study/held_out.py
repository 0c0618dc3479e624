"""A run on a user's dataset: trained on some episodes, and its action chunks compared with those of the others.

There is no simulator and no robot, so the result is an open-loop error, not a success rate. A policy may act well along
another path than the recorded one, and small errors may add up to failure. The error measures how well recorded actions are
predicted.
"""

import logging
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, OBS_STATE
from torch.utils.data import default_collate

from ..checkpoint.load import LoadedPolicy, load_policy
from ..dataset_folder import require_dataset
from ..geometry.keys import DEPTH_SUFFIX, find_depth_key, is_depth_key
from .arms import DEPTH, blind_inputs, find_arm, refuse_from_scratch
from .locks import folder_lock
from .own_data import Split, dataset_identity, depth_cameras, geometry_cameras, split_episodes
from .runs import ReportProgress, Run, option_list, versions
from .training import train_with
from .warm_start import make_start, remaining_options

logger = logging.getLogger(__name__)

ALL_CAMERAS, NO_DEPTH, ONLY = "all-cameras", "no-depth", "only-"
_NOISE_SEED = 0  # the noise that a chunk starts from depends on the episode only, so it is the same for every arm


@dataclass(frozen=True)
class HeldOutRun(Run):
    """An arm on a user's dataset.

    dataset_root, repo_id: the dataset. options: further options of lerobot-train. held_out: share of each task's
    episodes, the last ones, for evaluation only. frames: evaluated frames of each held-out episode, evenly spaced. pi05: the
    π0.5 that it starts from, converted for the arm, a folder or hub id; None trains from scratch.
    """

    dataset_root: Path
    repo_id: str
    options: tuple[tuple[str, str], ...]
    training_steps: int
    held_out: float
    frames: int
    pi05: str | None = None

    @property
    def name(self) -> str:
        return f"{self.dataset_root.name}-{self.arm_name}-{self.seed}"

    @property
    def steps(self) -> int:
        return self.training_steps - (0 if self.before is None else self.before.training_steps)

    @cached_property
    def before(self) -> "HeldOutRun | None":
        """The run with the first half of the steps, if the arm has one; this run trains it, and goes on from its policy."""
        if self.arm.after is None:
            return None
        return replace(self, arm_name=self.arm.after, conditions=(), training_steps=self.training_steps // 2)

    @cached_property
    def evaluation_size(self) -> int:
        return self.frames * self.split.held_out

    @cached_property
    def split(self) -> Split:
        """Which episodes are trained on and which held out, in numbers."""
        return split_episodes(self.dataset_root, self.repo_id, self.held_out, dict(self.options))

    def description(self) -> dict[str, Any]:
        return {
            "arm": self.arm_name,
            "arguments": self.arguments(Path("output"), Path("start")),
            **({} if self.before is None else {"before": self.before.description()}),
            "pi05": None if self.pi05 is None else _description_of(self.pi05),
            "dataset": dataset_identity(self.dataset_root, dict(self.options)),
            "versions": versions("lerobot_policy_pi05_geometry", "lerobot", "torch"),
        }

    def evaluation_description(self, condition: str) -> dict[str, Any]:
        return {"condition": condition, "frames": self.frames}

    def distinct_conditions(self) -> list[str]:
        return list(self.conditions) if DEPTH in self.arm.reads else [ALL_CAMERAS]

    @property
    def start(self) -> Path:
        """The converted checkpoint that it starts from, while it is needed: at the released size it takes gigabytes."""
        return self.folder / "start"

    def prepare(self, report_progress: ReportProgress) -> None:
        """Convert the π0.5 or the policy that it starts from. The dataset exists."""
        if self.checkpoint.exists():
            return
        source = self.pi05
        if self.before is not None:
            with folder_lock(self.before.folder):
                self.before.prepare(report_progress)
                self.before.train_missing()
            source = str(self.before.checkpoint)
        if source is not None:
            cameras = geometry_cameras(self.dataset_root, self.repo_id, self._options())
            make_start(source, self.start, self._options(), cameras, self.seed)

    def train(self, output: Path) -> None:
        videos = LeRobotDatasetMetadata(self.repo_id, root=self.dataset_root).video_keys
        train_with(self.arguments(output, self.start), in_memory=not videos)
        shutil.rmtree(self.start, ignore_errors=True)

    def arguments(self, output: Path, start: Path) -> list[str]:
        """lerobot-train's arguments. start: the converted π0.5, if there is one.

        The arm's options and the study's settings override the user's options.
        """
        options = self._options()
        if self.pi05 is None and self.before is None:
            begin: dict[str, Any] = {"policy.type": "pi05_geometry", **options}
        else:
            begin = {"policy.path": start, **remaining_options(options)}
        return option_list(
            {
                **begin,
                "policy.push_to_hub": "false",
                "num_workers": options.get("num_workers", 0),
                "dataset.repo_id": self.repo_id,
                "dataset.root": self.dataset_root,
                "dataset.eval_split": self.held_out,
                "steps": self.steps,
                "save_freq": self.steps,
                "log_freq": self.log_every,
                "seed": self.seed,
                "output_dir": output,
            }
        )

    def _options(self) -> dict[str, str]:
        return {**self._users_options(), **self.arm.options, **self._blind_inputs()}

    def _users_options(self) -> dict[str, str]:
        """The user's options, without augmentation of depth for arms that measure none, or none in the base frame."""
        options, source = dict(self.options), self.arm.options.get("policy.geometry_source", "rgbd")
        if source != "rgbd":
            unused: tuple[str, ...] = ("",)
        else:
            unused = ("shift", "turn") if self.arm.options.get("policy.geometry_frame") == "camera" else ()
        prefixes = tuple(f"policy.depth_augmentation.{name}" for name in unused)
        return {name: value for name, value in options.items() if not (prefixes and name.startswith(prefixes))}

    def _blind_inputs(self) -> dict[str, str]:
        """Inputs of the blind arm, with this dataset's state size."""
        if not self.arm.blind:
            return {}
        features = LeRobotDatasetMetadata(self.repo_id, root=self.dataset_root).features
        if OBS_STATE not in features:
            raise ValueError(
                f"{self.dataset_root} has no {OBS_STATE}, so a blind policy has no input; leave that arm out."
            )
        return blind_inputs(features[OBS_STATE]["shape"])

    def evaluate(self, condition: str, report_progress: ReportProgress) -> None:
        config = TrainPipelineConfig.from_pretrained(self.checkpoint)
        _, dataset = make_train_eval_datasets(config)
        assert dataset is not None  # held_out is above 0
        loaded = load_policy(self.checkpoint, str(config.trainable_config.device))
        errors = action_errors(
            loaded, dataset, condition, self.frames, lambda done, n: report_progress(condition, done, n)
        )
        unfinished = self.folder / "unfinished.npz"
        np.savez_compressed(unfinished, errors=errors)
        unfinished.replace(self.outcome(condition))

    def errors(self, condition: str) -> np.ndarray | None:
        """Mean error per held-out episode, horizon step and action dimension, (E, S, D); None before evaluation."""
        path = self.outcome(condition if DEPTH in self.arm.reads else ALL_CAMERAS)
        if not path.exists():
            return None
        with np.load(path, allow_pickle=False) as file:
            return file["errors"]


def from_json(content: dict[str, Any]) -> HeldOutRun:
    """The run that `to_json` wrote."""
    return HeldOutRun(
        Path(content["root"]),
        content["arm_name"],
        content["seed"],
        tuple(content["conditions"]),
        Path(content["dataset_root"]),
        content["repo_id"],
        tuple((name, value) for name, value in content["options"]),
        content["training_steps"],
        content["held_out"],
        content["frames"],
        content["pi05"],
    )


def held_out_runs(
    output: Path,
    dataset_root: Path,
    repo_id: str,
    arms: Sequence[str],
    seeds: Sequence[int],
    options: Mapping[str, str],
    steps: int,
    held_out: float,
    frames: int,
    pi05: str | None = None,
) -> list[HeldOutRun]:
    """Every run of a study on a user's dataset, seed by seed.

    pi05: the π0.5 to start from, folder or hub id; None trains from scratch.
    Raises FileNotFoundError if there is no dataset, and ValueError if arms or settings do not fit it.
    """
    require_dataset(dataset_root)
    for name, values in (("arms", arms), ("seeds", seeds)):
        if not values or len(set(values)) < len(values):
            raise ValueError(
                f"--{name} must name at least one of them, and each once, got {', '.join(map(str, values))}."
            )
    for name, count, least in (("seeds", min(seeds), 0), ("steps", steps, 1), ("frames", frames, 1)):
        if count < least:
            raise ValueError(f"--{name} must be at least {least}, got {count}.")
    if options.get("dataset.streaming", "false").lower() != "false":
        raise ValueError("A study cannot stream its dataset, whose episodes it divides; leave --dataset.streaming out.")
    if options.get("save_checkpoint", "true").lower() != "true":
        raise ValueError("A study evaluates the checkpoints that it trains; leave --save_checkpoint out.")
    if not 0 < held_out < 1:
        raise ValueError(f"The share of held-out episodes must be between 0 and 1, got {held_out}.")
    for name in arms:
        if find_arm(name).cameras != "train" or find_arm(name).adapts is not None:
            raise ValueError(f"Arm '{name}' needs other camera poses in its data, which only the simulator has.")
        if pi05 is not None:
            refuse_from_scratch(name)
        if (first := find_arm(name).after) is not None and steps < 2:
            raise ValueError(f"Arm '{name}' has half of its steps from arm '{first}', so --steps must be at least 2.")
    split = split_episodes(dataset_root, repo_id, held_out, options)
    if split.untrained:
        logger.warning(
            "Every episode of %s is held out, so no policy is trained on it; record more of it, or leave it out with "
            "--dataset.episodes.", ", ".join(f"'{task}'" for task in split.untrained),
        )  # fmt: skip
    if pi05 is not None and Path(pi05).is_dir():
        pi05 = str(Path(pi05).absolute())
    views = view_conditions(dataset_root, repo_id, options)
    if len(views) == 1 and any(DEPTH in find_arm(name).reads for name in arms):
        raise ValueError(
            f"{dataset_root} has no depth (observation.images.<camera>{DEPTH_SUFFIX}), which arm 'geometry' and its variants "
            "read; record depth, name its key by --policy.depth_keys, or choose other --arms."
        )
    return [
        HeldOutRun(
            output.absolute(), arm, seed, tuple(views), dataset_root.absolute(), repo_id, tuple(options.items()), steps,
            held_out, frames, pi05,
        )
        for seed in seeds
        for arm in arms
    ]  # fmt: skip


def view_conditions(root: Path, repo_id: str, options: Mapping[str, str] = {}) -> list[str]:
    """Conditions for an arm with depth: all depth cameras that it reads, each one alone, and none."""
    cameras = depth_cameras(root, repo_id, options)
    single = [f"{ONLY}{camera}" for camera in cameras] if len(cameras) > 1 else []
    return [ALL_CAMERAS, *single, NO_DEPTH] if cameras else [ALL_CAMERAS]


def _description_of(checkpoint: str) -> list[Any]:
    """What a checkpoint is known by: its name and, of a folder, the sizes and times of its files."""
    files = sorted(Path(checkpoint).glob("*.*")) if Path(checkpoint).is_dir() else []
    return [checkpoint, *((file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files)]


def hide_depth(batch: dict[str, Any], condition: str, depth_keys: Mapping[str, str]) -> dict[str, Any]:
    """The batch with the depth of all cameras but the condition's set to zero (no measurement); images stay, whatever their name.

    batch: images channel-first, as a dataset gives them. depth_keys: of the policy's configuration.
    """
    if condition == ALL_CAMERAS:
        return batch
    only = condition.startswith(ONLY)
    kept = find_depth_key(condition.removeprefix(ONLY), batch, depth_keys) if only else None
    return {
        key: torch.zeros_like(value) if _is_depth(key, value, depth_keys) and key != kept else value
        for key, value in batch.items()
    }


def _is_depth(key: str, value: Any, depth_keys: Mapping[str, str]) -> bool:
    """Whether a batch entry is depth, and not a depth map that was turned into colours, (..., 3, H, W)."""
    return is_depth_key(key, depth_keys) and value.shape[-3] != 3


@torch.no_grad()
def action_errors(
    loaded: LoadedPolicy,
    dataset: LeRobotDataset,
    condition: str,
    frames: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> np.ndarray:
    """Mean absolute error of predicted actions, in the dataset's units, (E, S, D); NaN where every episode has ended.

    One chunk is predicted at each of `frames` evenly spaced frames of every episode of the dataset.
    """
    episode_of = np.asarray(dataset.hf_dataset["episode_index"])
    episodes = np.unique(episode_of)
    policy, means = loaded.policy, []
    for number, episode in enumerate(episodes):
        rows = np.flatnonzero(episode_of == episode)
        chosen = rows[np.unique(np.linspace(0, len(rows) - 1, frames).astype(int))]
        batch = default_collate([dataset[int(row)] for row in chosen])
        actions, is_pad = batch[ACTION], batch["action_is_pad"]  # (N, S, D), (N, S)
        observation = {k: v for k, v in batch.items() if not k.startswith(ACTION)}
        shape = (len(chosen), policy.config.chunk_size, policy.config.max_action_dim)
        noise = torch.randn(shape, generator=torch.Generator().manual_seed(_NOISE_SEED + int(episode)))
        policy.reset()
        chunk = policy.predict_action_chunk(
            loaded.preprocess(hide_depth(observation, condition, policy.config.depth_keys)),
            noise=noise.to(policy.config.device),
        )
        predicted = torch.stack([loaded.postprocess(step) for step in chunk.unbind(1)], dim=1)  # (N, S, D)
        error = (predicted.cpu() - actions).abs().masked_fill(is_pad[..., None], float("nan"))
        means.append(error.nanmean(dim=0).numpy())
        progress(number + 1, len(episodes))
    return np.stack(means)
