"""LeRobot's training entry point, called from a run."""

import sys

from lerobot.configs import parser
from lerobot.configs.train import TrainPipelineConfig
from lerobot.scripts.lerobot_train import train

from ..precompute.augmentation import refuse_augmentation
from .frames_in_memory import train_in_memory


def train_with(arguments: list[str], in_memory: bool = True) -> None:
    """Train in this process with lerobot-train's arguments; LeRobot parses the command line itself.

    in_memory: keep decoded frames in memory (frames_in_memory.py), or read them from disk as LeRobot does.
    """
    sys.argv = ["lerobot-train", *arguments]
    (train_in_memory if in_memory else train_from_disk)()


@parser.wrap()
def train_from_disk(cfg: TrainPipelineConfig) -> None:
    """`lerobot-train` with the same arguments, after checks that need the whole configuration."""
    cfg.validate()
    refuse_augmentation(cfg)
    train(cfg)
