"""Intrinsics from views of a board: found with noise and a lens that bends, and refused where the views do not tell."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from typer.testing import CliRunner

from lerobot_policy_pi05_geometry.geometry.calibration import Calibration, read_calibration_file, write_calibration_file
from lerobot_policy_pi05_geometry.geometry.camera import CameraCalibration, ColorStream
from lerobot_policy_pi05_geometry.robot.board import MIN_CORNERS, Detection
from lerobot_policy_pi05_geometry.robot.intrinsics import Intrinsics, solve_intrinsics, with_intrinsics
from pi05_geometry_cli import app
from tests.geometry.scenes import generator, random_pose
from tests.robot.recordings import BOARD, SIZE, turned

TRUE = [612.0, 608.0, 325.0, 236.0]
LENS = [0.08, -0.15, 0.001, -0.002, 0.0]


def poses(
    random: np.random.Generator, count: int, tilt: float = 40.0, aside: float = 1.0, near: float = 0.3
) -> list[np.ndarray]:
    """`camera_T_board` of a board that is held in front of the camera. tilt: degrees at most. aside: share of the image.

    near: metres.
    """
    made = []
    for _ in range(count):
        turn = turned(*random.uniform(-tilt, tilt, 2), random.uniform(-30, 30))
        away = random.uniform(near, 0.6)
        turn[:3, 3] = [aside * away * random.uniform(-0.4, 0.4), aside * away * random.uniform(-0.3, 0.3), away]
        turn[:3, 3] -= turn[:3, :3] @ BOARD.corners.mean(axis=0)
        made.append(turn)
    return made


def views(random: np.random.Generator, count: int, noise: float = 0.3, lens=LENS, **how) -> list[Detection]:
    """Corners inside of the image."""
    fx, fy, cx, cy = TRUE
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    found = []
    for pose in poses(random, count, **how):
        turn = cv2.Rodrigues(pose[:3, :3])[0]
        pixels = cv2.projectPoints(BOARD.corners, turn, pose[:3, 3], matrix, np.array(lens))[0].reshape(-1, 2)
        pixels += noise * random.normal(size=pixels.shape)
        ids = np.flatnonzero(((pixels > 0) & (pixels < np.array(SIZE) - 1)).all(axis=1))
        if len(ids) >= MIN_CORNERS + 4:
            found.append(Detection(ids, pixels[ids]))
    return found


@pytest.mark.parametrize("seed", range(3))
def test_intrinsics_are_found_through_noise(seed):
    found = solve_intrinsics(BOARD, views(np.random.default_rng(seed), 30), SIZE)
    errors = np.abs(np.array(found.intrinsics) - TRUE)
    assert errors.max() < 4.0
    assert (errors <= 5 * np.array(found.spread) + 0.2).all()  # what is said of the noise is true
    assert found.residual == pytest.approx(0.3 * 2**0.5, rel=0.15)
    assert np.abs(np.array(found.distortion) - LENS)[[0, 2, 3]].max() < 0.03
    assert found.bend == pytest.approx(_bend(), rel=0.3)


def _bend() -> float:
    """Of the lens itself, at the image's corners and sides."""
    fx, fy, cx, cy = TRUE
    k1, k2, p1, p2, _ = LENS
    moved = []
    for u in (0, 319.5, 639):
        for v in (0, 239.5, 479):
            x, y = (u - cx) / fx, (v - cy) / fy
            r = x * x + y * y
            bent = k1 * r + k2 * r * r
            moved.append(
                np.hypot(
                    fx * (x * bent + 2 * p1 * x * y + p2 * (r + 2 * x * x)),
                    fy * (y * bent + p1 * (r + 2 * y * y) + 2 * p2 * x * y),
                )
            )
    return max(moved)


def test_without_noise_they_are_exact():
    found = solve_intrinsics(BOARD, views(np.random.default_rng(5), 20, noise=0.0), SIZE)
    np.testing.assert_allclose(found.intrinsics, TRUE, atol=0.05)
    np.testing.assert_allclose(found.distortion, LENS, atol=2e-3)


def test_a_blurred_view_does_not_decide():
    random = np.random.default_rng(6)
    seen = views(random, 30)
    seen[3] = replace(seen[3], pixels=seen[3].pixels + 8 * random.normal(size=seen[3].pixels.shape))
    found = solve_intrinsics(BOARD, seen, SIZE)
    assert np.abs(np.array(found.intrinsics) - TRUE).max() < 5.0


def refused(seen: list[Detection]) -> str:
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        solve_intrinsics(BOARD, seen, SIZE)
    assert "\n" not in str(caught.value)
    assert str(caught.value).endswith(".")
    return str(caught.value)


def test_views_that_do_not_tell_are_refused():
    random = np.random.default_rng(7)
    assert "found in 6 distinct views, but 10 are needed" in refused(views(random, 40)[:6])
    assert "found in 0 distinct views" in refused([])
    assert "found in 1 distinct views" in refused(views(random, 1, aside=0.0) * 20)  # the same one
    assert "open, with a perspective of" in refused(views(random, 40, tilt=1.0))
    assert re.search(r"leave focal lengths and centre open, to \d+ pixels of", refused(views(random, 40, tilt=8.0)))
    assert "show it at the borders" in refused(views(random, 60, tilt=35.0, aside=0.1, near=0.55))
    bent = views(random, 30)
    for view in bent:  # a board that is not flat
        view.pixels[:, 1] += 8 * np.cos(view.ids)
    assert "glue the board onto something flat" in refused(bent)


def test_where_they_go_in_a_calibration():
    found = Intrinsics(TRUE, LENS, SIZE, 0.3, [0.5] * 4, 20, 3.0)
    new = with_intrinsics("front", None, found)
    new.check("front")
    assert (new.intrinsics, new.stream, new.color.distortion) == (TRUE, "color", LENS)
    pose = random_pose(generator(0)).tolist()
    old = CameraCalibration([1.0] * 4, [9, 9], pose, depth_scale=1e-3, stream="color")
    assert with_intrinsics("front", old, found) == replace(new, extrinsics=pose, depth_scale=1e-3)
    both = replace(old, stream="depth", color=ColorStream([2.0] * 4, [9, 9], pose, [0.0] * 5))
    changed = with_intrinsics("front", both, found)
    assert changed == replace(both, color=ColorStream(TRUE, list(SIZE), pose, LENS))
    with pytest.raises(ValueError, match="does not say where its colour stream is"):
        with_intrinsics("front", replace(both, color=None), found)
    with pytest.raises(ValueError, match="rotation of 90 degrees"):
        with_intrinsics("front", replace(old, rotation=90), found)


def record(root: Path, count: int, channels_first: bool = False) -> None:
    """Images of the board, as a pinhole of the intrinsics TRUE sees it."""
    random = np.random.default_rng(8)
    feature = {"dtype": "image", "shape": (SIZE[1], SIZE[0], 3), "names": ["height", "width", "channels"]}
    if channels_first:
        feature |= {"shape": (3, SIZE[1], SIZE[0]), "names": ["channels", "height", "width"]}
    features = {"observation.images.front": feature}
    dataset = LeRobotDataset.create("local/board", fps=5, features=features, root=root, use_videos=False)
    fx, fy, cx, cy = TRUE
    pixel = BOARD.square / 60  # metres of one pixel of the printed picture
    to_board = np.array([[pixel, 0, pixel / 2], [0, pixel, pixel / 2], [0, 0, 1]])
    for pose in poses(random, count, aside=0.7):
        homography = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]) @ pose[:3, [0, 1, 3]] @ to_board
        image = cv2.warpPerspective(BOARD.picture(60), homography, SIZE, flags=cv2.INTER_AREA, borderValue=128)
        image = (image + random.normal(0, 3, image.shape)).clip(0, 255).astype(np.uint8)
        image = np.repeat(image[..., None], 3, axis=2)
        image = image.transpose(2, 0, 1) if channels_first else image
        dataset.add_frame({"observation.images.front": image, "task": "board"})
    dataset.save_episode()
    dataset.finalize()


@pytest.mark.parametrize("channels_first", [False, True])
def test_the_command_finds_them_in_rendered_images(tmp_path, channels_first):
    """LeRobot lets a dataset describe its images channels first."""
    record(tmp_path / "data", 16, channels_first)
    file = tmp_path / "calibration.json"
    arguments = ["calibrate", "camera", "--camera=front", f"--file={file}", "--board=7x5:30:22"]
    with pytest.raises(ValueError, match=r"either --serial of a RealSense, or --dataset.root"):
        CliRunner().invoke(app, arguments, catch_exceptions=False)
    pose = random_pose(generator(0)).tolist()
    write_calibration_file(file, Calibration({"front": CameraCalibration([1.0] * 4, [9, 9], pose, stream="color")}))
    arguments.append(f"--dataset.root={tmp_path / 'data'}")
    told = CliRunner().invoke(app, arguments, catch_exceptions=False).output
    assert "px remain" in told
    found = read_calibration_file(file).cameras["front"]
    assert found.extrinsics == pose
    assert found.size == list(SIZE)
    assert np.abs(np.array(found.intrinsics) - TRUE).max() < 4.0
