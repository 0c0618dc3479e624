"""One Gemma transformer layer of one segment: the same code trains, prefills and denoises.

A segment sees whole earlier segments and itself, never a later one. So a layer runs segment by segment: each computes
its own queries, keys and values, attends to the keys of the earlier segments and its own, and returns both. The keys of
earlier segments are concatenated in training and read from a preallocated cache at inference.

Parameter names are those of LeRobot's π0.5. Shapes: B batch, N tokens of the segment, W width, H heads, KV key/value
heads, D head_dim, K keys up to the segment's end.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from .attention import Attention, apply_rotary
from .norms import AdaRMSNorm, add_residual, make_norm
from .precision import Float32Linear
from .segment_cache import CacheSlot
from .variants import GemmaVariant


class KeysValues(NamedTuple):
    """Keys and values up to the end of a segment, each (B, KV, K, D)."""

    keys: Tensor
    values: Tensor


class GemmaAttention(nn.Module):
    """Projections of a layer's attention, and the attention itself."""

    def __init__(self, variant: GemmaVariant) -> None:
        super().__init__()
        self.head_dim = variant.head_dim
        q_dim, kv_dim = variant.num_heads * variant.head_dim, variant.num_kv_heads * variant.head_dim
        self.q_proj = nn.Linear(variant.width, q_dim, bias=False)
        self.k_proj = nn.Linear(variant.width, kv_dim, bias=False)
        self.v_proj = nn.Linear(variant.width, kv_dim, bias=False)
        self.o_proj = nn.Linear(q_dim, variant.width, bias=False)
        self.attention = Attention()

    def heads(self, projected: Tensor) -> Tensor:
        """(B, N, heads * D) -> (B, heads, N, D)."""
        return projected.unflatten(-1, (-1, self.head_dim)).transpose(1, 2)


class GemmaMLP(nn.Module):
    """Gated GELU feed-forward, (B, N, W) -> (B, N, W)."""

    def __init__(self, variant: GemmaVariant) -> None:
        super().__init__()
        self.gate_proj = nn.Linear(variant.width, variant.mlp_dim, bias=False)
        self.up_proj = nn.Linear(variant.width, variant.mlp_dim, bias=False)
        self.down_proj = nn.Linear(variant.mlp_dim, variant.width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return self.down_proj(F.gelu(self.gate_proj(x), approximate="tanh") * self.up_proj(x))


class GemmaLayer(nn.Module):
    """Attention and feed-forward of one segment in one layer; `cond_dim` makes its norms adaptive."""

    def __init__(self, variant: GemmaVariant, cond_dim: int | None) -> None:
        super().__init__()
        self.self_attn = GemmaAttention(variant)
        self.mlp = GemmaMLP(variant)
        self.input_layernorm = make_norm(variant.width, cond_dim)
        self.post_attention_layernorm = make_norm(variant.width, cond_dim)

    def forward(
        self,
        x: Tensor,
        rotary: tuple[Tensor, Tensor],
        mask: Tensor,
        cond: Tensor | None = None,
        bias: Tensor | None = None,
        earlier: KeysValues | None = None,
        slot: CacheSlot | None = None,
        output: bool = True,
    ) -> tuple[Tensor | None, KeysValues]:
        """Run the segment through the layer.

        x (B, N, W); rotary as `rotary_table` gives it; mask (B, 1 or N, K) bool; cond as in `AdaRMSNorm`;
        bias (H, K) float32; earlier: keys and values of the earlier segments, where there is no cache; slot: the
        segment's slot in the cache; output=False stops after the keys and values, since nothing reads the output of the
        last layer of prefix and geometry.

        Returns the hidden states (B, N, W) or None, and the keys and values up to the segment's end.
        """
        attn = self.self_attn
        normed, gate = self.input_layernorm(x, cond)
        keys = apply_rotary(attn.heads(attn.k_proj(normed)), *rotary)
        values = attn.heads(attn.v_proj(normed))
        if slot is not None:
            seen = KeysValues(*slot.write(keys, values))
        elif earlier is not None:
            seen = KeysValues(torch.cat([earlier.keys, keys], dim=2), torch.cat([earlier.values, values], dim=2))
        else:
            seen = KeysValues(keys, values)
        if not output:
            return None, seen

        queries = apply_rotary(attn.heads(attn.q_proj(normed)), *rotary)
        attended = attn.attention(queries, seen.keys, seen.values, mask, bias)  # (B, H, N, D)
        x = add_residual(x, attn.o_proj(attended.transpose(1, 2).flatten(2)), gate)
        normed, gate = self.post_attention_layernorm(x, cond)
        return add_residual(x, self.mlp(normed), gate), seen


class GemmaModel(nn.Module):
    """The parameters of one Gemma transformer; `PaliGemmaWithExpert` runs its layers.

    `vocab_size` adds the token embedding, `cond_dim` makes the norms adaptive. No `lm_head` is built: π0.5 never reads
    one, and LeRobot spends 19 % of its memory on two.
    """

    def __init__(self, variant: GemmaVariant, vocab_size: int | None = None, cond_dim: int | None = None) -> None:
        super().__init__()
        self.variant = variant
        if vocab_size is not None:
            self.embed_tokens = nn.Embedding(vocab_size, variant.width)
        self.layers = nn.ModuleList(GemmaLayer(variant, cond_dim) for _ in range(variant.depth))
        self.norm = make_norm(variant.width, cond_dim)
        self.apply(_init_weights)

    def embed(self, tokens: Tensor) -> Tensor:
        """Token ids (B, L) -> embeddings (B, L, W) times sqrt(W), as Gemma does."""
        embeddings = self.embed_tokens(tokens)
        return embeddings * torch.tensor(self.variant.width**0.5, dtype=embeddings.dtype)

    @torch.no_grad()
    def initialise_number_embeddings(self, ids: Sequence[int]) -> None:
        """Set the embeddings of the tokens 0, 1, 2, ... to sines and cosines of the number, at the scale of the others.

        ids: token id of each number. A pretrained VLM knows that 12 lies between 11 and 13. A VLM from scratch has to learn
        this for each number separately, and π0.5 writes the state into the prompt as numbers.
        """
        numbers, width = len(ids), self.variant.width
        periods = 2 * numbers / 2 ** torch.linspace(0, 6, width // 2)  # from twice the range to a 32nd of it
        angles = 2 * math.pi * torch.arange(numbers)[:, None] / periods
        waves = torch.cat([angles.sin(), angles.cos()], dim=1) * (2 / width) ** 0.5  # each row has length 1
        self.embed_tokens.weight[torch.tensor(ids)] = waves.to(self.embed_tokens.weight)

    def freeze_unread_output(self) -> None:
        """Freeze the parameters that nothing reads when only the keys and values of the last layer are used.

        They load and save like all others. As trainable parameters without a gradient they would make DDP fail.
        """
        last = self.layers[-1]
        for module in (
            last.self_attn.q_proj,
            last.self_attn.o_proj,
            last.mlp,
            last.post_attention_layernorm,
            self.norm,
        ):
            module.requires_grad_(False)


def _init_weights(module: nn.Module) -> None:
    """Normal with variance 1 / fan-in (0.022 at the VLM's width); norms start at zero, so that adaRMS is the identity."""
    if isinstance(module, nn.Embedding) or (isinstance(module, nn.Linear) and not isinstance(module, Float32Linear)):
        nn.init.normal_(module.weight, std=module.weight.shape[1] ** -0.5)
    elif isinstance(module, AdaRMSNorm):
        nn.init.zeros_(module.dense.weight)
        nn.init.zeros_(module.dense.bias)
