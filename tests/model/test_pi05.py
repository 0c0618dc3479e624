"""Invariants 5 and 6 on the whole network, and what its public methods promise."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.rtc.modeling_rtc import RTCProcessor
from torch import Tensor

from lerobot_policy_pi05_geometry.model import GeometrySegmentConfig, NetworkConfig, Segment
from lerobot_policy_pi05_geometry.model.segments import SegmentTokens, one_block
from lerobot_policy_pi05_geometry.model.variants import EXPERT_VARIANTS, PALIGEMMA_VARIANTS

from .helpers import (
    IN_PREFIX,
    OWN_EXPERT,
    PARALLEL,
    SEGMENT,
    Batch,
    Case,
    assert_near,
    both_paths,
    build_network,
    cases,
    distance,
    mask_table,
    name_of,
    position_table,
    recorded_caches,
    recorded_outputs,
    sample,
    shared_network,
    velocity,
)

DENOISE = GeometrySegmentConfig(time="denoise")
GEOMETRIES = [SEGMENT, PARALLEL, IN_PREFIX, OWN_EXPERT, DENOISE]
geometries = pytest.mark.parametrize("geometry", GEOMETRIES, ids=name_of)
GARBAGE = [float("nan"), float("inf"), float("-inf"), 1e30]


# --- invariant 5: padded slots, other rows, trimming ------------------------------------------------------------------


def with_garbage(batch: Batch, number: float, token: int) -> Batch:
    """The same observation, with `number` in every masked image and hole, and `token` in every padded prompt slot."""
    return batch._replace(
        images=[
            image.masked_fill(~mask[:, None, None, None], number)
            for image, mask in zip(batch.images, batch.img_masks, strict=True)
        ],
        tokens=batch.tokens.masked_fill(~batch.masks, token),
        geom_embs=batch.geom_embs.masked_fill(~batch.geom_pad[..., None], number),
    )


@geometries
@given(
    case=cases,
    number=st.sampled_from(GARBAGE),
    token=st.sampled_from([-1, 10**6, -(2**40)]),
    use_cache=st.booleans(),
)
@settings(max_examples=6)
def test_padded_slots_reach_nothing(
    geometry: GeometrySegmentConfig, case: Case, number: float, token: int, use_cache: bool
) -> None:
    """Invariant 5, bit for bit: NaN, infinities and ids outside the vocabulary in padded slots change no output."""
    network = shared_network(geometry)
    batch = case.draw(network.geometry_width)
    dirty = with_garbage(batch, number, token)
    assert torch.equal(network(*dirty), network(*batch))
    clean_actions = sample(network, batch, use_cache=use_cache)
    assert clean_actions.isfinite().all()
    assert torch.equal(sample(network, dirty, use_cache=use_cache), clean_actions)


def gradients(batch: Batch) -> dict[str, Tensor]:
    network = build_network(SEGMENT)
    network(*batch).mean().backward()
    return {name: p.grad for name, p in network.named_parameters() if p.grad is not None}


@pytest.mark.parametrize("slots", ["prompt and geometry", "images"])
@pytest.mark.parametrize("number", GARBAGE)
def test_padded_slots_reach_no_gradient(slots: str, number: float) -> None:
    """Invariant 5 for training: what stands in a padded slot gives no parameter a gradient, and no NaN (0 x NaN)."""
    batch = Case(seed=1, batch=3, cameras=2).draw(shared_network(SEGMENT).geometry_width)
    dirty = with_garbage(batch, number, 10**6)
    dirty = batch._replace(images=dirty.images) if slots == "images" else dirty._replace(images=batch.images)
    expected, found = gradients(batch), gradients(dirty)
    assert [name for name, gradient in found.items() if not gradient.isfinite().all()] == []
    assert_near(found.values(), expected.values())


def test_holes_get_no_gradient() -> None:
    """The gradient of geometry tokens is exactly zero in holes and something elsewhere."""
    network = build_network(SEGMENT)
    batch = Case(seed=2, batch=3).draw(network.geometry_width)
    tokens = batch.geom_embs.requires_grad_()
    network(*batch).mean().backward()
    assert (tokens.grad[~batch.geom_pad] == 0).all()
    assert (tokens.grad[batch.geom_pad] != 0).any(dim=-1).all()


@geometries
@pytest.mark.parametrize("number", [3.0, float("nan")])
def test_rows_do_not_mix(geometry: GeometrySegmentConfig, number: float) -> None:
    """Invariant 5: whatever stands in the first row, NaN too, the other rows' results do not move by a bit."""
    network = shared_network(geometry)
    batch = Case(seed=3, batch=4, cameras=2).draw(network.geometry_width)
    other = Batch(*batch)._replace(
        images=[_first_row(image, number) for image in batch.images],
        tokens=_first_row(batch.tokens, 7),
        geom_embs=_first_row(batch.geom_embs, number),
        geom_pad=_first_row(batch.geom_pad, True),
        masks=_first_row(batch.masks, True),
        img_masks=[_first_row(mask, True) for mask in batch.img_masks],
        noise=_first_row(batch.noise, number),
        time=_first_row(batch.time, 0.123),
    )
    for before, after in zip(both_paths(network, batch), both_paths(network, other), strict=True):
        assert torch.equal(before[1:], after[1:])
        assert not torch.equal(before[0], after[0])


def _first_row(tensor: Tensor, value: float) -> Tensor:
    changed = tensor.clone()
    changed[0] = value
    return changed


@geometries
def test_a_row_is_the_same_alone(geometry: GeometrySegmentConfig) -> None:
    """Invariant 5: a sample does not depend on the batch that it is in."""
    network = shared_network(geometry)
    batch = Case(seed=4, batch=3, cameras=3, prompt=8, views=2).draw(network.geometry_width)
    together = both_paths(network, batch)
    for index in range(3):
        alone = both_paths(network, batch.row(index))
        assert_near([a[0] for a in alone], [whole[index] for whole in together])


@geometries
@given(case=cases, extra=st.integers(1, 5))
@settings(max_examples=3)
def test_trimming_the_prompt_changes_nothing(geometry: GeometrySegmentConfig, case: Case, extra: int) -> None:
    """Invariant 5: padding at either end of the prompt may go."""
    network = shared_network(geometry)
    batch = case.draw(network.geometry_width)
    trimmed = both_paths(network, batch)
    tokens, masks = (torch.nn.functional.pad(entry, (extra, 2 * extra)) for entry in (batch.tokens, batch.masks))
    assert_near(both_paths(network, batch._replace(tokens=tokens, masks=masks)), trimmed)


@geometries
@pytest.mark.parametrize("absent", range(3))
def test_an_absent_camera_is_a_masked_one(geometry: GeometrySegmentConfig, absent: int) -> None:
    """Invariant 5: None, which is not even encoded, equals an image that is masked in every row."""
    network = shared_network(geometry)
    batch = Case(seed=absent, batch=3, cameras=3).draw(network.geometry_width)
    batch.img_masks[absent][:] = False
    masked = both_paths(network, batch)
    batch.images[absent] = None
    assert_near(both_paths(network, batch), masked)


@pytest.mark.parametrize("geometry", [None, SEGMENT, IN_PREFIX], ids=name_of)
def test_a_row_without_a_prefix(geometry: GeometrySegmentConfig | None) -> None:
    """Invariant 5: a row with every camera masked and an empty prompt has no prefix to look at, and stays finite."""
    network = shared_network(geometry)
    batch = Case(seed=15, batch=3, cameras=1).draw(network.geometry_width)
    batch = batch.without_geometry if geometry is None else batch
    batch.masks[0] = False
    batch.img_masks[0][0] = False
    dirty = batch._replace(images=[-batch.images[0]])
    dirty.images[0][1:] = batch.images[0][1:]
    found = both_paths(network, batch)
    assert all(entry.isfinite().all() for entry in found)
    assert all(torch.equal(a, b) for a, b in zip(both_paths(network, dirty), found, strict=True))


def test_a_hole_is_no_token() -> None:
    """Under sequential positions, cells that are holes in every row may be left out."""
    network = shared_network(SEGMENT)
    batch = Case(seed=5, grid=4).draw(network.geometry_width)
    kept = batch.geom_pad[0]
    holes = batch._replace(geom_pad=kept.expand_as(batch.geom_pad))
    dropped = batch._replace(geom_embs=batch.geom_embs[:, kept], geom_pad=holes.geom_pad[:, kept])
    assert 0 < kept.sum() < len(kept)
    assert_near(both_paths(network, dropped), both_paths(network, holes))


# --- geometry that is not there ---------------------------------------------------------------------------------------


@geometries
@given(case=cases)
@settings(max_examples=3)
def test_masked_geometry_is_no_geometry(geometry: GeometrySegmentConfig, case: Case) -> None:
    """With every cell a hole, results are those without geometry, under both position rules and placements."""
    network = shared_network(geometry)
    batch = case.draw(network.geometry_width)
    masked = batch._replace(geom_pad=torch.zeros_like(batch.geom_pad))
    assert_near(both_paths(network, masked), both_paths(network, batch.without_geometry))


@given(case=cases)
@settings(max_examples=6)
def test_a_closed_gate_hides_geometry(case: Case) -> None:
    """With the gate shut and parallel positions the network is its π0.5, so a warm start begins as that one."""
    network = build_network(PARALLEL, seed=case.seed)
    with torch.no_grad():
        network.paligemma_with_expert.geometry_gate.openness.fill_(0.0)
    batch = case.draw(network.geometry_width)
    assert_near(both_paths(network, batch), both_paths(network, batch.without_geometry))


def test_sequential_positions_move_the_actions() -> None:
    """The reason for "parallel": under "sequential" even hidden geometry moves the suffix, and so its output."""
    network = build_network(SEGMENT)
    with torch.no_grad():
        network.paligemma_with_expert.geometry_gate.openness.fill_(0.0)
    batch = Case(seed=6).draw(network.geometry_width)
    assert distance(sample(network, batch), sample(network, batch.without_geometry)) > 1e-3


# --- invariant 6: what the network asks for ---------------------------------------------------------------------------


@pytest.mark.parametrize("geometry", [SEGMENT, PARALLEL, OWN_EXPERT], ids=name_of)
@given(case=cases, causal=st.booleans())
@settings(max_examples=6)
def test_masks_and_positions_of_the_network(geometry: GeometrySegmentConfig, case: Case, causal: bool) -> None:
    """Invariant 6: the masks and positions that training hands to the layers are those of the table."""
    network = shared_network(geometry)
    batch = case.draw(network.geometry_width)
    cells = batch.geom_embs.shape[1]
    geom_att = [1] * cells if causal else one_block(cells)
    calls: list[dict] = []
    hook = network.paligemma_with_expert.register_forward_pre_hook(
        lambda module, args, kwargs: calls.append(kwargs), with_kwargs=True
    )
    network(*batch, geom_att=geom_att if causal else None)
    hook.remove()
    (call,) = calls

    prefix_pad = network.embed_prefix(*batch.observation).pad
    image_pads = [mask[:, None].expand(-1, 4) for mask in batch.img_masks]
    assert torch.equal(prefix_pad, torch.cat([*image_pads, batch.masks], dim=1))
    pads = [prefix_pad, batch.geom_pad, torch.ones(batch.noise.shape[:2], dtype=torch.bool)]
    atts = [[0] * prefix_pad.shape[1], geom_att, one_block(batch.noise.shape[1])]
    assert [p.tolist() for p in call["position_ids"]] == position_table(pads, geometry.positions)
    table, end = mask_table(pads, atts), 0
    for mask, pad in zip(call["attention_mask"], pads, strict=True):
        start, end = end, end + pad.shape[1]
        assert torch.equal(mask.expand(-1, pad.shape[1], -1), table[:, start:end, :end])


def test_geometry_that_joins_the_prefix_is_refused() -> None:
    """Invariant 6: an att_mask of zeros would show geometry to the VLM, in training and in sampling."""
    network = shared_network(SEGMENT)
    batch = Case().draw(network.geometry_width)
    zeros = [0] * batch.geom_embs.shape[1]
    with pytest.raises(ValueError, match="first token of the geometry segment must have att_mask 1"):
        network(*batch, geom_att=zeros)
    with pytest.raises(ValueError, match="first token of the geometry segment must have att_mask 1"):
        sample(network, batch, geom_att=zeros)


def test_causal_geometry_is_another_model() -> None:
    """`geom_att` reaches the attention: cells that see only earlier cells give other actions."""
    network = shared_network(SEGMENT)
    batch = Case(seed=7).draw(network.geometry_width)
    cells = batch.geom_embs.shape[1]
    assert torch.equal(sample(network, batch, geom_att=one_block(cells)), sample(network, batch))
    assert distance(sample(network, batch, geom_att=[1] * cells), sample(network, batch)) > 1e-3


@pytest.mark.parametrize("dtype", [torch.bool, torch.int64, torch.float32])
@pytest.mark.parametrize("batched", [False, True])
@pytest.mark.parametrize("causal", [False, True])
def test_geom_att_may_be_a_tensor(dtype, batched, causal):
    """As other π0.5 code bases pass it: (G,), or (B, G) with equal rows."""
    network = build_network(SEGMENT)
    batch = Case(seed=5, batch=2).draw(network.geometry_width)
    cells = batch.geom_embs.shape[1]
    entries = [1] * cells if causal else one_block(cells)
    given_att = torch.tensor(entries, dtype=dtype)
    given_att = given_att.expand(2, -1) if batched else given_att
    assert torch.equal(sample(network, batch, geom_att=given_att), sample(network, batch, geom_att=entries))
    assert torch.equal(network(*batch, geom_att=given_att), network(*batch, geom_att=entries))


def test_geom_att_with_other_rows_or_another_length_is_refused():
    network = build_network(SEGMENT)
    batch = Case(seed=5, batch=2).draw(network.geometry_width)
    cells = batch.geom_embs.shape[1]
    rows = torch.tensor([one_block(cells), [1] * cells])
    with pytest.raises(ValueError, match="geom_att must have equal rows"):
        network(*batch, geom_att=rows)
    for wrong in (one_block(cells + 1), torch.tensor(one_block(cells + 1))):
        with pytest.raises(ValueError, match=rf"one entry for each of the {cells} geometry tokens, got {cells + 1}"):
            network(*batch, geom_att=wrong)


# --- the public methods -----------------------------------------------------------------------------------------------


@geometries
def test_every_input_matters(geometry: GeometrySegmentConfig) -> None:
    """The tests above compare networks that listen: each input, and its order, changes loss and actions."""
    network = shared_network(geometry)
    batch = Case(seed=8, batch=1, cameras=2, prompt=6).draw(network.geometry_width)
    batch = batch._replace(
        masks=torch.ones_like(batch.masks),
        img_masks=[torch.ones_like(mask) for mask in batch.img_masks],
        geom_pad=torch.ones_like(batch.geom_pad),
    )
    before = both_paths(network, batch)
    for name, changed in {
        "image": batch._replace(images=[-batch.images[0], batch.images[1]]),
        "order of images": batch._replace(images=batch.images[::-1]),
        "image mask": batch._replace(img_masks=[~batch.img_masks[0], batch.img_masks[1]]),
        "order of the prompt": batch._replace(tokens=batch.tokens.flip(1)),
        "noise": batch._replace(noise=batch.noise.flip(1)),
        "geometry": batch._replace(geom_embs=-batch.geom_embs),
        "order of geometry": batch._replace(geom_embs=batch.geom_embs.flip(1)),
        "a hole": batch._replace(geom_pad=torch.cat([~batch.geom_pad[:, :1], batch.geom_pad[:, 1:]], dim=1)),
    }.items():
        for a, b in zip(before, both_paths(network, changed), strict=True):
            assert distance(a, b) > 1e-4, name
    for changed in (batch._replace(time=batch.time / 2), batch._replace(actions=-batch.actions)):
        assert distance(before[0], velocity(network, changed)) > 1e-3


@geometries
@given(case=cases)
@settings(max_examples=3)
def test_a_denoising_step_predicts_the_velocity_of_training(geometry: GeometrySegmentConfig, case: Case) -> None:
    """One Euler step from flow time 1 is the velocity whose error the loss measures: inference and training agree."""
    network = shared_network(geometry)
    batch = case.draw(network.geometry_width)._replace(time=torch.ones(case.batch))
    step = batch.noise - sample(network, batch, num_steps=1)
    assert_near([step], [velocity(network, batch)])


def test_the_loss_is_that_of_the_flow() -> None:
    """The network is shown x_t = t noise + (1 - t) action, and its target is noise - action; nothing is reduced."""
    network = shared_network(SEGMENT)
    batch = Case(seed=9, batch=3).draw(network.geometry_width)
    shown: list[Tensor] = []
    hook = network.action_in_proj.register_forward_pre_hook(lambda module, args: shown.append(args[0]))
    with recorded_outputs([network.action_out_proj]) as velocities:
        loss = network(*batch)
    hook.remove()
    t = batch.time[:, None, None]
    assert_near(shown, [t * batch.noise + (1 - t) * batch.actions])
    assert_near([loss], [(velocities[0] - (batch.noise - batch.actions)).square()])
    assert loss.dtype == torch.float32


@pytest.mark.parametrize("geometry", [None, SEGMENT, PARALLEL, DENOISE, IN_PREFIX, OWN_EXPERT], ids=name_of)
@given(case=cases, samples=st.integers(1, 4))
@settings(max_examples=4)
def test_flow_samples_are_blind_to_each_other(geometry: GeometrySegmentConfig | None, case: Case, samples: int) -> None:
    """K noises and times for one observation give the K losses that they give one at a time."""
    network = shared_network(geometry)
    batch = case.draw(network.geometry_width)
    batch = batch.without_geometry if geometry is None else batch
    generator = torch.Generator().manual_seed(case.seed)
    noise = torch.randn(case.batch, samples, *batch.noise.shape[1:], generator=generator)
    time = torch.rand(case.batch, samples, generator=generator)
    together = network(*batch._replace(noise=noise, time=time))
    assert together.shape == noise.shape
    alone = [network(*batch._replace(noise=noise[:, k], time=time[:, k])) for k in range(samples)]
    assert_near(list(together.unbind(1)), alone)


@pytest.mark.parametrize("geometry", [SEGMENT, PARALLEL, DENOISE], ids=name_of)
def test_denoise_step_from_a_filled_cache(geometry: GeometrySegmentConfig) -> None:
    """The public step equals the velocity of training, with a flow time of its own in each row."""
    network = shared_network(geometry)
    batch = Case(seed=10, batch=2).draw(network.geometry_width)
    with recorded_caches(network) as caches:
        sample(network, batch, num_steps=1)
    prefix = network.embed_prefix(*batch.observation)
    embs = batch.geom_embs.masked_fill(~batch.geom_pad[..., None], 0)
    cells = SegmentTokens(embs, batch.geom_pad, one_block(embs.shape[1]))
    x_t = batch.noise
    step = network.denoise_step(prefix.pad, caches[0], x_t, batch.time, cells)
    assert_near([step], [velocity(network, batch._replace(noise=x_t, actions=x_t))])


def test_noise_is_drawn_when_none_is_given() -> None:
    """A chunk of the configured size, another one each time, and the same one for the same seed."""
    network = shared_network(SEGMENT)
    batch = Case(seed=11).draw(network.geometry_width)
    torch.manual_seed(0)
    first, second = (network.sample_actions(*batch.observation, num_steps=1) for _ in range(2))
    torch.manual_seed(0)
    again = network.sample_actions(*batch.observation, num_steps=1)
    assert first.shape == (2, network.config.chunk_size, network.config.max_action_dim)
    assert torch.equal(first, again)
    assert distance(first, second) > 1e-3


def test_sampling_does_not_depend_on_the_mode() -> None:
    """Training mode, gradient checkpointing and an enclosing enable_grad leave sampled actions as they are."""
    network = build_network(SEGMENT)
    batch = Case(seed=12).draw(network.geometry_width)
    expected = sample(network.eval(), batch)
    network.gradient_checkpointing_enable()
    network.train()
    with torch.enable_grad():
        actions = sample(network, batch)
    assert not actions.requires_grad
    assert torch.equal(actions, expected)


@pytest.mark.parametrize("use_cache", [True, False])
def test_real_time_chunking(use_cache: bool) -> None:
    """LeRobot's RTC runs the step under enable_grad: it works with the cache, and pulls towards the previous chunk."""
    network = build_network(SEGMENT)
    batch = Case(seed=13, batch=2, chunk=8).draw(network.geometry_width)
    free = sample(network, batch, use_cache=use_cache)
    network.rtc_processor = RTCProcessor(RTCConfig(enabled=True, execution_horizon=6))
    with recorded_outputs([network.action_out_proj]) as velocities:
        guided = sample(
            network,
            batch,
            use_cache=use_cache,
            inference_delay=4,
            prev_chunk_left_over=batch.actions[:, :6],
            execution_horizon=6,
        )
    assert not any(v.requires_grad for v in velocities)  # else each cache write would keep the graph of the last
    frozen = slice(0, 4)
    distance_to_previous = [(a[:, frozen] - batch.actions[:, frozen]).norm() for a in (guided, free)]
    assert distance_to_previous[0] < 0.5 * distance_to_previous[1]


def test_geometry_without_a_place_is_refused() -> None:
    """A network built without geometry cannot use any, and tokens of another width fit nowhere."""
    batch = Case().draw(24)
    with pytest.raises(ValueError, match="built without geometry"):
        shared_network(None)(*batch)
    with pytest.raises(ValueError, match="need width 32, got 24"):
        shared_network(IN_PREFIX)(*batch)


def test_variants_that_cannot_share_attention_are_refused() -> None:
    """The VLM and the action expert need the same depth and heads, and the image whole patches."""
    sizes = {"image_size": 28, "chunk_size": 5, "max_action_dim": 6}
    with pytest.raises(ValueError, match="need the same depth; got 3 and 4"):
        NetworkConfig(PALIGEMMA_VARIANTS["tiny"], EXPERT_VARIANTS["small"], **sizes)
    with pytest.raises(ValueError, match="multiple of the vision tower's patch size 14, got 30"):
        NetworkConfig(PALIGEMMA_VARIANTS["tiny"], EXPERT_VARIANTS["tiny"], **(sizes | {"image_size": 30}))


def test_the_prefix_is_images_then_text() -> None:
    """P tokens of one block, zeros where there is padding; the geometry placement does not touch it."""
    network = shared_network(SEGMENT)
    batch = Case(seed=14, cameras=3, prompt=5).draw(network.geometry_width)
    prefix = network.embed_prefix(*batch.observation)
    assert prefix.embs.shape == (2, 3 * 4 + 5, 32)
    assert prefix.att == [0] * 17
    assert (prefix.embs[~prefix.pad] == 0).all()
    assert (prefix.embs[prefix.pad] != 0).any(dim=-1).all()
    assert Segment.PREFIX < Segment.GEOMETRY < Segment.SUFFIX
