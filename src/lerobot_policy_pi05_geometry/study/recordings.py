"""Expert episodes of a study: recorded once, and kept by what they depend on."""

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.utils.constants import ACTION, OBS_STATE

from ..data.quantiles import write_frame_quantiles
from ..sim.cameras import find_range
from ..sim.record import record
from ..sim.tasks import find_task
from .locks import folder_lock
from .runs import ReportProgress, short_hash, versions

PACKAGES = ("lerobot_policy_pi05_geometry", "lerobot", "torch", "mujoco", "metaworld")


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

    def description(self) -> dict[str, Any]:
        """Everything that the episodes depend on."""
        return {
            "task": asdict(find_task(self.task)),
            "cameras": asdict(find_range(self.cameras)),
            "episodes": self.episodes,
            "image_size": self.image_size,
            "seed": self.seed,
            "versions": versions(*PACKAGES),
        }

    @property
    def folder(self) -> Path:
        return self.root / "data" / f"{self.task}-{self.cameras}-{short_hash(self.description())}"

    @property
    def repo_id(self) -> str:
        return f"local/{self.task}"

    def make(self, report_progress: ReportProgress) -> None:
        """Record the episodes, unless the dataset exists. Several processes may call this at the same time."""
        with folder_lock(self.folder):
            if self.folder.exists():
                return
            progress = record(
                self.folder, self.repo_id, self.task, self.episodes, self.cameras, self.image_size, seed=self.seed
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
