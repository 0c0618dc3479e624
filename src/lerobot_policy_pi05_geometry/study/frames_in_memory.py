"""LeRobot's training with a small dataset kept in memory.

Reading one sample of a LeRobotDataset of images decodes the images of the whole action chunk: 17 ms for a chunk of 8,
which on two cores is as long as a training step. Here every frame is decoded once and chunks are cut from the table of
actions. The samples are LeRobot's, bit for bit; the training loop is LeRobot's own, which takes the accelerator that
prepares its data loader as an argument.
"""

from functools import partial

import torch
from accelerate import Accelerator
from accelerate.utils import DistributedDataParallelKwargs
from lerobot.configs import parser
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts.lerobot_train import train
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from ..compat import train_with_accelerator
from ..precompute.augmentation import refuse_augmentation


class FramesInMemory(Dataset):
    """The samples of a LeRobotDataset that has action chunks and no observation history, each frame decoded once."""

    def __init__(self, dataset: LeRobotDataset) -> None:
        deltas = dataset.delta_timestamps or {}
        if set(deltas) != {"action"} or dataset.image_transforms is not None or dataset.meta.video_keys:
            raise ValueError(
                "Frames can be kept in memory for datasets of images, with chunks of actions alone and no image "
                "transforms; use lerobot-train for this one."
            )
        self._steps = torch.tensor([round(seconds * dataset.meta.fps) for seconds in deltas["action"]])
        self._frames = LeRobotDataset(
            dataset.repo_id,
            root=dataset.root,
            episodes=dataset.episodes,
            return_uint8=True,
            depth_output_unit=dataset.depth_output_unit,
        )
        columns = self._frames.hf_dataset.select_columns(["action", "episode_index"])[:]
        self._actions = torch.stack(columns["action"])  # (frames, action_dim)
        episode = torch.stack(columns["episode_index"])
        _, lengths = episode.unique_consecutive(return_counts=True)
        self._ends = lengths.cumsum(0).repeat_interleave(lengths)  # of each frame's episode
        self._starts = self._ends - lengths.repeat_interleave(lengths)
        self._cache: dict[int, dict] = {}

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> dict:
        if index not in self._cache:
            self._cache[index] = self._frames[index]
        wanted = index + self._steps
        there = wanted.clamp(self._starts[index], self._ends[index] - 1)  # LeRobot repeats the episode's last action
        return {**self._cache[index], "action": self._actions[there], "action_is_pad": there != wanted}


class InMemoryAccelerator(Accelerator):
    """An accelerator whose data loaders read from memory."""

    def prepare_data_loader(self, data_loader: DataLoader, *args, **kwargs) -> DataLoader:
        loader: DataLoader[dict[str, Tensor]] = DataLoader(
            FramesInMemory(data_loader.dataset),
            batch_size=data_loader.batch_size,
            sampler=data_loader.sampler,
            collate_fn=data_loader.collate_fn,
            drop_last=data_loader.drop_last,
        )
        return super().prepare_data_loader(loader, *args, **kwargs)


@parser.wrap()
def train_in_memory(cfg: TrainPipelineConfig) -> None:
    """`lerobot-train`, with the same arguments, for a dataset whose frames fit into memory.

    With image transforms every sample is another image, so LeRobot reads it from disk. Raises ValueError for a streamed dataset.
    """
    if cfg.dataset.streaming:
        raise ValueError(
            "The frames of a streamed dataset cannot be kept in memory; leave --dataset.streaming out, or use lerobot-train."
        )
    cfg.validate()
    refuse_augmentation(cfg)
    if cfg.dataset.image_transforms.enable:
        train(cfg)
        return
    train_with_accelerator(cfg, partial(_make_accelerator, cfg))


def _make_accelerator(cfg: TrainPipelineConfig) -> InMemoryAccelerator:
    policy = cfg.trainable_config
    precision = {"bfloat16": "bf16", "float16": "fp16"}.get(getattr(policy, "dtype", ""), "no")
    return InMemoryAccelerator(
        step_scheduler_with_optimizer=False,
        mixed_precision=precision,
        kwargs_handlers=[DistributedDataParallelKwargs(find_unused_parameters=True)],
        cpu=policy.device == "cpu",
    )
