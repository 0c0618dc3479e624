"""Feature Token Modulation: a policy's visual tokens adapted to a new viewpoint with one demonstration.

One affine map of the visual tokens, F' = (1 + gamma) * F + beta with gamma and beta of the VLM's width, is trained while all
other weights stay fixed ("VLA Models Are More Generalizable Than You Think", arXiv 2512.02902; 4,096 numbers at the released
width). The tokens are the output of a linear projector, so the trained map is folded into its weight and bias.
"""

import itertools
from collections.abc import Iterator

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor, nn
from torch.utils.data import DataLoader

from ..checkpoint.load import LoadedPolicy
from ..model.vision import Projector
from .frames_in_memory import FramesInMemory

LEARNING_RATE = 1e-2  # not tuned


class ModulatedProjector(nn.Module):
    """A projector followed by the affine map. gamma, beta: (W,) float32, zero at the start."""

    def __init__(self, projector: Projector) -> None:
        super().__init__()
        self.projector = projector
        device = projector.linear.weight.device
        self.gamma = nn.Parameter(torch.zeros(projector.linear.out_features, device=device))
        self.beta = nn.Parameter(torch.zeros(projector.linear.out_features, device=device))

    def forward(self, features: Tensor) -> Tensor:
        tokens = self.projector(features)  # (N, patches, W)
        return ((1 + self.gamma) * tokens + self.beta).to(tokens.dtype)

    @torch.no_grad()
    def fold(self) -> Projector:
        """The projector with the affine map in its weight and bias."""
        linear = self.projector.linear
        linear.weight.copy_((1 + self.gamma)[:, None] * linear.weight)
        linear.bias.copy_((1 + self.gamma) * linear.bias + self.beta)
        return self.projector


def adapt(loaded: LoadedPolicy, dataset: LeRobotDataset, steps: int, batch_size: int, seed: int) -> None:
    """Adapt a policy in place to the episodes of a dataset, which has action chunks (`delta_timestamps`)."""
    policy = loaded.policy
    vlm = policy.model.paligemma_with_expert.paligemma.model
    trainable = [parameter.requires_grad for parameter in policy.parameters()]
    policy.requires_grad_(False)
    modulated = ModulatedProjector(vlm.multi_modal_projector)
    vlm.multi_modal_projector = modulated  # type: ignore[assignment]
    modulated.projector.requires_grad_(False)
    optimizer = torch.optim.AdamW([modulated.gamma, modulated.beta], lr=LEARNING_RATE, weight_decay=0.0)
    policy.train()
    for batch in itertools.islice(_batches(FramesInMemory(dataset), batch_size, seed), steps):
        loss, _ = policy(loaded.preprocess(batch))
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        policy.update()
    vlm.multi_modal_projector = modulated.fold()
    for parameter, requires_grad in zip(policy.parameters(), trainable, strict=True):
        parameter.requires_grad_(requires_grad)
    policy.eval()


def _batches(frames: FramesInMemory, batch_size: int, seed: int) -> Iterator[dict]:
    """Shuffled batches without end; the seed determines the order."""
    order = torch.Generator().manual_seed(seed)
    while True:
        yield from DataLoader(frames, batch_size=min(batch_size, len(frames)), shuffle=True, generator=order)
