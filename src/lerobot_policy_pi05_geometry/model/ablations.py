"""Options of the network that experiments compare with its default. To train or run a policy, leave them as they are."""

from dataclasses import dataclass, fields

from .config import GeometrySegmentConfig


@dataclass
class AblationSettings:
    """Fields of the policy's configuration, so that `--policy.geometry_time=denoise` and its like work, and are saved.

    The control among the sources, `geometry_source=random` (geometry/random_tokens.py), belongs to them in purpose.
    `GeometrySegmentConfig` says what each value does.
    """

    geometry_time: str = "clean"  # flow time that conditions geometry: clean (cached) or denoise (recomputed each step)
    geometry_placement: str = "segment"  # a segment of its own, or inside the VLM's prefix
    geometry_expert: str = "shared"  # the action expert's weights, or an expert of its own
    # What a token is computed from. statistics: of a depth cell's points, or DA3's features. points: a depth cell's points,
    # pooled by a learned network. rays: DA3's features beside the cell's camera ray in the base frame (needs calibration).
    geometry_tokens: str = "statistics"


def check_placement(segment: GeometrySegmentConfig) -> None:
    """Raise ValueError if geometry is inside the VLM's prefix and another option is set that has no effect there."""
    if segment.placement != "prefix":
        return
    for field in fields(segment):
        if field.name != "placement" and getattr(segment, field.name) != field.default:
            name = {"openness": "geometry_gate_openness"}.get(field.name, f"geometry_{field.name}")
            raise ValueError(
                f"geometry_placement=prefix puts geometry among the VLM's own tokens, where {name} has no meaning; "
                f"leave it at {field.default}."
            )
