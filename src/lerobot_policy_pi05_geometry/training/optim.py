"""What `--policy.optimizer` chooses among: LeRobot's AdamW, or AdamW with its two moments in 8 bits."""

import importlib.util
from dataclasses import asdict, dataclass

from lerobot.optim import AdamWConfig, OptimizerConfig
from lerobot.optim.optimizers import OptimizerParams
from torch.optim import Optimizer

OPTIMIZERS = ("adamw", "adamw8bit")


@OptimizerConfig.register_subclass("adamw8bit")
@dataclass
class AdamW8bitConfig(AdamWConfig):
    """AdamW whose moments take 2 bytes per parameter instead of 8 (`adamw8bit.py`)."""

    def build(self, params: OptimizerParams) -> Optimizer:
        """Raises ImportError if torchao is not installed."""
        if importlib.util.find_spec("torchao") is None:
            raise ImportError(
                "--policy.optimizer=adamw8bit needs torchao, which is not installed; install it with "
                "`pip install 'lerobot_policy_pi05_geometry[adamw8bit]'`, or use --policy.optimizer=adamw."
            )
        from .adamw8bit import AdamW8bit

        settings = asdict(self)
        settings.pop("grad_clip_norm")
        return AdamW8bit(params, **settings)
