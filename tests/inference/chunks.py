"""Chunks of the runner and the sampler, on tiny networks."""

from torch import Tensor

from lerobot_policy_pi05_geometry.inference.runner import ChunkRunner
from lerobot_policy_pi05_geometry.inference.sampler import ChunkSampler
from lerobot_policy_pi05_geometry.model import PI05Pytorch
from tests.model.helpers import Batch, Case


def fast(run: ChunkRunner | ChunkSampler, batch: Batch, num_steps: int = 3, **kwargs) -> Tensor:
    return run(
        *batch.observation,
        noise=batch.noise,
        num_steps=num_steps,
        geom_embs=batch.geom_embs,
        geom_pad=batch.geom_pad,
        **kwargs,
    )


def draw(network: PI05Pytorch, case: Case) -> Batch:
    batch = case.draw(network.geometry_width)
    return batch.without_geometry if network.config.geometry is None else batch
