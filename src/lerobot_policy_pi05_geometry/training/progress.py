"""The count of optimiser steps, as a module."""

import torch
from torch import Tensor, nn


class TrainingProgress(nn.Module):
    """The number of optimiser steps done. It is saved in the checkpoint: noise is keyed by it (model/flow_matching.py).

    It is a module, since PEFT saves modules only.
    """

    def __init__(self) -> None:
        super().__init__()
        self.step: Tensor
        self.register_buffer("step", torch.zeros((), dtype=torch.int64))
