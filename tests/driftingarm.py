"""A robot whose joints move by themselves, whatever it is told to do, and whose images say which tick it is.

LeRobot finds the class of a robot in a module of its own name (`make_device_from_device_class`).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from lerobot.robots import Robot, RobotConfig

from tests.drifting import JOINTS, SIZE, image_of, state_of


@RobotConfig.register_subclass("drifting_arm")
@dataclass
class DriftingArmConfig(RobotConfig):
    ticks: int = 10  # after which it interrupts the rollout, as a person would with Ctrl-C


class DriftingArm(Robot):
    """What it was told to do stands in `sent`, of all arms that were built: rollout builds its own."""

    config_class = DriftingArmConfig
    name = "drifting_arm"
    sent: list[list[float]] = []  # noqa: RUF012

    def __init__(self, config: DriftingArmConfig) -> None:
        super().__init__(config)
        self._left, self._tick, self._connected = config.ticks, 0, False

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        return {**dict.fromkeys(JOINTS, float), "front": (SIZE, SIZE, 3)}

    @cached_property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(JOINTS, float)

    @property
    def is_connected(self) -> bool:
        return self._connected

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        self._connected = True

    def disconnect(self) -> None:
        self._connected = False

    def calibrate(self) -> None:
        """Nothing to calibrate."""

    def configure(self) -> None:
        """Nothing to configure."""

    def get_observation(self) -> dict[str, Any]:
        if len(self.sent) >= self._left:
            raise KeyboardInterrupt
        self._tick = (self._tick + 1) % 256
        return {**dict(zip(JOINTS, state_of(self._tick).tolist(), strict=True)), "front": image_of(self._tick)}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self.sent.append([action[joint] for joint in JOINTS])
        return action
