"""A checkpoint in the simulator: success per seed, and frames of some episodes."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.envs import preprocess_observation
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import NEW_ROLLOUT_OPTION
from scipy.stats import binomtest

from ..checkpoint.load import LoadedPolicy

CONFIDENCE = 0.95


@dataclass
class Evaluation:
    """Outcome per seed, and frames of the first episodes, each (steps, H, W, 3) uint8."""

    seeds: list[int] = field(default_factory=list)
    successes: list[bool] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    videos: list[np.ndarray] = field(default_factory=list)

    @property
    def rate(self) -> float:
        """Share of episodes that succeeded."""
        return float(np.mean(self.successes))

    def interval(self) -> tuple[float, float]:
        """95 % Wilson interval of the success rate."""
        interval = binomtest(sum(self.successes), len(self.successes)).proportion_ci(CONFIDENCE, method="wilson")
        return float(interval.low), float(interval.high)

    def save(self, path: Path) -> None:
        """Write outcomes and videos to one file, atomically."""
        unfinished = path.with_suffix(".unfinished.npz")
        videos = {f"video_{i}": video for i, video in enumerate(self.videos)}
        np.savez_compressed(unfinished, seeds=self.seeds, successes=self.successes, steps=self.steps, **videos)  # type: ignore[arg-type]
        unfinished.replace(path)

    @classmethod
    def load(cls, path: Path) -> "Evaluation":
        """Read what `save` wrote."""
        with np.load(path, allow_pickle=False) as file:
            videos = [file[name] for name in sorted(name for name in file.files if name.startswith("video_"))]
            return cls(file["seeds"].tolist(), file["successes"].tolist(), file["steps"].tolist(), videos)

    def to_json(self) -> dict[str, Any]:
        """Everything but the videos."""
        low, high = self.interval()
        return {
            "success_rate": self.rate,
            "interval_95": [low, high],
            "episodes": len(self.seeds),
            "per_episode": [
                {"seed": seed, "success": success, "steps": steps}
                for seed, success, steps in zip(self.seeds, self.successes, self.steps, strict=True)
            ],
        }


def evaluate(
    loaded: LoadedPolicy,
    environment: EnvConfig,
    episodes: int,
    first_seed: int = 0,
    parallel: int = 10,
    videos: int = 0,
    progress: Callable[[int], None] = lambda done: None,
) -> Evaluation:
    """Run `episodes` episodes of an environment with one task on the seeds first_seed, first_seed + 1, ...

    The sampler's noise is seeded per batch of episodes, so that an evaluation is reproducible. parallel: episodes stepped
    together. videos: number of first episodes whose frames are kept. progress: called with the number of finished
    episodes.
    """
    result = Evaluation()
    parallel = min(parallel, episodes)
    ((vector,),) = (tasks.values() for tasks in environment.create_envs(parallel).values())
    try:
        for start in range(0, episodes, parallel):
            seeds = [first_seed + start + i for i in range(parallel)]
            torch.manual_seed(seeds[0])
            success, steps, frames = _rollout(loaded, vector, seeds, keep_frames=len(result.videos) < videos)
            count = min(parallel, episodes - start)
            result.seeds += seeds[:count]
            result.successes += success[:count].tolist()
            result.steps += steps[:count].tolist()
            for i in range(min(count, videos - len(result.videos))):
                result.videos.append(np.stack([frame[i] for frame in frames[: steps[i] + 1]]))
            progress(len(result.seeds))
    finally:
        vector.close()
    return result


def _rollout(
    loaded: LoadedPolicy, vector: Any, seeds: list[int], keep_frames: bool
) -> tuple[np.ndarray, np.ndarray, list]:
    """Run one batch of episodes to their ends: success and number of steps per episode, and all frames."""
    loaded.policy.reset()
    observation, _ = vector.reset(seed=seeds, options={NEW_ROLLOUT_OPTION: True})
    done = np.zeros(len(seeds), dtype=bool)
    success = np.zeros(len(seeds), dtype=bool)
    steps = np.zeros(len(seeds), dtype=int)
    frames = [vector.call("render")] if keep_frames else []
    while not done.all():
        batch = preprocess_observation(observation)
        batch["task"] = list(vector.call("task_description"))
        with torch.inference_mode():
            action = loaded.postprocess(loaded.policy.select_action(loaded.preprocess(batch)))
        observation, _, terminated, truncated, _ = vector.step(action.numpy())
        steps += ~done
        success |= terminated & ~done
        done |= terminated | truncated
        if keep_frames:
            frames.append(vector.call("render"))
    return success, steps, frames
