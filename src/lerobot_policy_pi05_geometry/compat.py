"""Differences between LeRobot 0.6.1 and its main branch (0.6.2), in one place. Delete this file when 0.6.1 goes.

What both versions accept is not here: `save_artifacts` of the tokenizer step (data/tokenizer.py) and `_fsdp_wrap_modules` of the
policy are asked for by 0.6.2 and ignored by 0.6.1. The comparison was made with LeRobot's commit 7427f318.
"""

import inspect
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING

from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.rtc.modeling_rtc import RTCProcessor

if TYPE_CHECKING:
    from accelerate import Accelerator
    from lerobot.configs.train import TrainPipelineConfig

logger = logging.getLogger(__name__)


def train_with_accelerator(cfg: "TrainPipelineConfig", make_accelerator: "Callable[[], Accelerator]") -> None:
    """LeRobot's training loop with an accelerator of ours where it accepts one.

    0.6.1 takes the accelerator as an argument. 0.6.2 always builds its own: training then is the same, but without what the
    accelerator adds (frames kept in memory), and a warning says so.
    """
    from lerobot.scripts.lerobot_train import (
        train,  # here, since the configuration imports this module and training is slow to import
    )

    if "accelerator" in inspect.signature(train).parameters:
        train(cfg, accelerator=make_accelerator())
        return
    logger.warning(
        "This version of LeRobot builds its own accelerator, so frames are read from disk in every step instead of being kept in "
        "memory; the samples are the same."
    )
    train(cfg)


def mode_of(rtc: RTCConfig | None) -> str | None:
    """How real-time chunking continues a chunk, "guided" or "trained"; None for 0.6.1, whose RTCConfig does not say it."""
    return getattr(rtc, "mode", None)


def rtc_config_of(mode: str) -> RTCConfig:
    """LeRobot's default real-time chunking in a mode, "guided" or "trained", which 0.6.1's RTCConfig cannot say."""
    return RTCConfig(mode=mode) if "mode" in RTCConfig.__dataclass_fields__ else RTCConfig()


def make_rtc_processor(rtc: RTCConfig, trained: bool) -> RTCProcessor:
    """LeRobot's processor for real-time chunking. trained: whether the policy can do trained RTC, which 0.6.2 asks for."""
    return RTCProcessor(rtc) if mode_of(rtc) is None else RTCProcessor(rtc, trained_mode_supported=trained)
