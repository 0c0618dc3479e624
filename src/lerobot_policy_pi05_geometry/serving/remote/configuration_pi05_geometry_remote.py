"""The remote policy's configuration. LeRobot finds it as `--policy.type=pi05_geometry_remote`."""

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.policies.rtc.configuration_rtc import RTCConfig

NO_TRAINING = "The remote policy is not trained; train pi05_geometry and serve its checkpoint."


@PreTrainedConfig.register_subclass("pi05_geometry_remote")
@dataclass
class PI05GeometryRemoteConfig(PreTrainedConfig):
    """Which server to ask. What the policy expects and gives is the server's to say, and is filled in from its metadata."""

    device: str | None = "cpu"
    push_to_hub: bool = False

    server: str = ""  # ws://host:8000, or wss://host
    key_file: str | None = None  # file with the server's key; None: $PI05_GEOMETRY_API_KEY
    timeout: float = 10.0  # seconds to wait for a connection, and for a chunk
    reconnect: float = 30.0  # seconds to try to reach a server that was lost, before this is an error
    n_action_steps: int | None = None  # actions executed of a chunk; None: as the checkpoint says
    # server: keyed by session and request. client: drawn here from torch's generator, as a local policy draws it.
    noise: str = "server"
    rig: int | None = None  # which rig this robot is, if the server's policy knows several
    rename_map: dict[str, str] = field(default_factory=dict)  # the robot's keys -> the checkpoint's
    rtc_config: RTCConfig | None = None

    # Filled in from the server's metadata.
    chunk_size: int = 0
    action_feature_names: list[str] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.server and not self.server.startswith(("ws://", "wss://")):
            raise ValueError(f"--policy.server must begin with ws:// or wss://, got {self.server!r}.")
        if self.noise not in ("server", "client"):
            raise ValueError(f"--policy.noise must be server or client, got {self.noise!r}.")
        if not self.timeout > 0 or not self.reconnect >= 0:
            raise ValueError(
                f"timeout must be above 0 and reconnect at least 0 seconds, got {self.timeout} and {self.reconnect}."
            )
        if self.n_action_steps is not None and self.n_action_steps < 1:
            raise ValueError(f"n_action_steps must be at least 1, got {self.n_action_steps}.")

    def validate_features(self) -> None:
        """The server checks what it is sent."""

    def get_optimizer_preset(self) -> Any:
        raise NotImplementedError(NO_TRAINING)

    def get_scheduler_preset(self) -> Any:
        raise NotImplementedError(NO_TRAINING)

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> None:
        return None

    @property
    def reward_delta_indices(self) -> None:
        return None
