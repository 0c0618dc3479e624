"""The sizes in which Depth Anything 3 is released, their licences, and which of them a file holds."""

from collections.abc import Mapping
from dataclasses import dataclass

PATCH = 14  # pixels per side of a patch
POSITIONS = 37  # patches per side of the learned position embedding (518 px)

BACKBONE_PREFIX = "model.backbone.pretrained."
# What else a released file holds: depth head, camera encoder and decoder, Gaussian splatting. None of it is used here.
OTHER_PREFIXES = ("model.head.", "model.cam_enc.", "model.cam_dec.", "model.gs_head.", "model.gs_adapter.")
_NESTED_PREFIX = "model.da3."


@dataclass(frozen=True)
class Da3Variant:
    """One size.

    width, depth, heads: of the transformer. out_layers: blocks whose output the depth head reads; the last one's is used
    here. alt_start: first block with QK-norm, rotary positions and attention across views, or None for a single-view
    model. swiglu: a gated MLP instead of a plain one. non_commercial: released under CC BY-NC 4.0 instead of Apache-2.0.
    """

    name: str
    width: int
    depth: int
    heads: int
    out_layers: tuple[int, ...]
    alt_start: int | None
    swiglu: bool = False
    non_commercial: bool = False

    @property
    def feature_dim(self) -> int:
        """Any-view models give the last within-view block's output beside the last block's."""
        return self.width if self.alt_start is None else 2 * self.width


VARIANTS = {
    variant.name: variant
    for variant in (
        Da3Variant("tiny", 32, 6, 2, (3, 5), 2),  # for tests; not a released size
        Da3Variant("small", 384, 12, 6, (5, 7, 9, 11), 4),
        Da3Variant("base", 768, 12, 12, (5, 7, 9, 11), 4),
        Da3Variant("large", 1024, 24, 16, (11, 15, 19, 23), 8, non_commercial=True),
        Da3Variant("giant", 1536, 40, 24, (19, 27, 33, 39), 13, swiglu=True, non_commercial=True),
        # DA3MONO-LARGE and DA3METRIC-LARGE differ in their heads only.
        Da3Variant("mono-large", 1024, 24, 16, (4, 11, 17, 23), None),
    )
}


def variant_of(shapes: Mapping[str, tuple[int, ...]], origin: str) -> Da3Variant:
    """Which variant a file holds, from its tensors' names and shapes. origin: the file, for the message.

    Strict loading checks everything else. Raises ValueError for a file of another kind.
    """
    if any(name.startswith(_NESTED_PREFIX) for name in shapes):
        raise ValueError(
            f"{origin} is a nested Depth Anything 3 (CC BY-NC 4.0), which is not supported: its metric half only gives "
            "depth; use its any-view half, depth-anything/DA3-GIANT, or the default depth-anything/DA3-BASE."
        )
    width = shapes.get(f"{BACKBONE_PREFIX}cls_token", (0,))[-1]
    any_view = f"{BACKBONE_PREFIX}camera_token" in shapes
    for variant in VARIANTS.values():
        if variant.width == width and (variant.alt_start is not None) == any_view:
            return variant
    raise ValueError(
        f"{origin} holds no Depth Anything 3 encoder of a known size: expected {BACKBONE_PREFIX}cls_token of width "
        f"{', '.join(str(variant.width) for variant in VARIANTS.values())}, found {width or 'no such tensor'}."
    )
