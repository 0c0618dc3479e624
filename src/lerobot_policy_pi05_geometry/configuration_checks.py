"""Checks of the configuration's values. What cannot be raises ValueError with one sentence that names the setting."""

import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING, get_args

from .compat import mode_of
from .geometry.depth import MIN_DEPTH
from .model.config import RtcMode

if TYPE_CHECKING:
    from .configuration_pi05_geometry import PI05GeometryConfig

logger = logging.getLogger(__name__)

# Settings that say what a geometry token means and how the network reads it.
_MEANING = (
    "geometry_source", "geometry_frame", "geometry_cameras", "geometry_grid", "geometry_tokens", "geometry_positions",
    "geometry_time", "geometry_placement",
)  # fmt: skip


def check_choices(config: "PI05GeometryConfig", choices: Mapping[str, tuple[str, ...]]) -> None:
    """Raise ValueError for a setting that is none of its choices."""
    for name, known in choices.items():
        if getattr(config, name) not in known:
            raise ValueError(f"--policy.{name} must be one of {', '.join(known)}, got {getattr(config, name)!r}.")


def check_tokens(config: "PI05GeometryConfig") -> None:
    """Raise ValueError for a kind of tokens that the geometry source does not have."""
    belongs = {"points": ("rgbd", "none"), "rays": ("da3", "features", "none")}.get(config.geometry_tokens)
    if belongs is not None and config.geometry_source not in belongs:
        raise ValueError(
            f"geometry_tokens={config.geometry_tokens} belongs to geometry_source={' or '.join(belongs[:-1])}, but this is "
            f"{config.geometry_source}; leave geometry_tokens=statistics."
        )


def check_numbers(config: "PI05GeometryConfig") -> None:
    """Raise ValueError for a number that is out of its range."""
    for name in ("chunk_size", "n_action_steps", "num_inference_steps", "geometry_grid", "flow_samples"):
        if getattr(config, name) < 1:
            raise ValueError(f"{name} must be at least 1, got {getattr(config, name)}.")
    if config.micro_batch_size is not None and config.micro_batch_size < 0:
        raise ValueError(f"micro_batch_size must be 0 (off) or more, got {config.micro_batch_size}.")
    if config.n_obs_steps != 1:
        raise ValueError(
            f"This policy sees one observation at a time: n_obs_steps must be 1, got {config.n_obs_steps}."
        )
    if config.geometry_cameras is not None and not config.geometry_cameras:
        raise ValueError("geometry_cameras is empty; name a camera, or set geometry_source=none.")
    if config.n_action_steps > config.chunk_size:
        raise ValueError(f"n_action_steps ({config.n_action_steps}) must not exceed chunk_size ({config.chunk_size}).")
    if not 0 <= config.rtc_training_max_delay < config.chunk_size:
        raise ValueError(
            f"rtc_training_max_delay must be at least 0 and less than chunk_size ({config.chunk_size}), "
            f"got {config.rtc_training_max_delay}."
        )
    if not 0 <= config.geometry_gate_openness < float("inf"):
        raise ValueError(f"geometry_gate_openness must be 0 or more, got {config.geometry_gate_openness}.")
    if not config.max_depth > MIN_DEPTH:
        raise ValueError(f"max_depth must be above {MIN_DEPTH} m, got {config.max_depth}.")
    if config.image_resolution[0] != config.image_resolution[1]:
        raise ValueError(f"image_resolution must be square, got {tuple(config.image_resolution)}.")


def check_dropout(config: "PI05GeometryConfig") -> None:
    """Raise ValueError unless the modality dropout rates are probabilities that go together."""
    names = ("geometry_dropout", "image_dropout", "camera_dropout")
    rates = {name: getattr(config, name) for name in names}
    for name, rate in rates.items():
        if not 0 <= rate < 1:
            raise ValueError(f"{name} must be in [0, 1), got {rate}.")
    if sum(rates.values()) > 1 + 1e-9:
        told = ", ".join(f"{name} {rate}" for name, rate in rates.items())
        raise ValueError(f"One draw decides what a training sample goes without, so {told} must not exceed 1 together.")


def require_trained_geometry(config: "PI05GeometryConfig", saved: "PI05GeometryConfig") -> None:
    """Raise ValueError if geometry would mean something else to a trained policy than it did in training.

    config: what it is loaded with. saved: what its checkpoint has. Features of Depth Anything 3 are the same computed or stored.
    """
    for name in _MEANING:
        now, then = getattr(config, name), getattr(saved, name)
        computed = name == "geometry_source" and {now, then} <= {"da3", "features"}
        if now is not None and now != then and not computed:
            raise ValueError(
                f"This policy was trained with {name}={then}, so --policy.{name}={now} would give its geometry tokens another "
                f"meaning; leave the setting as it is, or begin anew with `pi05-geometry convert CHECKPOINT OUTPUT`."
            )


def refuse_log_gate(config: "PI05GeometryConfig") -> None:
    """Raise ValueError for a configuration of an earlier version, whose gate was a logarithm, where it has a gate."""
    if (
        config.geometry_gate_init is not None
        and config.geometry_source != "none"
        and config.geometry_placement == "segment"
    ):
        raise ValueError(
            "This checkpoint is of an earlier version, whose gate was stored as a logarithm (geometry_gate_init); write a "
            "new one with `pi05-geometry convert CHECKPOINT OUTPUT` and train that by --policy.path, since the state of its "
            "optimiser does not carry over."
        )
    config.geometry_gate_init = None


def rtc_mode(config: "PI05GeometryConfig") -> RtcMode:
    """How real-time chunking continues the previous chunk.

    Raises ValueError for an unknown mode, for two different ones, and for trained RTC of a policy without that training.
    """
    theirs = mode_of(config.rtc_config)
    mode = config.rtc_mode or theirs or "guided"
    if mode not in get_args(RtcMode):
        raise ValueError(f"--policy.rtc_mode must be one of {', '.join(get_args(RtcMode))}, got {mode!r}.")
    if theirs not in (None, mode):
        raise ValueError(f"rtc_mode={mode} contradicts rtc_config.mode={theirs}; set only rtc_config.mode.")
    if mode == "trained" and not config.rtc_training_max_delay:
        raise ValueError("rtc_mode=trained needs a policy that was trained with rtc_training_max_delay above 0.")
    return mode  # type: ignore[return-value]


def warn_of_random_weights(config: "PI05GeometryConfig") -> None:
    """Warn of a policy of the released size that starts without pretraining."""
    if config.paligemma_variant == "gemma_2b":
        logger.warning(
            "THIS POLICY STARTS FROM RANDOM WEIGHTS: its paligemma_variant=gemma_2b has 2.9 billion parameters and no "
            "pretraining, and will not learn from a robot's dataset. Convert a π0.5 (`pi05-geometry convert "
            "lerobot/pi05_base OUTPUT`) and train it by --policy.path=OUTPUT; or use the small size, which can be trained "
            "from scratch (--policy.paligemma_variant=small --policy.action_expert_variant=small)."
        )
