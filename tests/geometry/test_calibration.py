"""The calibration file: what is written reads back, and what is wrong with it is said in one sentence."""

import json
from dataclasses import asdict, replace

import cv2
import pytest
import torch

from lerobot_policy_pi05_geometry.geometry.calibration import (
    Calibration,
    Rig,
    read_calibration_file,
    write_calibration_file,
)
from lerobot_policy_pi05_geometry.geometry.camera import ColorStream, Mount
from lerobot_policy_pi05_geometry.geometry.point_map import transform, unproject
from tests.geometry.arms import so101_like
from tests.geometry.scenes import calibrated, generator, random_pose


def good_file() -> dict:
    """The content of a usable calibration file."""
    pose = random_pose(generator(0)).tolist()
    entry = {"intrinsics": [600.0, 600.0, 319.5, 239.5], "size": [640, 480], "extrinsics": pose}
    return {"frame": "base", "cameras": {"front": entry}}


def refused(path, content) -> str:
    """Write `content`, read it as a calibration, and return the one sentence that refuses it."""
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        read_calibration_file(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    assert message.endswith(".")
    return message


def test_what_is_written_reads_back(tmp_path):
    cameras = {
        "front": calibrated(480, 640, random_pose(generator(1))),
        "wrist": calibrated(120, 160),
    }
    mount = Mount("arm", "gripper", random_pose(generator(3)).tolist())
    colour = ColorStream(
        [500.0, 500.0, 320.0, 240.0], [640, 480], random_pose(generator(4)).tolist(), [0.1, 0.0, 0.0, 0.0, 0.0]
    )
    cameras["wrist"] = replace(cameras["wrist"], mount=mount, depth_scale=1e-4, rotation=90, color=colour)
    rig = Rig(cameras, {"arm": so101_like()})
    for calibration in (
        Calibration(rig.cameras, rig.arms),
        Calibration(rigs={"0": rig, "3": Rig({"front": cameras["front"]})}),
    ):
        write_calibration_file(tmp_path / "calibration.json", calibration)
        assert read_calibration_file(str(tmp_path / "calibration.json")) == calibration


def test_extrinsics_may_be_left_out(tmp_path):
    content = good_file()
    del content["cameras"]["front"]["extrinsics"]
    (tmp_path / "c.json").write_text(json.dumps(content))
    assert read_calibration_file(tmp_path / "c.json").cameras["front"].extrinsics is None


def test_whole_numbers_are_numbers(tmp_path):
    content = good_file()
    content["cameras"]["front"]["intrinsics"] = [600, 600, 320, 240]
    (tmp_path / "c.json").write_text(json.dumps(content))
    assert read_calibration_file(tmp_path / "c.json").cameras["front"].intrinsics == [600.0, 600.0, 320.0, 240.0]


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere.json does not exist; set --policy.calibration_path"):
        read_calibration_file(tmp_path / "nowhere.json")
    with pytest.raises(FileNotFoundError, match=r"does not exist"):
        read_calibration_file(tmp_path)  # a folder


@pytest.mark.parametrize("content", ["", "{'frame': 'base'}", '{"frame": "base", ', b"\x89PNG\r\n\x1a\n\xff\xfe"])
def test_what_is_no_json_is_refused(tmp_path, content):
    assert "is not valid JSON" in refused(tmp_path / "c.json", content)


@pytest.mark.parametrize(
    "content",
    [
        [],
        "null",
        {},
        {"frame": "base"},
        {"cameras": {}},
        {"frame": "base", "cameras": []},
        {"frame": "base", "cameras": {}, "unit": "m"},
    ],
)
def test_missing_and_unknown_entries_are_refused(tmp_path, content):
    assert "entries 'frame' and 'cameras'" in refused(tmp_path / "c.json", content)


@pytest.mark.parametrize("frame", ["world", "camera", None, 3])
def test_another_frame_is_refused(tmp_path, frame):
    assert "only 'base'" in refused(tmp_path / "c.json", good_file() | {"frame": frame})


def test_missing_and_unknown_entries_of_a_camera_are_refused(tmp_path):
    for entry in ({"intrinsics": [1, 1, 0, 0]}, {"size": [4, 4]}, [1, 2], None):
        content = good_file()
        content["cameras"]["front"] = entry
        assert "Camera 'front'" in refused(tmp_path / "c.json", content)
    content = good_file()
    content["cameras"]["front"]["distortion"] = [0.1, 0.0]
    assert "Camera 'front'" in refused(tmp_path / "c.json", content)


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("intrinsics", [0.0, 0.0, 0.0, 0.0], "singular"),
        ("intrinsics", [600.0, 600.0, 320.0], "four finite numbers"),
        ("intrinsics", [600.0, 600.0, float("nan"), 240.0], "four finite numbers"),
        ("intrinsics", ["wide", 1, 1, 1], "camera 'front'"),
        ("intrinsics", 600.0, "camera 'front'"),
        ("size", [640], "width, height"),
        ("mount", {}, "camera 'front'"),
        ("size", [float("inf"), 480], "camera 'front'"),
        ("size", None, "camera 'front'"),
        ("extrinsics", [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "4 x 4"),
        ("extrinsics", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]], "4 x 4"),
        ("extrinsics", [[1, 0, 0, 0], [0, 1, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "4 rows of 4"),
        ("rotation", 45, "0, 90, 180 or 270"),
        ("stream", "infrared", "depth or color"),
        ("depth_scale", 1.0, "0.001 of a D435"),
        ("extrinsics", [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]], "must be a rigid transform"),
        ("extrinsics", [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "must be a rigid transform"),
        (
            "extrinsics",
            [[float("nan"), 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
            "must be a rigid transform",
        ),
        ("extrinsics", 5, "camera 'front'"),
    ],
)
def test_unusable_values_are_refused(tmp_path, field, value, said):
    content = good_file()
    content["cameras"]["front"][field] = value
    assert said in refused(tmp_path / "c.json", content).replace("Camera", "camera")


MOUNT = {"arm": "arm", "link": "gripper", "link_T_camera": random_pose(generator(0)).tolist()}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: c["cameras"]["front"].update(extrinsics=MOUNT["link_T_camera"]), "both extrinsics and a mount"),
        (
            lambda c: c["cameras"]["front"]["mount"].update(arm="left"),
            "mounted on arm 'left', but the calibration has arm",
        ),
        (lambda c: c["cameras"]["front"]["mount"].update(link="hand"), "link 'hand', which arm 'arm' does not have"),
        (lambda c: c["cameras"]["front"]["mount"].update(link="jaw"), "moved by joint(s) gripper"),
        (lambda c: c["arms"]["arm"]["joints"][0].update(unit="range"), "use_degrees"),
        (lambda c: c["arms"]["arm"].update(colour="red"), "colour"),
        (lambda c: c.update(version=3), "version 3"),
        (lambda c: c.update(rigs={}), "'frame' and 'cameras'"),
    ],
)
def test_unusable_mounts_and_arms_are_refused(tmp_path, change, said):
    content = good_file() | {"version": 2, "arms": {"arm": asdict(so101_like())}}
    content["cameras"]["front"] |= {"extrinsics": None, "mount": dict(MOUNT)}
    (tmp_path / "c.json").write_text(json.dumps(content))
    assert read_calibration_file(tmp_path / "c.json").cameras["front"].mount.link == "gripper"
    change(content)
    assert said in refused(tmp_path / "c.json", content)


@pytest.mark.parametrize("rotation", [90, 180, 270])
def test_turned_images_show_the_same_points(rotation):
    """A pixel of a turned image is the same point of the base frame as the sensor's own pixel, as LeRobot turns images."""
    random = generator(rotation)
    camera = replace(calibrated(6, 10, random_pose(random)), rotation=rotation)
    depth = torch.rand(6, 10, generator=random, dtype=torch.float64) + 0.5
    code = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}[rotation]

    def points(camera, depth):
        height, width = depth.shape
        assert [width, height] == camera.size
        seen = unproject(depth[None, None], torch.tensor(camera.scaled_intrinsics(height, width)))
        return transform(torch.tensor(camera.extrinsics), seen)[0]

    of_sensor = points(replace(camera, rotation=0), depth)
    turned = torch.from_numpy(cv2.rotate(depth.numpy(), code))
    of_turned = points(camera.as_recorded(), turned)
    expected = torch.stack([torch.from_numpy(cv2.rotate(plane.numpy(), code)) for plane in of_sensor])
    torch.testing.assert_close(of_turned, expected, atol=1e-6, rtol=0)
