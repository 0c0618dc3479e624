"""The transformer block of Depth Anything 3: DINOv2's, with QK-norm and rotary positions in the later blocks."""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

_ROPE_BASE = 100.0
_NORM_EPS = 1e-6  # of the blocks; the final norm and the QK-norms have torch's default, 1e-5


def rotary_table(places: Tensor, head_dim: int) -> Tensor:
    """Angles of 2-D rotary positions: places (N, 2), row and column -> (N, 2, head_dim / 4) float32.

    One half of a head turns with the row, the other with the column.
    """
    half = head_dim // 2
    exponents = torch.arange(0, half, 2, device=places.device).float() / half
    return places.float()[..., None] / _ROPE_BASE**exponents


def rotate(x: Tensor, table: Tensor) -> Tensor:
    """Turn x (..., N, head_dim) by the angles of `rotary_table`; the dtype of x is kept."""
    first, second = x.unflatten(-1, (2, 2, -1)).unbind(-2)  # (..., N, 2, head_dim / 4) each
    cos, sin = table.cos(), table.sin()
    return torch.stack([first * cos - second * sin, second * cos + first * sin], dim=-2).flatten(-3).to(x.dtype)


class Attention(nn.Module):
    """Multi-head self-attention without a mask; x (B, N, D) -> (B, N, D)."""

    def __init__(self, width: int, heads: int, qk_norm: bool) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        if qk_norm:
            self.q_norm = nn.LayerNorm(width // heads)
            self.k_norm = nn.LayerNorm(width // heads)
        self.qk_norm = qk_norm
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor, table: Tensor | None) -> Tensor:
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)  # (B, heads, N, head_dim) each
        if self.qk_norm:  # in float32: autocast on CPU would not see to it
            q, k = self.q_norm(q.float()), self.k_norm(k.float())
        if table is not None:
            q, k = rotate(q, table), rotate(k, table)
        attended = F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v)
        return self.proj(attended.transpose(1, 2).flatten(2))


class Mlp(nn.Module):
    """Two layers with GELU between."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, 4 * width)
        self.fc2 = nn.Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(x)))


class SwiGlu(nn.Module):
    """Gated MLP; its hidden width is two thirds of the plain one's, rounded up to a multiple of 8."""

    def __init__(self, width: int) -> None:
        super().__init__()
        hidden = (int(4 * width * 2 / 3) + 7) // 8 * 8
        self.w12 = nn.Linear(width, 2 * hidden)
        self.w3 = nn.Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        gate, value = self.w12(x).chunk(2, dim=-1)
        return self.w3(F.silu(gate) * value)


class LayerScale(nn.Module):
    """A learned factor per channel on a block's update."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.gamma


class Block(nn.Module):
    """Pre-norm attention and MLP, each with a layer scale; x (B, N, D) -> (B, N, D)."""

    def __init__(self, width: int, heads: int, qk_norm: bool, swiglu: bool) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=_NORM_EPS)
        self.attn = Attention(width, heads, qk_norm)
        self.ls1 = LayerScale(width)
        self.norm2 = nn.LayerNorm(width, eps=_NORM_EPS)
        self.mlp = SwiGlu(width) if swiglu else Mlp(width)
        self.ls2 = LayerScale(width)

    def forward(self, x: Tensor, table: Tensor | None) -> Tensor:
        x = x + self.ls1(self.attn(self.norm1(x), table))
        return x + self.ls2(self.mlp(self.norm2(x)))
