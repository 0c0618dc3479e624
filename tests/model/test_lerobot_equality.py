"""Invariant 4: without geometry, and with all of it masked, this is LeRobot's π0.5."""

from functools import lru_cache

import pytest
import torch
from benchmarks.lerobot_pi05 import LM_HEADS, build_lerobot_pi05, copy_weights
from hypothesis import given, settings
from hypothesis import strategies as st
from lerobot.policies.pi05 import modeling_pi05
from lerobot.policies.pi05.modeling_pi05 import PI05Pytorch as LeRobotPI05
from torch import Tensor

from lerobot_policy_pi05_geometry.model import PI05Pytorch

from .helpers import (
    IMAGE_SIZE,
    IN_PREFIX,
    OWN_EXPERT,
    PARALLEL,
    SEGMENT,
    Batch,
    Case,
    build_network,
    cases,
    name_of,
    randomise,
    sample,
)

ACTION_DIMS = (1, 7, 32)
CHUNKS = (1, 5, 8)
geometries = pytest.mark.parametrize("geometry", [None, SEGMENT, PARALLEL, OWN_EXPERT, IN_PREFIX], ids=name_of)


@lru_cache
def lerobot_pi05(chunk: int, action_dim: int) -> LeRobotPI05:
    theirs = build_lerobot_pi05(
        "tiny", "tiny", image_size=IMAGE_SIZE, chunk_size=chunk, max_action_dim=action_dim, num_inference_steps=4
    )
    randomise(theirs, seed=chunk + action_dim)
    return theirs


@lru_cache
def same_weights(geometry, chunk: int, action_dim: int) -> tuple[LeRobotPI05, PI05Pytorch]:
    """LeRobot's network, and ours with its weights; what only ours has is random."""
    theirs = lerobot_pi05(chunk, action_dim)
    ours = build_network(geometry, chunk_size=chunk, max_action_dim=action_dim, num_inference_steps=4)
    copy_weights(theirs, ours)
    return theirs, ours


def assert_same(theirs: LeRobotPI05, ours: PI05Pytorch, batch: Batch, geometry: Batch) -> None:
    """Loss and sampled actions agree: LeRobot's on `batch`, ours on `batch` with the geometry of `geometry`."""
    batch = batch.without_geometry
    given_ours = batch._replace(geom_embs=geometry.geom_embs, geom_pad=geometry.geom_pad)
    loss = theirs(*batch[:7])
    torch.testing.assert_close(ours(*given_ours), loss, rtol=1e-6, atol=1e-5)
    actions = theirs.sample_actions(*batch.observation, noise=batch.noise)
    torch.testing.assert_close(sample(ours, given_ours, num_steps=None), actions, rtol=0, atol=1e-5)


@geometries
@given(case=cases, chunk=st.sampled_from(CHUNKS), action_dim=st.sampled_from(ACTION_DIMS))
@settings(max_examples=4)
def test_without_geometry(geometry, case: Case, chunk: int, action_dim: int) -> None:
    """Invariant 4, for masked cameras, short prompts, other chunk sizes and action widths, batches above 1."""
    theirs, ours = same_weights(geometry, chunk, action_dim)
    batch = Case(**(vars(case) | {"chunk": chunk})).draw(ours.geometry_width, action_dim)
    assert_same(theirs, ours, batch, batch.without_geometry)


@pytest.mark.parametrize("geometry", [SEGMENT, PARALLEL, OWN_EXPERT, IN_PREFIX], ids=name_of)
@given(case=cases)
@settings(max_examples=3)
def test_with_all_geometry_masked(geometry, case: Case) -> None:
    """Invariant 4 with a geometry segment in which every cell is a hole, under both position rules."""
    theirs, ours = same_weights(geometry, 5, 7)
    batch = Case(**(vars(case) | {"chunk": 5})).draw(ours.geometry_width, 7)
    assert_same(theirs, ours, batch, batch._replace(geom_pad=torch.zeros_like(batch.geom_pad)))


def test_with_every_camera_masked() -> None:
    """Invariant 4 where only the prompt is left; an absent camera is LeRobot's masked image."""
    theirs, ours = same_weights(SEGMENT, 5, 7)
    batch = Case(seed=1, batch=3, cameras=2, chunk=5).draw(ours.geometry_width, 7).without_geometry
    batch = batch._replace(img_masks=[torch.zeros_like(mask) for mask in batch.img_masks])
    assert_same(theirs, ours, batch, batch)
    expected = theirs.sample_actions(*batch.observation, noise=batch.noise)
    found = sample(ours, batch._replace(images=[None, None]), num_steps=None)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)


def test_a_chunk_of_fifty() -> None:
    """Invariant 4 at the released chunk size and number of steps."""
    theirs, ours = same_weights(PARALLEL, 50, 32)
    batch = Case(seed=2, batch=2, cameras=3, prompt=20, chunk=50).draw(ours.geometry_width, 32)
    assert_same(theirs, ours, batch, batch.without_geometry)


@pytest.mark.parametrize("masked", [False, True], ids=["without geometry", "with masked geometry"])
def test_gradients(masked: bool) -> None:
    """One training step moves every shared parameter as LeRobot's does."""
    theirs, ours = same_weights(PARALLEL, 5, 7)
    batch = Case(seed=3, batch=3, cameras=2, chunk=5).draw(ours.geometry_width, 7)
    geometry = batch._replace(geom_pad=torch.zeros_like(batch.geom_pad)) if masked else batch.without_geometry
    theirs.zero_grad()
    ours.zero_grad()
    theirs(*batch[:7]).mean().backward()
    ours(*batch[:7], geometry.geom_embs, geometry.geom_pad).mean().backward()
    expected = dict(theirs.named_parameters())
    compared = 0
    for name, parameter in ours.named_parameters():
        if parameter.grad is None or "geometry" in name:
            continue
        torch.testing.assert_close(parameter.grad, expected[name].grad, rtol=1e-4, atol=1e-5, msg=name)
        compared += 1
    # LeRobot's graph reaches what we freeze, the unread end of the VLM, with zeros or not at all.
    unread = [name for name, p in ours.named_parameters() if not p.requires_grad]
    assert all(expected[name].grad is None or not expected[name].grad.any() for name in unread)
    assert compared + len(unread) == len(expected) - len(LM_HEADS)


def test_copy_weights_is_strict() -> None:
    """Two networks that differ in anything but the lm_heads and geometry do not pass as the same."""
    theirs, ours = same_weights(SEGMENT, 5, 7)
    own = build_network(OWN_EXPERT, max_action_dim=7)
    copy_weights(theirs, own)
    for broken in ("time_mlp_in", "paligemma_with_expert.paligemma.model.multi_modal_projector.linear"):
        smaller = build_network(SEGMENT, max_action_dim=7)
        parent, _, leaf = broken.rpartition(".")
        delattr(smaller.get_submodule(parent), leaf)
        with pytest.raises(ValueError, match=broken):
            copy_weights(theirs, smaller)
    ours.register_parameter("extra", torch.nn.Parameter(torch.zeros(1)))
    try:
        with pytest.raises(ValueError, match="extra"):
            copy_weights(theirs, ours)
    finally:
        del ours.extra


def test_the_patches_are_gone() -> None:
    """Building at small sizes leaves LeRobot's module as it was."""
    before = dict(vars(modeling_pi05))
    build_lerobot_pi05("tiny", "tiny", image_size=IMAGE_SIZE, chunk_size=1, max_action_dim=1)
    assert dict(vars(modeling_pi05)) == before
    assert modeling_pi05.get_gemma_config("gemma_2b").width == 2048


def test_the_comparison_can_tell() -> None:
    """A change of one weight that matters shows: the two networks do not agree by being deaf."""
    theirs, _ = same_weights(None, 5, 7)
    ours = build_network(None, max_action_dim=7, num_inference_steps=4)
    copy_weights(theirs, ours)
    batch = Case(seed=4, chunk=5).draw(24, 7).without_geometry
    with torch.no_grad():
        ours.paligemma_with_expert.expert.layers[0].input_layernorm.dense.weight[0] += 0.1
    found: Tensor = ours(*batch)
    assert (found - theirs(*batch[:7])).abs().max() > 1e-3
