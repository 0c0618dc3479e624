"""Expert episodes of a study: recorded once, and kept by what they depend on."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.utils.constants import ACTION, OBS_STATE

from ..data.quantiles import write_frame_quantiles
from .locks import folder_lock
from .runs import ReportProgress, file_name, short_hash, versions
from .simulated_tasks import SimulatedTask, simulated_task


@dataclass(frozen=True)
class Recording:
    """Expert episodes of one task: <root>/data/<task>-<cameras>-<hash>/.

    cameras: range of camera poses. image_size: pixels per side. seed: another seed records other episodes.
    """

    root: Path
    task: str
    cameras: str
    episodes: int
    image_size: int
    seed: int = 0

    @cached_property
    def simulated(self) -> SimulatedTask:
        return simulated_task(self.task)

    def description(self) -> dict[str, Any]:
        """Everything that the episodes depend on."""
        return {
            "task": self.simulated.description(),
            "cameras": self.simulated.camera_description(self.cameras),
            "episodes": self.episodes,
            "image_size": self.image_size,
            "seed": self.seed,
            "versions": versions(*self.simulated.packages),
        }

    @property
    def folder(self) -> Path:
        return self.root / "data" / f"{file_name(self.task)}-{self.cameras}-{short_hash(self.description())}"

    @property
    def repo_id(self) -> str:
        return f"local/{file_name(self.task)}"

    def make(self, report_progress: ReportProgress) -> None:
        """Record the episodes, unless the dataset exists. Several processes may call this at the same time."""
        with folder_lock(self.folder):
            if self.folder.exists():
                return
            progress = self.simulated.record(
                self.folder, self.repo_id, self.episodes, self.cameras, self.image_size, self.seed
            )
            for done, _ in progress:
                report_progress(f"record {self.task}", done, self.episodes)


def merge_recordings(recordings: Sequence[Recording], folder: Path, repo_id: str) -> None:
    """Write one dataset with the episodes of several recordings, unless it exists. They have the same calibration."""
    with folder_lock(folder):
        if folder.exists():
            return
        unfinished = folder.with_name(f".{folder.name}.unfinished")
        shutil.rmtree(unfinished, ignore_errors=True)
        aggregate_datasets(
            [recording.repo_id for recording in recordings],
            repo_id,
            roots=[recording.folder for recording in recordings],
            aggr_root=unfinished,
            concatenate_data=False,  # files are kept, not rewritten
        )
        write_frame_quantiles(unfinished, repo_id, (OBS_STATE, ACTION))
        unfinished.rename(folder)
