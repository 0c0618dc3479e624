"""A robot for LeRobot's own programs, found by them as a plugin: two RGB-D cameras, seven joints, five of them driven.

It writes every action it is sent as a line of JSON, and interrupts its process (SIGINT) after `actions` of them.
"""

import json
import os
import signal
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from lerobot.robots import Robot, RobotConfig

JOINTS = [f"joint_{i}.pos" for i in range(7)]


@RobotConfig.register_subclass("simulated")
@dataclass
class SimulatedRobotConfig(RobotConfig):
    log: str = "actions.jsonl"
    actions: int = 200


class SimulatedRobot(Robot):
    config_class = SimulatedRobotConfig
    name = "simulated"

    def __init__(self, config: SimulatedRobotConfig) -> None:
        super().__init__(config)
        self.config = config
        self._steps = 0
        self._random = np.random.default_rng(0)
        self._file = Path(config.log).open("w")  # noqa: SIM115 (closed on disconnecting)

    @cached_property
    def observation_features(self) -> dict:
        cameras = {"front": (30, 40, 3), "front_depth": (18, 24, 1), "wrist": (28, 28, 3), "wrist_depth": (12, 12, 1)}
        return {**dict.fromkeys(JOINTS, float), **cameras}

    @cached_property
    def action_features(self) -> dict:
        return dict.fromkeys(JOINTS[:5], float)

    @property
    def is_connected(self) -> bool:
        return True

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None: ...

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def disconnect(self) -> None:
        self._file.close()

    def get_observation(self) -> dict:
        observation: dict = {}
        for name, feature in self.observation_features.items():
            if feature is float:
                observation[name] = float(np.sin(0.1 * self._steps + len(observation)))
            elif feature[-1] == 3:
                observation[name] = self._random.integers(0, 256, feature, dtype=np.uint8)
            else:
                observation[name] = self._random.integers(300, 1800, feature, dtype=np.uint16)
        return observation

    def send_action(self, action: dict) -> dict:
        if not self._file.closed:
            self._file.write(json.dumps({"time": time.time(), **action}) + "\n")
            self._file.flush()
        self._steps += 1
        if self._steps == self.config.actions:
            if (
                signal.getsignal(signal.SIGINT) is signal.SIG_IGN
            ):  # as a shell has it for what it starts in the background
                signal.signal(signal.SIGINT, signal.default_int_handler)
            os.kill(os.getpid(), signal.SIGINT)
        return action
