"""Chunks of every shape that a policy meets, recorded before the first one is needed.

Where chunks are recorded (on a GPU), every length that a prompt can have needs a recording of its own. Made in the middle of an
episode, it would hold the robot up.
"""

from typing import NamedTuple

import torch

from ..model.config import RunnerName
from ..model.segments import GeometryTokens
from .cuda_graphs import PROMPT_STEP
from .sampler import ChunkSampler
from .side_stream import PendingGeometry


class ChunkShapes(NamedTuple):
    """Shapes of a chunk's inputs: images (batch, 3, side, side) of the cameras that are present, geometry (batch, tokens, width),
    prompts of at most longest_prompt tokens, noise (batch, steps, action_dim). geometry_tokens: 0 without geometry. The flow is
    integrated in denoising_steps.
    """

    batch: int
    present: tuple[bool, ...]
    side: int
    geometry_tokens: int
    geometry_width: int
    longest_prompt: int
    steps: int
    action_dim: int
    denoising_steps: int


@torch.no_grad()
def warm_up(sampler: ChunkSampler, runner: RunnerName, shapes: ChunkShapes, device: torch.device) -> None:
    """Build the runner; where it records chunks, record one of every prompt length, unless it is there. Draws no random number.

    Nothing is done where the plain path serves.
    """
    declined = sampler.prepare(runner, shapes.denoising_steps) is not None
    if declined or not sampler.records(runner):
        return
    batch, geometry = shapes.batch, None
    if shapes.geometry_tokens:
        embs = torch.zeros(batch, shapes.geometry_tokens, shapes.geometry_width, device=device)
        blank = GeometryTokens(embs, torch.zeros(batch, shapes.geometry_tokens, dtype=torch.bool, device=device))
        geometry = PendingGeometry(shapes.geometry_tokens, lambda: blank)
    image = torch.zeros(batch, 3, shapes.side, shapes.side, device=device)
    images = [image if there else None for there in shapes.present]
    masks = [torch.full((batch,), there, device=device) for there in shapes.present]
    noise = torch.zeros(batch, shapes.steps, shapes.action_dim, device=device)
    lengths = prompt_lengths(shapes.longest_prompt)
    sampler.reserve(len(lengths) + 1)
    for length in lengths:
        text = torch.zeros(batch, length, dtype=torch.int64, device=device)
        observation = images, masks, text, torch.ones_like(text, dtype=torch.bool)
        inputs = {"noise": noise, "geometry": geometry, "num_steps": shapes.denoising_steps}
        if not sampler.has_recorded(*observation, **inputs):
            sampler(*observation, **inputs, runner=runner)


def prompt_lengths(longest: int) -> range:
    """Lengths that prompts of at most `longest` tokens are padded to where chunks are recorded."""
    return range(PROMPT_STEP, longest + PROMPT_STEP, PROMPT_STEP)
