"""The RGB frames of a LeRobotDataset, batch by batch, in order, without the rest of a sample."""

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import groupby
from operator import itemgetter

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.video_utils import decode_video_frames
from torch import Tensor

_TOLERANCE = 1e-4  # seconds between a frame's time and the video's, LeRobot's default


class Frames:
    """Images of some keys of a dataset, by dataset index.

    Frames of one episode and video are decoded together, which is several times faster than one by one.
    """

    def __init__(self, dataset: LeRobotDataset, keys: Sequence[str]) -> None:
        self._dataset, self._keys = dataset, list(keys)
        self._videos = [key for key in keys if key in dataset.meta.video_keys]
        self._images = [key for key in keys if key not in self._videos]
        columns = ["index", "episode_index", "timestamp", *self._images]
        self._rows = dataset.hf_dataset.select_columns(columns)

    def read(self, frames: range) -> dict[str, Tensor]:
        """Images (B, 3, H, W) per key: float32 in [0, 1] of stored images, uint8 of videos.

        Raises ValueError if the dataset lacks one of the frames.
        """
        rows = self._rows[frames.start : min(frames.stop, len(self._rows))]
        found = [int(i) for i in rows["index"]]
        if found != list(frames):
            wanted = next((i for i, j in zip(frames, found, strict=False) if i != j), frames.start + len(found))
            raise ValueError(
                f"The dataset {self._dataset.root} lacks frame {wanted}: its tables have other frames there than "
                f"0 to {self._dataset.meta.total_frames - 1} in order; download it whole, or repair it."
            )
        images = {key: torch.stack(rows[key]) for key in self._images}
        episodes = [int(i) for i in rows["episode_index"]]
        times = [float(t) for t in rows["timestamp"]]
        for key in self._videos:
            images[key] = self._decode(key, episodes, times)
        return {key: images[key] for key in self._keys}

    def _decode(self, key: str, episodes: list[int], times: list[float]) -> Tensor:
        parts = []
        for episode, rows in groupby(zip(episodes, times, strict=True), key=itemgetter(0)):
            start = self._dataset.meta.episodes[episode][f"videos/{key}/from_timestamp"]
            wanted = [start + time for _, time in rows]
            path = self._dataset.root / self._dataset.meta.get_video_file_path(episode, key)
            parts.append(decode_video_frames(path, wanted, _TOLERANCE, return_uint8=True))
        return torch.cat(parts)

    def read_ahead(self, batches: Iterable[range]) -> Iterator[tuple[range, dict[str, Tensor]]]:
        """Every batch with its images. The next batch is read while the caller processes this one."""
        with ThreadPoolExecutor(max_workers=1) as pool:
            pending = None
            for batch in batches:
                reading = batch, pool.submit(self.read, batch)
                if pending is not None:
                    yield pending[0], pending[1].result()
                pending = reading
            if pending is not None:
                yield pending[0], pending[1].result()
