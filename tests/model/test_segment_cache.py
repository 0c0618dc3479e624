"""Invariants 3 and 7: caching changes nothing, and denoising does not change the cache."""

import pytest
import torch
from hypothesis import given, settings

from lerobot_policy_pi05_geometry.model import GeometrySegmentConfig, Segment, SegmentKVCache
from lerobot_policy_pi05_geometry.model.segments import SegmentTokens, one_block

from .helpers import (
    EVERY_GEOMETRY,
    OWN_EXPERT,
    PARALLEL,
    SEGMENT,
    Case,
    cases,
    distance,
    name_of,
    recorded_caches,
    sample,
    shared_network,
)

every_geometry = pytest.mark.parametrize("geometry", EVERY_GEOMETRY, ids=name_of)


@every_geometry
@given(case=cases)
@settings(max_examples=3)
def test_cached_sampling_equals_the_uncached_loop(geometry: GeometrySegmentConfig, case: Case) -> None:
    """Invariant 3, for random padding, masked cameras, holes, batches, cameras and grids, twice in a row."""
    network = shared_network(geometry)
    for seed in (case.seed, case.seed + 1):
        batch = Case(**(vars(case) | {"seed": seed})).draw(network.geometry_width)
        assert distance(sample(network, batch), sample(network, batch, use_cache=False)) <= 1e-5


@pytest.mark.parametrize(
    "geometry", [SEGMENT, GeometrySegmentConfig(time="denoise", positions="parallel")], ids=name_of
)
def test_cached_sampling_over_ten_steps(geometry: GeometrySegmentConfig) -> None:
    """Invariant 3 over the configured number of steps, with a camera absent, another masked, and causal geometry."""
    network = shared_network(geometry)
    batch = Case(seed=3, batch=3, cameras=3, grid=2).draw(network.geometry_width)
    batch = batch._replace(images=[batch.images[0], None, batch.images[2]])
    batch.img_masks[2][:] = False
    for geom_att in (None, [1, 1, 1, 1], [1, 0, 1, 0]):
        cached, plain = (
            sample(network, batch, num_steps=None, geom_att=geom_att, use_cache=use_cache)
            for use_cache in (True, False)
        )
        assert distance(cached, plain) <= 1e-5


@pytest.mark.parametrize("cameras", [1, 2, 3])
def test_cached_sampling_without_any_camera_or_geometry(cameras: int) -> None:
    """Invariant 3 where only the prompt is left, and where the observation brings no geometry."""
    network = shared_network(SEGMENT)
    batch = Case(seed=4, cameras=cameras).draw(network.geometry_width)
    blind = batch._replace(images=[None] * cameras)
    for observation in (blind, batch.without_geometry, blind.without_geometry):
        assert distance(sample(network, observation), sample(network, observation, use_cache=False)) <= 1e-5


@pytest.mark.parametrize("geometry", [SEGMENT, PARALLEL, OWN_EXPERT], ids=name_of)
def test_ten_steps_leave_prefix_and_geometry_as_they_are(geometry: GeometrySegmentConfig) -> None:
    """Invariant 7: ten denoising steps overwrite the suffix in place; nothing else changes and nothing is allocated."""
    network = shared_network(geometry)
    batch = Case(seed=5, batch=2, grid=3).draw(network.geometry_width)
    with recorded_caches(network) as caches:
        sample(network, batch, num_steps=1)
    (cache,) = caches
    context = slice(0, cache.span(Segment.GEOMETRY).stop)
    suffix = cache.span(Segment.SUFFIX)
    before = [buffer.clone() for buffer in (cache.keys, cache.values)]
    places = [buffer.data_ptr() for buffer in (cache.keys, cache.values)]
    shape = cache.keys.shape

    prefix_pad = network.embed_prefix(*batch.observation).pad
    cells = SegmentTokens(None, batch.geom_pad, one_block(batch.geom_pad.shape[1]))
    generator = torch.Generator().manual_seed(0)
    for step in range(10):
        x_t = torch.randn(batch.noise.shape, generator=generator)
        network.denoise_step(prefix_pad, cache, x_t, torch.full((2,), 1 - step / 10), cells)

    assert [buffer.data_ptr() for buffer in (cache.keys, cache.values)] == places
    assert cache.keys.shape == cache.values.shape == shape
    for buffer, old in zip((cache.keys, cache.values), before, strict=True):
        assert torch.equal(buffer[..., context, :], old[..., context, :])
        assert (buffer[..., suffix, :] != old[..., suffix, :]).any(dim=-1).all()


def test_sampling_makes_one_cache() -> None:
    """One allocation per observation, of exactly the tokens that there are, whatever the number of steps."""
    network = shared_network(SEGMENT)
    batch = Case(batch=3, cameras=2, prompt=7, chunk=4, grid=3, views=2).draw(network.geometry_width)
    with recorded_caches(network) as caches:
        sample(network, batch, num_steps=10)
    (cache,) = caches
    assert cache.lengths == (2 * 4 + 7, 2 * 9, 4)
    assert cache.keys.shape == cache.values.shape == (3, 3, 1, 15 + 18 + 4, 8)


def test_slots_are_views_of_one_buffer() -> None:
    """A slot writes its own segment and shows everything up to its end, without a copy."""
    cache = SegmentKVCache(2, 1, 1, 4, (3, 2, 1), torch.float32, torch.device("cpu"))
    for layer in range(2):
        for segment, length, end in zip(Segment, (3, 2, 1), (3, 5, 6), strict=True):
            number = float(10 * layer + segment + 1)
            filled = torch.full((1, 1, length, 4), number)
            keys, values = cache.slot(layer, segment).write(filled, -filled)
            assert keys.shape == values.shape == (1, 1, end, 4)
            assert keys.data_ptr() == cache.keys[layer].data_ptr()
            assert values.data_ptr() == cache.values[layer].data_ptr()
            assert (keys[:, :, -length:] == number).all()
    assert cache.keys[:, 0, 0, :, 0].tolist() == [[1, 1, 1, 2, 2, 3], [11, 11, 11, 12, 12, 13]]
    assert torch.equal(cache.values, -cache.keys)


def test_an_absent_segment_takes_no_room() -> None:
    """Length 0 is an absent segment: the suffix follows the prefix."""
    cache = SegmentKVCache(1, 1, 1, 4, (3, 0, 2), torch.float32, torch.device("cpu"))
    assert cache.span(Segment.GEOMETRY) == slice(3, 3)
    assert cache.span(Segment.SUFFIX) == slice(3, 5)
