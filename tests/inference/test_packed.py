"""Packed matrices: the products of those that they were made of, and packed only where it is said."""

import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.inference.fused_weights import fuse, pack_joined
from lerobot_policy_pi05_geometry.inference.packed import linear, pack, why_not_packed
from lerobot_policy_pi05_geometry.inference.runner import ChunkRunner
from lerobot_policy_pi05_geometry.inference.sampler import ChunkSampler
from lerobot_policy_pi05_geometry.model.segments import Segment
from tests.model.helpers import OWN_EXPERT, SEGMENT, build_network

NOT_HERE = why_not_packed("cpu", torch.bfloat16)
needs_packing = pytest.mark.skipif(NOT_HERE is not None, reason=f"needs a CPU and a PyTorch that pack: {NOT_HERE}")
sizes = st.integers(1, 40)


@needs_packing
@given(
    batch=st.integers(1, 3), tokens=sizes, width=sizes, out=st.integers(2, 200), seed=st.integers(0, 99), data=st.data()
)
@settings(max_examples=60, deadline=None)
def test_products_are_those_of_the_matrix(batch, tokens, width, out, seed, data) -> None:
    """For any number of tokens, whatever number it was packed for; rows from any one on."""
    generator = torch.Generator().manual_seed(seed)
    matrix = torch.randn(out, width, generator=generator).bfloat16()
    x = torch.randn(batch, tokens, width, generator=generator).bfloat16()
    first = data.draw(st.integers(0, out - 1))
    packed = pack(matrix, data.draw(sizes))
    assert packed.is_mkldnn
    whole = F.linear(x, matrix)
    assert torch.allclose(linear(x, packed, first), whole[..., first:], rtol=1e-2, atol=1e-2)
    assert torch.allclose(linear(x, matrix, first), whole[..., first:], rtol=1e-2, atol=1e-2)


@needs_packing
def test_the_expert_that_denoises_is_packed_and_nothing_else() -> None:
    network = build_network(OWN_EXPERT, dtype=torch.bfloat16, param_dtype=torch.bfloat16).eval()
    layers = ChunkRunner(network)._layers
    for segment, of_segment in layers.items():
        for layer in of_segment:
            packed = [name for name, matrix in vars(layer).items() if matrix is not None and matrix.is_mkldnn]
            assert packed == (["qkv", "gate_up"] if segment is Segment.SUFFIX else [])


@pytest.mark.parametrize(("kernels", "dtype"), [("cpu", torch.float32), ("cuda", torch.bfloat16)])
def test_nothing_else_is_packed(kernels: str, dtype: torch.dtype) -> None:
    assert why_not_packed(kernels, dtype) == "only a CPU in bfloat16 gains by it"


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_explain_tells(dtype: torch.dtype) -> None:
    told = ChunkSampler(build_network(SEGMENT, dtype=dtype).eval()).explain()["packing"]
    assert told.startswith("declined") == (why_not_packed("cpu", dtype) is not None)


def test_packing_is_declined_where_pytorch_cannot(monkeypatch) -> None:
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
    assert why_not_packed("cpu", torch.bfloat16) == "this PyTorch lacks the operations"
    network = build_network(SEGMENT, dtype=torch.bfloat16).eval()
    assert not any(layer.qkv.is_mkldnn for layer in ChunkRunner(network)._layers[Segment.SUFFIX])


def test_only_joined_matrices_are_packed() -> None:
    layer = fuse(build_network(SEGMENT).paligemma_with_expert.expert, torch.float32)[0]
    marked = pack_joined(layer, lambda matrix: matrix + 1)
    changed = {name for name, matrix in vars(marked).items() if matrix is not vars(layer)[name]}
    assert changed == {"qkv", "gate_up"}
