"""Tiny networks with random weights, random observations, and slow but obvious references.

A freshly built network hides errors: adaRMS weights start at zero, so the flow time has no effect, and so do gates. So
every test runs on a network whose parameters were all drawn anew (`randomise`).
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import torch
from hypothesis import strategies as st
from torch import Tensor, nn

from lerobot_policy_pi05_geometry.model import (
    GeometrySegmentConfig,
    NetworkConfig,
    PI05Pytorch,
    Segment,
    SegmentKVCache,
)
from lerobot_policy_pi05_geometry.model.segment_mask import segment_mask
from lerobot_policy_pi05_geometry.model.segments import segment_positions
from lerobot_policy_pi05_geometry.model.variants import EXPERT_VARIANTS, PALIGEMMA_VARIANTS

IMAGE_SIZE = 28  # four patches
ACTION_DIM = 6
VOCABULARY = PALIGEMMA_VARIANTS["tiny"].vocab_size
DRAWN_ONCE = 97  # seed of the weights of `shared_network`

SEGMENT = GeometrySegmentConfig()
PARALLEL = GeometrySegmentConfig(positions="parallel")
IN_PREFIX = GeometrySegmentConfig(placement="prefix")
OWN_EXPERT = GeometrySegmentConfig(expert="own")
EVERY_GEOMETRY = [
    GeometrySegmentConfig(time, positions, placement, expert)
    for time, positions, placement, expert in product(
        ("clean", "denoise"), ("sequential", "parallel"), ("segment", "prefix"), ("shared", "own")
    )
    if (placement, expert) != ("prefix", "own")  # the VLM's own prefix has no use for an expert
]


def name_of(geometry: GeometrySegmentConfig | None) -> str:
    """Test id of a geometry configuration."""
    if geometry is None:
        return "none"
    return "-".join([geometry.time, geometry.positions, geometry.placement, geometry.expert])


# --- networks ---------------------------------------------------------------------------------------------------------


@torch.no_grad()
def randomise(module: nn.Module, seed: int) -> None:
    """Draw every parameter anew, the same for the same seed, at a scale that keeps activations near 1."""
    generator = torch.Generator().manual_seed(seed)
    for name, parameter in sorted(module.named_parameters()):
        drawn = torch.randn(parameter.shape, generator=generator)
        is_matrix = parameter.ndim > 1 and "openness" not in name
        parameter.copy_(drawn * (parameter[0].numel() ** -0.5 if is_matrix else 0.3))


def build_network(geometry: GeometrySegmentConfig | None = SEGMENT, seed: int = 0, **changes: Any) -> PI05Pytorch:
    """A tiny network with random weights. changes: fields of its `NetworkConfig`."""
    settings = {
        "paligemma": PALIGEMMA_VARIANTS["tiny"],
        "expert": EXPERT_VARIANTS["tiny"],
        "image_size": IMAGE_SIZE,
        "chunk_size": 5,
        "max_action_dim": ACTION_DIM,
        "geometry": geometry,
    }
    network = PI05Pytorch(NetworkConfig(**(settings | changes)))
    randomise(network, seed)
    return network


@lru_cache
def shared_network(geometry: GeometrySegmentConfig | None = SEGMENT) -> PI05Pytorch:
    """`build_network`, once per configuration: for tests that leave it as they found it."""
    return build_network(geometry, DRAWN_ONCE)


# --- observations -----------------------------------------------------------------------------------------------------


class Batch(NamedTuple):
    """Arguments of `PI05Pytorch.forward`, in its order."""

    images: list[Tensor | None]
    img_masks: list[Tensor]
    tokens: Tensor
    masks: Tensor
    actions: Tensor
    noise: Tensor
    time: Tensor
    geom_embs: Tensor | None
    geom_pad: Tensor | None

    @property
    def observation(self) -> tuple[list[Tensor | None], list[Tensor], Tensor, Tensor]:
        """Images, their masks, tokens, their mask."""
        return self.images, self.img_masks, self.tokens, self.masks

    @property
    def without_geometry(self) -> "Batch":
        return self._replace(geom_embs=None, geom_pad=None)

    def row(self, index: int) -> "Batch":
        """One sample, as a batch of one."""
        return Batch(*(_row(entry, index) for entry in self))


def _row(entry: Any, index: int) -> Any:
    if isinstance(entry, list):
        return [_row(item, index) for item in entry]
    return None if entry is None else entry[index : index + 1]


@dataclass(frozen=True)
class Case:
    """Sizes of a random batch. grid: cells per side of each of the depth views."""

    seed: int = 0
    batch: int = 2
    cameras: int = 2
    prompt: int = 6
    chunk: int = 5
    grid: int = 3
    views: int = 1
    scattered: bool = False  # padding anywhere in the prompt, instead of at its end

    def draw(self, geometry_width: int, action_dim: int = ACTION_DIM) -> Batch:
        """Random images, cameras that are masked in some rows, prompts of random lengths, holes in the geometry."""
        generator = torch.Generator().manual_seed(self.seed)

        def normal(*shape: int) -> Tensor:
            return torch.randn(shape, generator=generator)

        def flags(probability: float, *shape: int) -> Tensor:
            return torch.rand(shape, generator=generator) < probability

        lengths = torch.randint(1, self.prompt + 1, (self.batch, 1), generator=generator)
        masks = torch.arange(self.prompt) < lengths
        if self.scattered:
            masks = masks[:, torch.randperm(self.prompt, generator=generator)]
        images = [
            torch.rand(self.batch, 3, IMAGE_SIZE, IMAGE_SIZE, generator=generator) * 2 - 1 for _ in range(self.cameras)
        ]
        cells = self.views * self.grid**2
        return Batch(
            images=list(images),
            img_masks=[flags(0.7, self.batch) for _ in images],
            tokens=torch.randint(0, VOCABULARY, (self.batch, self.prompt), generator=generator),
            masks=masks,
            actions=normal(self.batch, self.chunk, action_dim),
            noise=normal(self.batch, self.chunk, action_dim),
            time=torch.rand(self.batch, generator=generator) * 0.999 + 0.001,
            geom_embs=normal(self.batch, cells, geometry_width),
            geom_pad=flags(0.7, self.batch, cells),
        )


cases = st.builds(
    Case,
    seed=st.integers(0, 10_000),
    batch=st.integers(1, 4),
    cameras=st.integers(1, 3),
    prompt=st.integers(1, 9),
    chunk=st.integers(1, 12),
    grid=st.integers(1, 6),
    views=st.integers(1, 2),
    scattered=st.booleans(),
)


def sample(network: PI05Pytorch, batch: Batch, **settings: Any) -> Tensor:
    """Sampled actions; three Euler steps unless told."""
    settings = {"num_steps": 3, "geom_embs": batch.geom_embs, "geom_pad": batch.geom_pad} | settings
    return network.sample_actions(*batch.observation, batch.noise, **settings)


def velocity(network: PI05Pytorch, batch: Batch) -> Tensor:
    """The velocity whose error is the training loss."""
    with recorded_outputs([network.action_out_proj]) as outputs:
        network(*batch)
    return outputs[0]


def both_paths(network: PI05Pytorch, batch: Batch) -> tuple[Tensor, Tensor]:
    """What the two paths through the network give: the velocity of a training step, and sampled actions."""
    return velocity(network, batch), sample(network, batch)


def assert_near(found: Sequence[Tensor], expected: Sequence[Tensor], tolerance: float = 1e-6) -> None:
    """Every tensor equals its partner to `tolerance` times the partner's largest number: some float32 roundings."""
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=tolerance * max(1.0, b.abs().max().item()))


def distance(a: Tensor, b: Tensor) -> float:
    """Largest absolute difference; NaN if there is a NaN."""
    return (a - b).abs().max().item()


# --- looking inside ---------------------------------------------------------------------------------------------------


@contextmanager
def recorded_outputs(modules: Sequence[nn.Module]) -> Iterator[list[Any]]:
    """The outputs of these modules, in the order of their calls."""
    outputs: list[Any] = []
    handles = [m.register_forward_hook(lambda module, args, output: outputs.append(output)) for m in modules]
    try:
        yield outputs
    finally:
        for handle in handles:
            handle.remove()


@contextmanager
def recorded_caches(network: PI05Pytorch) -> Iterator[list[SegmentKVCache]]:
    """The caches that sampling makes."""
    inner = network.paligemma_with_expert
    caches: list[SegmentKVCache] = []
    make_cache = inner.make_cache

    def recording(*args: Any) -> SegmentKVCache:
        caches.append(make_cache(*args))
        return caches[-1]

    inner.make_cache = recording  # type: ignore[method-assign]
    try:
        yield caches
    finally:
        del inner.make_cache


def run_segments(network: PI05Pytorch, batch: Batch, cached: bool) -> tuple[list[Tensor | None], SegmentKVCache | None]:
    """All outputs of the three segments, with geometry at flow time 0, and the cache if `cached`."""
    prefix = network.embed_prefix(*batch.observation)
    suffix, suffix_pad, suffix_att, cond = network.embed_suffix(batch.noise, batch.time)
    embeds, pads, atts = [prefix.embs, None, suffix], [prefix.pad, None, suffix_pad], [prefix.att, None, suffix_att]
    if batch.geom_embs is not None:
        cells = batch.geom_embs.shape[1]
        embeds[1], pads[1], atts[1] = batch.geom_embs, batch.geom_pad, [1] + [0] * (cells - 1)
    lengths = [0 if pad is None else pad.shape[1] for pad in pads]
    inner = network.paligemma_with_expert
    return inner(
        attention_mask=[None if pads[s] is None else segment_mask(s, pads, atts) for s in Segment],
        position_ids=segment_positions(pads, "sequential"),
        past_key_values=inner.make_cache(suffix.shape[0], lengths, suffix.device) if cached else None,
        inputs_embeds=embeds,
        use_cache=cached,
        adarms_cond=[None, network.embed_time(torch.zeros(1)), cond],
    )


# --- references -------------------------------------------------------------------------------------------------------


def mask_table(pads: Sequence[Tensor | None], atts: Sequence[Sequence[int] | None]) -> Tensor:
    """Attention mask of the whole sequence, (B, N, N), entry by entry from openpi's rule."""
    pad = torch.cat([p for p in pads if p is not None], dim=1).tolist()
    att = [int(entry) for segment in atts if segment is not None for entry in segment]
    tokens = range(len(att))
    return torch.tensor(
        [
            [[row[key] and sum(att[: key + 1]) <= sum(att[: query + 1]) for key in tokens] for query in tokens]
            for row in pad
        ]
    )


def position_table(pads: Sequence[Tensor | None], rule: str) -> list[list[list[int]] | None]:
    """Positions per segment and row, counted token by token."""
    positions: list[list[list[int]] | None] = [None if pad is None else [] for pad in pads]
    for row in range(next(pad.shape[0] for pad in pads if pad is not None)):
        counted = -1  # position of the last real token
        for segment, pad in enumerate(pads):
            if pad is None:
                continue
            here = []
            if segment == Segment.GEOMETRY and rule == "parallel":
                here = [counted + 1 + cell for cell in range(pad.shape[1])]
            else:
                for real in pad[row].tolist():
                    counted += real
                    here.append(counted)
            positions[segment].append(here)
    return positions
