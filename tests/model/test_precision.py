"""What stays in float32, and how far bfloat16 takes the results."""

import pytest
import torch
from torch import Tensor, nn

from lerobot_policy_pi05_geometry.model import PI05Pytorch
from lerobot_policy_pi05_geometry.model.norms import AdaRMSNorm, RMSNorm
from lerobot_policy_pi05_geometry.model.precision import Float32Linear, compute_in
from lerobot_policy_pi05_geometry.model.segment_gate import GeometryGate

from .helpers import (
    OWN_EXPERT,
    PARALLEL,
    SEGMENT,
    Batch,
    Case,
    build_network,
    name_of,
    randomise,
    recorded_caches,
    recorded_outputs,
    sample,
)

BF16 = torch.bfloat16
# bfloat16 keeps 8 bits of mantissa, 0.4 % of a number; over three layers of this size that adds up to some percent.
BF16_TOLERANCE = 0.05
storages = pytest.mark.parametrize("param_dtype", [torch.float32, BF16], ids=["float32 storage", "bf16 storage"])


def pair(param_dtype: torch.dtype, geometry=SEGMENT) -> tuple[PI05Pytorch, PI05Pytorch, Batch]:
    """A float32 network, its bf16 twin (its weights rounded where it stores bf16), and a batch."""
    reference = build_network(geometry, seed=1)
    lower = build_network(geometry, dtype=BF16, param_dtype=param_dtype)
    lower.load_state_dict(reference.state_dict())
    reference.load_state_dict(lower.state_dict())
    return reference, lower, Case(seed=1, batch=3, cameras=2).draw(reference.geometry_width)


def relative(a: Tensor, b: Tensor) -> float:
    """Size of the difference in units of the size of b."""
    return ((a - b).norm() / b.norm()).item()


@storages
@pytest.mark.parametrize("geometry", [SEGMENT, PARALLEL, OWN_EXPERT], ids=name_of)
def test_bf16_stays_near_float32(param_dtype: torch.dtype, geometry) -> None:
    """Loss and actions come out in float32, near those of float32 compute, and are really computed in bf16."""
    reference, lower, batch = pair(param_dtype, geometry)
    for found, expected in ((lower(*batch), reference(*batch)), (sample(lower, batch), sample(reference, batch))):
        assert found.dtype == torch.float32
        assert 1e-4 < relative(found, expected) < BF16_TOLERANCE


@storages
def test_caching_is_exact_enough_in_bf16(param_dtype: torch.dtype) -> None:
    """The cache holds the compute dtype: reading it back loses nothing that the uncached loop has."""
    _, lower, batch = pair(param_dtype)
    with recorded_caches(lower) as caches:
        cached = sample(lower, batch)
    assert caches[0].keys.dtype == caches[0].values.dtype == BF16
    assert relative(cached, sample(lower, batch, use_cache=False)) < BF16_TOLERANCE / 5


@storages
def test_float32_modules_stay_float32(param_dtype: torch.dtype) -> None:
    """Norms of every kind, gate, action projections and the flow-time MLP are stored in float32, the rest as told."""
    network = build_network(OWN_EXPERT, dtype=BF16, param_dtype=param_dtype)
    exempt = set()
    for name, module in network.named_modules():
        stays = isinstance(module, RMSNorm | Float32Linear | GeometryGate | nn.LayerNorm)
        for leaf, parameter in module.named_parameters(prefix=name, recurse=False):
            assert parameter.dtype == (torch.float32 if stays else param_dtype), leaf
            exempt |= {leaf} if stays else set()
    for part in (
        "language_model.norm.weight",
        "gemma_expert.model.norm.dense.weight",
        "geometry_expert.layers.0.input_layernorm.dense.bias",
        "vision_model.post_layernorm.weight",
        "openness",
        "action_in_proj.weight",
        "action_out_proj.bias",
        "time_mlp_in.weight",
        "time_mlp_out.weight",
    ):
        assert any(name.endswith(part) for name in exempt), part


@storages
def test_intermediate_dtypes(param_dtype: torch.dtype) -> None:
    """Float32 linears give float32 under bf16 compute; layers pass bf16 on; norms return their input's dtype."""
    network = build_network(SEGMENT, dtype=BF16, param_dtype=param_dtype)
    inner = network.paligemma_with_expert
    batch = Case(seed=2).draw(network.geometry_width)
    islands = [m for m in network.modules() if isinstance(m, Float32Linear)]
    layers = [*inner.language_model.layers, *inner.expert.layers]
    mlps = [layer.mlp for layer in layers]
    norms = [m for m in network.modules() if isinstance(m, RMSNorm | AdaRMSNorm)]
    for run in (lambda: network(*batch), lambda: sample(network, batch)):
        with (
            recorded_outputs(islands) as precise,
            recorded_outputs(layers) as hidden,
            recorded_outputs(mlps) as multiplied,
            recorded_outputs(norms) as normed,
        ):
            run()
        assert {output.dtype for output in precise} == {torch.float32}
        assert {output.dtype for output in multiplied} == {BF16}
        assert {x.dtype for x, _ in hidden if x is not None} == {BF16}
        assert {x.dtype for x, _ in normed} == {BF16}
        assert {tensor.dtype for _, seen in hidden for tensor in seen} == {BF16}


def test_a_callers_autocast_does_not_matter() -> None:
    """`dtype` decides: LeRobot's evaluation may run a float32 policy under bf16 autocast, and the other way round."""
    for dtype in (torch.float32, BF16):
        network = build_network(SEGMENT, dtype=dtype)
        batch = Case(seed=3).draw(network.geometry_width)
        loss, actions = network(*batch), sample(network, batch)
        for enabled in (True, False):
            with torch.autocast("cpu", dtype=BF16, enabled=enabled):
                assert torch.equal(network(*batch), loss)
                assert torch.equal(sample(network, batch), actions)


def test_float32_linear_is_an_island() -> None:
    """Stored, computed and returned in float32 under autocast, for an input of any dtype."""
    linear = Float32Linear(64, 3)
    x = torch.randn(5, 64).to(BF16)
    with compute_in(BF16, x.device):
        inside, rounded = linear(x), nn.functional.linear(x, linear.weight, linear.bias)
        after = x.float() @ linear.weight.T
    assert inside.dtype == torch.float32
    assert torch.equal(inside, linear(x.float()))
    assert rounded.dtype == after.dtype == BF16  # autocast was on, and is on again


def test_norms_are_computed_in_float32() -> None:
    """Mean square and scale are taken in float32 and rounded once, whatever the dtype of the input."""
    x = torch.randn(3, 50, 64, generator=torch.Generator().manual_seed(0)).to(BF16)
    cond = torch.randn(3, 16, generator=torch.Generator().manual_seed(1))
    for norm in (RMSNorm(64), AdaRMSNorm(64, 16)):
        randomise(norm, seed=2)
        with compute_in(BF16, x.device):
            found, _ = norm(x, cond)
        assert torch.equal(found, norm(x.float(), cond)[0].to(BF16))


def test_adaptive_norm_keeps_small_scales() -> None:
    """The scale 1 + w of a norm keeps a w that bf16 would round away."""
    norm = AdaRMSNorm(8, 4)
    nn.init.constant_(norm.dense.bias, 2**-12)
    x = torch.ones(1, 1, 8)
    with compute_in(BF16, x.device):
        normed, gate = norm(x, torch.zeros(1, 4))
    torch.testing.assert_close(normed, torch.full_like(x, 1 + 2 * 2**-12), rtol=0, atol=1e-6)
    assert gate.unique().tolist() == [2**-12]
    with pytest.raises(ValueError, match="adarms_cond"):
        norm(x)


def test_training_in_bf16_reaches_float32_gradients() -> None:
    """Under bf16 compute with float32 storage every gradient is float32 and near that of float32 compute."""
    reference, lower, batch = pair(torch.float32)
    for network in (reference, lower):
        network(*batch).mean().backward()
    expected = {name: p.grad for name, p in reference.named_parameters() if p.grad is not None}
    found = {name: p.grad for name, p in lower.named_parameters() if p.grad is not None}
    assert found.keys() == expected.keys()
    assert {gradient.dtype for gradient in found.values()} == {torch.float32}
    together = [torch.cat([gradients[name].flatten() for name in expected]) for gradients in (found, expected)]
    assert relative(*together) < BF16_TOLERANCE
