"""The geometry that a checkpoint is given by `convert`: as configuration fields."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...configuration_pi05_geometry import CONTROLS, DEFAULT_ENCODER, SOURCES, PI05GeometryConfig
from ...geometry import read_calibration_file
from ...geometry.resolve import FROM_RGB

# Logits on keys that the network has never seen may be well above those on the ones it has: with random weights and an openness
# of 3e-4, actions moved by up to 0.1, at 6e-6 by 3e-3, at 1e-7 by 5e-5 (docs/results.md). Invariant 9 allows 1e-3.
SHUT = 1e-7
# A policy that acts from RGB takes geometry up only if the gate moves fast and images are missing often enough: neither alone
# did (docs/results.md, "Warm start").
TAKE_UP = {"geometry_lr": 3e-3, "geometry_gate_lr": 5e-2, "image_dropout": 0.4, "geometry_dropout": 0.2}


@dataclass(frozen=True)
class GeometryStart:
    """What `convert` was asked for. None: the default for a π0.5, and as it is for a checkpoint of this policy.

    source: as in the configuration, rgbd by default. cameras: names in token order; by default those of the source's
    configuration, or one camera whose name the training data tells. calibration: a calibration file, or None if the training
    data has it. grid, frame, expert: as in the configuration; an own expert starts as a copy of the action expert. openness: of
    the gate, see `SHUT`. encoder: Depth Anything 3, for da3 and features: hub id, folder or safetensors file. tokens: what
    tokens are computed from: statistics, points (of depth) or rays (beside Depth Anything 3).
    """

    source: str | None = None
    cameras: tuple[str, ...] | None = None
    calibration: Path | None = None
    grid: int | None = None
    frame: str | None = None
    expert: str | None = None
    openness: float | None = None
    encoder: str | None = None
    tokens: str | None = None

    def check(self, source: str) -> None:
        """Raise ValueError for options that do not belong together. source: the geometry source that results."""
        if source not in SOURCES + CONTROLS:
            raise ValueError(f"--geometry-source must be one of {', '.join(SOURCES + CONTROLS)}, got {source!r}.")
        if self.grid is not None and self.grid < 1:
            raise ValueError(f"--geometry-grid must be at least 1, got {self.grid}.")
        if self.encoder is not None and source not in ("da3", "features"):
            raise ValueError(
                f"--da3-encoder belongs to --geometry-source=da3 or features, but this is {source}; leave it out."
            )
        if self.calibration is not None and source in ("random", "none"):
            raise ValueError(f"--calibration has no meaning with --geometry-source={source}; leave it out.")
        if source == "none" and (without_effect := [f"--geometry-{name}" for name in self._of_geometry()]):
            raise ValueError(f"{', '.join(without_effect)} has no meaning with --geometry-source=none; leave it out.")

    def _of_geometry(self) -> list[str]:
        """Names of the options given that say something of geometry, as the command has them."""
        given = {
            "cameras": self.cameras,
            "grid": self.grid,
            "frame": self.frame,
            "expert": self.expert,
            "tokens": self.tokens,
            "gate-openness": self.openness,
        }
        return [name for name, value in given.items() if value is not None]

    def settings(self, has_images: bool) -> dict[str, Any]:
        """Fields of the configuration of a π0.5 that gets this geometry. has_images: whether its cameras are known.

        Parallel positions leave the actions where π0.5 has them.
        """
        source = value_or(self.source, "rgbd")
        self.check(source)
        known = source == "none" or (source in FROM_RGB and has_images)
        return {
            "geometry_source": source,
            "geometry_cameras": None if self.cameras is None else list(self.cameras),
            "geometry_pending": 0 if known else len(self.cameras or [""]),
            "geometry_grid": value_or(self.grid, 8),
            "geometry_frame": value_or(self.frame, "base"),
            "geometry_expert": value_or(self.expert, "shared"),
            "geometry_tokens": value_or(self.tokens, "statistics"),
            "geometry_gate_openness": value_or(self.openness, SHUT),
            "geometry_positions": "parallel",
            "padded_actions": "supervised",  # as it was trained
            "da3_encoder": (self.encoder or DEFAULT_ENCODER) if source in ("da3", "features") else None,
            **TAKE_UP,
        }

    def calibrate(self, config: PI05GeometryConfig) -> None:
        """Record the calibration file in the configuration, if there is one."""
        if self.calibration is not None:
            given = read_calibration_file(self.calibration)
            config.calibration, config.arms, config.rigs = given.cameras, given.arms, given.rigs
            config.calibration_given = True


def value_or[T](value: T | None, default: T) -> T:
    """A grid of 0 or an empty name is no default: the configuration refuses it."""
    return default if value is None else value


def has_images(settings: Mapping[str, Any]) -> bool:
    """Whether configuration fields name an RGB camera, as JSON."""
    inputs = settings.get("input_features") or {}
    return any(isinstance(feature, Mapping) and feature.get("type") == "VISUAL" for feature in inputs.values())
