"""Checkpoints that several files convert."""

import json
from pathlib import Path

import pytest

from lerobot_policy_pi05_geometry.checkpoint.conversion import GeometryStart, convert

from .sources import CALIBRATION, write_lerobot


@pytest.fixture(scope="session")
def lerobot_source(tmp_path_factory) -> Path:
    """LeRobot's π0.5; do not change it."""
    return write_lerobot(tmp_path_factory.mktemp("lerobot") / "pi05")


@pytest.fixture(scope="session")
def calibration(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("calibration") / "calibration.json"
    path.write_text(json.dumps(CALIBRATION))
    return path


@pytest.fixture(scope="session")
def two_cameras(calibration) -> GeometryStart:
    return GeometryStart(cameras=("front", "wrist"), calibration=calibration, grid=3)


@pytest.fixture(scope="session")
def converted(lerobot_source, two_cameras, tmp_path_factory) -> Path:
    """`lerobot_source` for two depth cameras; do not change it."""
    output = tmp_path_factory.mktemp("converted") / "policy"
    convert(lerobot_source, output, two_cameras)
    return output
