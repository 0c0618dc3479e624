"""Differences between LeRobot 0.6.1 and its main branch (0.6.2), in one place. Delete this file when 0.6.1 goes.

What both versions accept is not here: `save_artifacts` of the tokenizer step (data/prompt.py) and `_fsdp_wrap_modules` of the
policy are asked for by 0.6.2 and ignored by 0.6.1. The comparison was made with LeRobot's commit 7427f318.
"""

import inspect
import logging
from collections.abc import Callable

from accelerate import Accelerator
from lerobot.configs.train import TrainPipelineConfig
from lerobot.scripts.lerobot_train import train

logger = logging.getLogger(__name__)


def train_with_accelerator(cfg: TrainPipelineConfig, make_accelerator: Callable[[], Accelerator]) -> None:
    """LeRobot's training loop with an accelerator of ours where it accepts one.

    0.6.1 takes the accelerator as an argument. 0.6.2 always builds its own: training then is the same, but without what the
    accelerator adds (frames kept in memory), and a warning says so.
    """
    if "accelerator" in inspect.signature(train).parameters:
        train(cfg, accelerator=make_accelerator())
        return
    logger.warning(
        "This version of LeRobot builds its own accelerator, so frames are read from disk in every step instead of being kept in "
        "memory; the samples are the same."
    )
    train(cfg)
