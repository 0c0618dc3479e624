"""Attention computes one thing in two ways; both must equal the definition."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from lerobot_policy_pi05_geometry.model.attention import Attention, apply_rotary, attention_weights, rotary_table

HEAD_DIM = 8


def inputs(seed: int, heads: int, kv_heads: int, mask_rows: int | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """q, k, v and a mask with one row for all queries or one each; the last key is always visible."""
    generator = torch.Generator().manual_seed(seed)
    queries, keys = 4, 7
    q = torch.randn(3, heads, queries, HEAD_DIM, generator=generator)
    k = torch.randn(3, kv_heads, keys, HEAD_DIM, generator=generator)
    v = torch.randn(3, kv_heads, keys, HEAD_DIM, generator=generator)
    mask = torch.rand(3, mask_rows or queries, keys, generator=generator) < 0.6
    mask[..., -1] = True
    return q, k, v, mask


def definition(q: Tensor, k: Tensor, v: Tensor, mask: Tensor, bias: Tensor | None) -> Tensor:
    """softmax(q k^T / sqrt(D) + bias) v, query by query, over the visible keys only, in float64."""
    result = torch.zeros_like(q, dtype=torch.float64)
    per_key_head = q.shape[1] // k.shape[1]
    for b in range(q.shape[0]):
        for h in range(q.shape[1]):
            for i in range(q.shape[2]):
                seen = mask[b, i if mask.shape[1] > 1 else 0]
                keys, values = k[b, h // per_key_head].double()[seen], v[b, h // per_key_head].double()[seen]
                scores = keys @ q[b, h, i].double() / HEAD_DIM**0.5
                if bias is not None:
                    scores = scores + bias[h].double()[seen]
                result[b, h, i] = scores.softmax(0) @ values
    return result


@given(
    seed=st.integers(0, 1000),
    heads=st.sampled_from([(8, 1), (8, 2), (2, 2), (4, 1)]),
    mask_rows=st.sampled_from([1, None]),
    biased=st.booleans(),
)
def test_both_paths_equal_the_definition(
    seed: int, heads: tuple[int, int], mask_rows: int | None, biased: bool
) -> None:
    """Written-out products (a gradient is needed, on the CPU) and SDPA (none is), with shared key heads and a bias."""
    q, k, v, mask = inputs(seed, *heads, mask_rows)
    bias = torch.randn(heads[0], k.shape[2], generator=torch.Generator().manual_seed(seed)) if biased else None
    written_out = Attention()(q.requires_grad_(), k, v, mask, bias)
    with torch.no_grad():
        fused = Attention()(q, k, v, mask, bias)
    expected = definition(q.detach(), k, v, mask, bias)
    assert written_out.requires_grad
    torch.testing.assert_close(written_out, fused, rtol=0, atol=1e-6)
    torch.testing.assert_close(fused, expected.float(), rtol=0, atol=1e-6)


def test_gradients_of_both_paths_agree() -> None:
    """A trained gate takes the written-out path, a constant one may take the other: q, k and v learn the same."""
    q, k, v, mask = inputs(1, 8, 2, 1)
    weight = torch.randn_like(q)
    bias = torch.randn(8, k.shape[2])
    gradients = []
    for attend in (Attention(), _fused):
        leaves = [x.clone().requires_grad_() for x in (q, k, v)]
        (attend(*leaves, mask, bias) * weight).sum().backward()
        gradients.append([x.grad for x in leaves])
    torch.testing.assert_close(gradients[0], gradients[1], rtol=0, atol=1e-5)


def _fused(q: Tensor, k: Tensor, v: Tensor, mask: Tensor, bias: Tensor) -> Tensor:
    additive = torch.where(mask[:, None], bias[:, None], float("-inf"))
    return torch.nn.functional.scaled_dot_product_attention(q, k, v, attn_mask=additive, enable_gqa=True)


def test_the_gate_gets_a_gradient() -> None:
    """A bias that is a parameter is learned, also where nothing else is."""
    q, k, v, mask = inputs(2, 8, 1, 1)
    bias = torch.zeros(8, k.shape[2], requires_grad=True)
    Attention()(q, k, v, mask, bias).square().sum().backward()
    visible = mask.any(dim=0)[0]
    assert (bias.grad[:, visible] != 0).all()
    assert (bias.grad[:, ~visible] == 0).all()


def test_the_gate_keeps_its_digits_in_bf16() -> None:
    """A bias of 20.06 would be 20 in bf16: the softmax over two keys must still tell it from 20."""
    q, k = torch.zeros(1, 1, 1, HEAD_DIM, dtype=torch.bfloat16), torch.zeros(1, 1, 2, HEAD_DIM, dtype=torch.bfloat16)
    v = torch.tensor([1.0, 0.0], dtype=torch.bfloat16)[:, None].expand(1, 1, 2, HEAD_DIM)
    mask, bias = torch.ones(1, 1, 2, dtype=torch.bool), torch.tensor([[20.06, 20.0]])
    for needs_grad in (False, True):
        attended = Attention()(q.requires_grad_(needs_grad), k, v, mask, bias)
        assert attended.dtype == torch.bfloat16
        assert attended.unique().item() == pytest.approx(torch.tensor(0.06).sigmoid().item(), abs=0.003)


def test_weights_are_the_softmax() -> None:
    """`attention_weights` sum to one over the visible keys and give the rest nothing."""
    q, k, _, mask = inputs(3, 8, 2, None)
    weights = attention_weights(q, k, mask)
    torch.testing.assert_close(weights.sum(-1), torch.ones(weights.shape[:-1]), rtol=0, atol=1e-6)
    assert (weights[~mask[:, None].expand_as(weights)] == 0).all()


@pytest.mark.parametrize("shift", [1, 5, 100])
def test_rotary_depends_on_distance_alone(shift: int) -> None:
    """Scores of rotated queries and keys stay when both move; they change when one does."""
    generator = torch.Generator().manual_seed(0)
    q, k = (torch.randn(1, 1, 1, HEAD_DIM, generator=generator) for _ in range(2))

    def score(query_position: int, key_position: int) -> Tensor:
        turned = [
            apply_rotary(x, *rotary_table(torch.tensor([[position]]), HEAD_DIM))
            for x, position in ((q, query_position), (k, key_position))
        ]
        return (turned[0] * turned[1]).sum()

    torch.testing.assert_close(score(7, 3), score(7 + shift, 3 + shift), rtol=0, atol=1e-4)
    assert (score(7, 3) - score(7 + shift, 3)).abs() > 1e-3
