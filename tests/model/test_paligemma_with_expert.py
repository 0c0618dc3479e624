"""Invariants 1 and 2: who is disturbed by whom."""

import pytest
import torch
from hypothesis import given, settings
from torch import Tensor

from lerobot_policy_pi05_geometry.model import GeometrySegmentConfig, PaliGemmaWithExpert, PI05Pytorch, Segment
from lerobot_policy_pi05_geometry.model.attention import Attention
from lerobot_policy_pi05_geometry.model.segment_gate import GeometryGate
from lerobot_policy_pi05_geometry.model.segment_mask import segment_mask
from lerobot_policy_pi05_geometry.model.segments import segment_positions

from .helpers import (
    IN_PREFIX,
    OWN_EXPERT,
    PARALLEL,
    SEGMENT,
    Batch,
    Case,
    build_network,
    cases,
    distance,
    name_of,
    recorded_caches,
    recorded_outputs,
    run_segments,
    sample,
    shared_network,
)

DENOISE = GeometrySegmentConfig(time="denoise")
segment_geometries = pytest.mark.parametrize("geometry", [SEGMENT, PARALLEL, OWN_EXPERT, DENOISE], ids=name_of)


def other_geometries(batch: Batch) -> list[Batch]:
    """The same observation without geometry, and with others: other values, all holes, one cell."""
    return [
        batch.without_geometry,
        batch._replace(geom_embs=5 * batch.geom_embs.flip(1)),
        batch._replace(geom_pad=torch.zeros_like(batch.geom_pad)),
        batch._replace(geom_embs=batch.geom_embs[:, :1], geom_pad=batch.geom_pad[:, :1]),
    ]


def bit_identical(a: list[Tensor], b: list[Tensor]) -> bool:
    return len(a) == len(b) > 0 and all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


# --- invariant 1: geometry does not disturb the prefix ----------------------------------------------------------------


def prefix_in_training(network: PI05Pytorch, batch: Batch) -> list[Tensor]:
    """Hidden states, keys and values of the prefix in every layer of a training step."""
    with recorded_outputs(network.paligemma_with_expert.language_model.layers) as outputs:
        network(*batch)
    return [tensor for hidden, seen in outputs for tensor in (hidden, *seen) if tensor is not None]


def prefix_in_sampling(network: PI05Pytorch, batch: Batch) -> list[Tensor]:
    """Keys and values of the prefix in the cache, after sampling."""
    with recorded_caches(network) as caches:
        sample(network, batch)
    span = caches[0].span(Segment.PREFIX)
    return [caches[0].keys[..., span, :], caches[0].values[..., span, :]]


def prefix_outputs(network: PI05Pytorch, batch: Batch) -> list[Tensor]:
    """Final outputs of the prefix, with gradients (training) and through a cache (inference)."""
    trained, _ = run_segments(network, batch, cached=False)
    with torch.no_grad():
        cached, _ = run_segments(network, batch, cached=True)
    return [trained[Segment.PREFIX], cached[Segment.PREFIX]]


@segment_geometries
@given(case=cases)
@settings(max_examples=2)
def test_geometry_does_not_disturb_the_prefix(geometry: GeometrySegmentConfig, case: Case) -> None:
    """Invariant 1, bit for bit: layer by layer in training, in the cache, and in the final outputs."""
    network = shared_network(geometry)
    batch = case.draw(network.geometry_width)
    for look in (prefix_in_training, prefix_in_sampling, prefix_outputs):
        reference = look(network, batch)
        for changed in other_geometries(batch):
            assert bit_identical(look(network, changed), reference)


def test_placement_in_the_prefix_does_disturb_it() -> None:
    """The comparison placement lets the VLM see geometry: the test above can tell."""
    network = shared_network(IN_PREFIX)
    batch = Case().draw(network.geometry_width)
    changed = batch._replace(geom_embs=-batch.geom_embs)
    image_tokens = slice(0, 4)
    (before, _), (after, _) = (prefix_in_sampling(network, b) for b in (batch, changed))
    # The first layer has not looked yet.
    assert torch.equal(before[0, ..., image_tokens, :], after[0, ..., image_tokens, :])
    assert distance(before[1, ..., image_tokens, :], after[1, ..., image_tokens, :]) > 1e-3


# --- invariant 2: the flow does not disturb geometry ------------------------------------------------------------------


def geometry_in_training(network: PI05Pytorch, batch: Batch) -> list[Tensor]:
    """Keys and values of geometry in every layer of a training step."""
    inner = network.paligemma_with_expert
    model = inner.segment_model(Segment.GEOMETRY)
    calls = 1 if model is inner.geometry_expert else 2  # the shared expert runs geometry, then the suffix
    with recorded_outputs(model.layers) as outputs:
        network(*batch)
    cells = batch.geom_embs.shape[1]
    return [tensor[:, :, -cells:] for _, seen in outputs[::calls] for tensor in seen]


def geometry_in_sampling(network: PI05Pytorch, batch: Batch, num_steps: int) -> list[Tensor]:
    """Keys and values of geometry in the cache after the last step."""
    with recorded_caches(network) as caches:
        sample(network, batch, num_steps=num_steps)
    span = caches[0].span(Segment.GEOMETRY)
    return [caches[0].keys[..., span, :], caches[0].values[..., span, :]]


@pytest.mark.parametrize("geometry", [SEGMENT, PARALLEL, OWN_EXPERT], ids=name_of)
@given(case=cases)
@settings(max_examples=3)
def test_the_flow_does_not_disturb_clean_geometry(geometry: GeometrySegmentConfig, case: Case) -> None:
    """Invariant 2: actions, noise, flow time and the number of steps leave geometry's keys and values alone."""
    network = shared_network(geometry)
    batch = case.draw(network.geometry_width)
    trained = geometry_in_training(network, batch)
    for changed in (
        batch._replace(time=1 - 0.9 * batch.time),
        batch._replace(noise=-3 * batch.noise),
        batch._replace(actions=batch.actions + 1),
    ):
        assert bit_identical(geometry_in_training(network, changed), trained)
    sampled = geometry_in_sampling(network, batch, 3)
    assert bit_identical(geometry_in_sampling(network, batch, 1), sampled)
    assert bit_identical(geometry_in_sampling(network, batch._replace(noise=-3 * batch.noise), 3), sampled)


@pytest.mark.parametrize("expert", ["shared", "own"])
def test_the_flow_time_moves_denoised_geometry(expert: str) -> None:
    """Under "denoise" geometry follows the flow time, in training and in sampling, but never noise or actions."""
    network = shared_network(GeometrySegmentConfig(time="denoise", expert=expert))
    batch = Case(seed=6).draw(network.geometry_width)
    later = batch._replace(time=0.1 * batch.time)
    noisier = batch._replace(noise=-3 * batch.noise, actions=batch.actions + 1)
    before, after = geometry_in_training(network, batch), geometry_in_training(network, later)
    assert all(distance(a, b) > 1e-3 for a, b in zip(before, after, strict=True))
    assert bit_identical(geometry_in_training(network, noisier), before)
    sampled = geometry_in_sampling(network, batch, 3)
    assert distance(geometry_in_sampling(network, batch, 1)[0], sampled[0]) > 1e-3
    assert bit_identical(geometry_in_sampling(network, noisier, 3), sampled)


def test_geometry_reads_the_prefix() -> None:
    """Geometry sees scene and instruction: from the second layer on, its keys depend on the images."""
    network = shared_network(SEGMENT)
    batch = Case(seed=7, cameras=1).draw(network.geometry_width)
    batch.img_masks[0][:] = True
    changed = batch._replace(images=[-batch.images[0]])
    before, after = (geometry_in_sampling(network, b, 1)[0] for b in (batch, changed))
    assert torch.equal(before[0], after[0])
    assert distance(before[1], after[1]) > 1e-3


# --- the contract of forward ------------------------------------------------------------------------------------------


def test_a_list_of_two_is_plain_pi05() -> None:
    """[prefix, suffix] and [prefix, None, suffix] are the same call."""
    network = shared_network(None)
    batch = Case(seed=8).draw(network.geometry_width).without_geometry
    expected, _ = run_segments(network, batch, cached=False)
    prefix = network.embed_prefix(*batch.observation)
    embs, pad, att, cond = network.embed_suffix(batch.noise, batch.time)
    pads, atts = [prefix.pad, None, pad], [prefix.att, None, att]
    masks = [segment_mask(s, pads, atts) for s in (Segment.PREFIX, Segment.SUFFIX)]
    positions = segment_positions(pads, "sequential")
    outputs, _ = network.paligemma_with_expert(
        masks, [positions[0], positions[2]], None, [prefix.embs, embs], False, [None, cond]
    )
    assert len(outputs) == 3
    assert outputs[Segment.GEOMETRY] is None
    assert torch.equal(outputs[Segment.SUFFIX], expected[Segment.SUFFIX])


def test_use_cache_and_cache_come_together() -> None:
    """Either alone is a mistake of the caller."""
    inner = shared_network(SEGMENT).paligemma_with_expert
    cache = inner.make_cache(1, [1, 1, 1], torch.device("cpu"))
    for use_cache, past in ((True, None), (False, cache)):
        with pytest.raises(ValueError, match="use_cache=True"):
            inner([None] * 3, [None] * 3, past, [None] * 3, use_cache)


def test_cached_and_plain_outputs_agree() -> None:
    """Outputs of all three segments, through a cache and without."""
    network = shared_network(SEGMENT)
    batch = Case(seed=9).draw(network.geometry_width)
    with torch.no_grad():
        plain, _ = run_segments(network, batch, cached=False)
        cached, _ = run_segments(network, batch, cached=True)
    for a, b in zip(plain, cached, strict=True):
        assert distance(a, b) <= 1e-5


def test_the_gate_acts_on_the_suffix_alone() -> None:
    """The gate changes the suffix's output, and nothing of prefix or geometry."""
    network = build_network(SEGMENT, seed=1)
    batch = Case(seed=10).draw(network.geometry_width)
    with torch.no_grad():
        before, _ = run_segments(network, batch, cached=False)
        network.paligemma_with_expert.geometry_gate.openness *= 3
        after, _ = run_segments(network, batch, cached=False)
    assert torch.equal(before[Segment.PREFIX], after[Segment.PREFIX])
    assert torch.equal(before[Segment.GEOMETRY], after[Segment.GEOMETRY])
    assert distance(before[Segment.SUFFIX], after[Segment.SUFFIX]) > 1e-3


def test_the_gate_scales_softmax_weights() -> None:
    """The openness multiplies the weight of a geometry key: 2, or -2, counts every cell twice."""
    gate = GeometryGate(num_layers=1, num_heads=8, openness=2.0)
    with torch.no_grad():
        gate.openness[0, ::2] = -2.0
    assert gate.mean_openness() == 2.0
    bias = gate(0, before=3, geometry=4, after=2)
    assert bias.shape == (8, 9)
    generator = torch.Generator().manual_seed(0)
    q = torch.randn(2, 8, 5, 8, generator=generator)
    k, v = (torch.randn(2, 1, 9, 8, generator=generator) for _ in range(2))
    cells_twice = [0, 1, 2, *(3, 4, 5, 6) * 2, 7, 8]
    with torch.no_grad():
        gated = Attention()(q, k, v, torch.ones(2, 1, 9, dtype=torch.bool), bias)
        repeated = Attention()(q, k[:, :, cells_twice], v[:, :, cells_twice], torch.ones(2, 1, 13, dtype=torch.bool))
    torch.testing.assert_close(gated, repeated, rtol=0, atol=1e-6)


def test_own_expert_starts_as_a_copy() -> None:
    """A freshly built second expert has the action expert's weights, and then goes its own way."""
    inner = PaliGemmaWithExpert(build_network(OWN_EXPERT).config)
    copied, original = inner.geometry_expert.state_dict(), inner.expert.state_dict()
    assert copied.keys() == original.keys()
    assert all(torch.equal(copied[name], original[name]) for name in original)
    assert all(copied[name].data_ptr() != original[name].data_ptr() for name in original)


def test_train_expert_only_freezes_the_vlm() -> None:
    """LeRobot's two settings."""
    inner = build_network(SEGMENT).paligemma_with_expert
    inner.set_trainable(freeze_vision_encoder=True)
    assert not any(p.requires_grad for p in inner.paligemma.model.vision_tower.parameters())
    assert inner.language_model.layers[0].self_attn.q_proj.weight.requires_grad
    inner.set_trainable(train_expert_only=True)
    assert not any(p.requires_grad for p in inner.paligemma.parameters())
    assert all(p.requires_grad for p in inner.gemma_expert.parameters())
