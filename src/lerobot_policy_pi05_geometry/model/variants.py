"""Named network sizes.

`gemma_2b` + `gemma_300m` is the released π0.5 (openpi `gemma.py: get_config`; SigLIP So400m/14 and PaliGemma's
vocabulary of 257,152 tokens). `small` is a policy that learns a simulated task on two CPU cores in minutes, `tiny`
is for tests. A VLM variant brings its own vision tower and vocabulary; an expert must have its VLM's depth and heads,
because both share one attention.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class GemmaVariant:
    """Sizes of one Gemma transformer."""

    width: int
    depth: int
    mlp_dim: int
    num_heads: int
    num_kv_heads: int
    head_dim: int


@dataclass(frozen=True)
class VisionVariant:
    """Sizes of one SigLIP vision tower."""

    width: int
    depth: int
    mlp_dim: int
    num_heads: int
    patch_size: int


@dataclass(frozen=True)
class PaliGemmaVariant:
    """A vision-language model: SigLIP, a linear projector, Gemma and a vocabulary."""

    gemma: GemmaVariant
    vision: VisionVariant
    vocab_size: int


PALIGEMMA_VARIANTS = {
    "gemma_2b": PaliGemmaVariant(
        gemma=GemmaVariant(width=2048, depth=18, mlp_dim=16_384, num_heads=8, num_kv_heads=1, head_dim=256),
        vision=VisionVariant(width=1152, depth=27, mlp_dim=4304, num_heads=16, patch_size=14),
        vocab_size=257_152,
    ),
    "small": PaliGemmaVariant(
        gemma=GemmaVariant(width=128, depth=4, mlp_dim=256, num_heads=8, num_kv_heads=1, head_dim=16),
        vision=VisionVariant(width=128, depth=3, mlp_dim=256, num_heads=4, patch_size=14),
        vocab_size=1024,
    ),
    "tiny": PaliGemmaVariant(
        gemma=GemmaVariant(width=32, depth=3, mlp_dim=64, num_heads=8, num_kv_heads=1, head_dim=8),
        vision=VisionVariant(width=32, depth=2, mlp_dim=48, num_heads=2, patch_size=14),
        vocab_size=1024,
    ),
}

EXPERT_VARIANTS = {
    "gemma_300m": GemmaVariant(width=1024, depth=18, mlp_dim=4096, num_heads=8, num_kv_heads=1, head_dim=256),
    "small": GemmaVariant(width=128, depth=4, mlp_dim=256, num_heads=8, num_kv_heads=1, head_dim=16),
    "tiny": GemmaVariant(width=24, depth=3, mlp_dim=48, num_heads=8, num_kv_heads=1, head_dim=8),
}
