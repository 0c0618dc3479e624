"""Hand-eye calibration on synthetic recordings with noise, joint offsets and a wrong start; and recordings that are refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from lerobot_policy_pi05_geometry.robot.board import Board, Detection, board_pose
from lerobot_policy_pi05_geometry.robot.hand_eye import HandEye, solve_hand_eye
from lerobot_policy_pi05_geometry.robot.hand_eye_problem import HandEyeProblem, View
from lerobot_policy_pi05_geometry.robot.least_squares import fit
from tests.robot.recordings import (
    BOARD,
    INTRINSICS,
    Recording,
    aligned_errors,
    changed,
    make_recording,
    turned,
    turned_by_convention,
)

LENS = [0.0] * 5


def solve(recording: Recording, views: list[View], board: Board = BOARD, **more) -> HandEye:
    return solve_hand_eye(recording.kinematics, views, board, INTRINSICS, LENS, recording.wrist, **more)


@pytest.mark.parametrize("wrist", [False, True], ids=["fixed", "wrist"])
def test_without_noise_everything_is_found(wrist):
    recording = make_recording(wrist, 0)
    found = solve(recording, recording.draw(20, pixel_noise=0.0, joint_noise=0.0))
    millimetres, degrees = aligned_errors(recording, found.camera)
    assert millimetres < 0.05
    assert degrees < 0.01
    offsets = np.array(list(found.offsets.values()))
    assert np.abs(offsets - recording.offsets)[1:-1].max() < np.radians(0.01)
    assert offsets[0] == offsets[-1] == 0.0
    assert found.fixed_joints == ("shoulder_pan", "wrist_roll")


@pytest.mark.parametrize("wrist", [False, True], ids=["fixed", "wrist"])
def test_twenty_noisy_views_calibrate_a_camera(wrist):
    """0.3 pixels, 0.2 degrees of joint noise, offsets of up to 5 degrees, and a start that is 15 cm and 40 degrees off."""
    errors = []
    for seed in (1, 2, 3):
        recording = make_recording(wrist, seed)
        start = recording.camera @ turned(40, 0, 0, (0.1, 0.1, 0.05))
        found = solve(recording, recording.draw(20), start=start)
        errors.append(aligned_errors(recording, found.camera))
        # A held-out view is predicted from joints that are 0.2 degrees off, each.
        assert found.held_out.millimetres < 8
        assert found.held_out.degrees < 1.2
        assert found.image < 0.6
    millimetres, degrees = np.median(errors, axis=0)
    assert millimetres <= 2.0
    assert degrees <= 0.2


def test_with_offsets_that_are_known_joints_may_stand_still():
    """The arm's offsets stay, and a joint that never moves is no reason to refuse the recording."""
    recording = make_recording(True, 4)
    recording.offsets[:] = 0.0
    views = recording.draw(20, pixel_noise=0.0, joint_noise=0.0, motion=(70, 0, 70, 70, 90))
    with pytest.raises(ValueError, match="shoulder_lift moved by less than"):
        solve(recording, views)
    found = solve(recording, views, keep_offsets=True)
    assert set(found.offsets.values()) == {0.0}
    assert found.fixed_joints == tuple(recording.kinematics.joints)
    millimetres, degrees = aligned_errors(recording, found.camera)
    assert millimetres < 0.2
    assert degrees < 0.02


@pytest.mark.parametrize("wrist", [False, True], ids=["fixed", "wrist"])
def test_errors_are_what_the_noise_leaves(wrist):
    """No method can do better from these views, and what the command says of the noise is true: by Mahalanobis distances.

    The offsets of the first and the last joint are 0 by convention, which turns the base and what the hand carries.
    """
    distances = []
    for seed in range(30, 34):
        recording = make_recording(wrist, seed)
        views = recording.draw(20)
        problem = HandEyeProblem(recording.kinematics, views, BOARD.corners, INTRINSICS, LENS, wrist)
        start = problem.start(recording.camera, recording.board)
        fitted = fit(problem, replace(start, offsets=torch.from_numpy(recording.offsets) * problem.free))
        truth, found = turned_by_convention(recording), fitted.found.camera.numpy()
        turn = Rotation.from_matrix(truth[:3, :3].T @ found[:3, :3]).as_rotvec()
        error = np.concatenate([turn, found[:3, 3] - truth[:3, 3]])
        distances.append(error @ np.linalg.solve(fitted.covariance[:6, :6], error))
    # Squared distances have a mean of 6 with exactly this noise; 0.5 pixels are assumed, and 0.3 there.
    assert 2 < np.mean(distances) < 9
    assert max(distances) < 20


@pytest.mark.long
@pytest.mark.parametrize("wrist", [False, True], ids=["fixed", "wrist"])
def test_the_worst_recording_of_eighty_poses_is_good_enough(wrist):
    for seed in range(100, 108):
        recording = make_recording(wrist, seed)
        millimetres, degrees = aligned_errors(recording, solve(recording, recording.draw(80)).camera)
        assert millimetres <= 2.0
        assert degrees <= 0.2


def test_a_few_wrong_corners_do_not_decide():
    recording = make_recording(False, 4)
    views = recording.draw(20)
    for number in (2, 9):
        wrong = views[number].seen.pixels.copy()
        wrong[:3] += 40.0
        views[number] = replace(views[number], seen=Detection(views[number].seen.ids, wrong))
    millimetres, degrees = aligned_errors(recording, solve(recording, views).camera)
    assert millimetres <= 2.5
    assert degrees <= 0.4


def test_derivatives_are_those_of_the_prediction():
    recording = make_recording(True, 5)
    problem = HandEyeProblem(
        recording.kinematics, recording.draw(12), BOARD.corners, INTRINSICS, [0.1, -0.2, 0.01, 0.02, 0.05], True
    )
    start = problem.start(recording.camera, recording.board)
    change = 1e-2 * torch.randn(problem.size, generator=torch.Generator().manual_seed(0)).double()
    found, _ = problem.derivatives(start, change)
    expected = torch.func.jacfwd(lambda x: problem.predicted(problem.moved(start, x)).flatten())(change)
    assert (found - expected).abs().max() <= 1e-4 * expected.abs().max()


def test_the_boards_pose_in_one_image():
    recording = make_recording(False, 6)
    for view in recording.draw(12, pixel_noise=0.0, joint_noise=0.0)[:4]:
        expected = recording.camera_T_board(view.values[None] + recording.offsets)[0]
        np.testing.assert_allclose(board_pose(BOARD, view.seen, INTRINSICS), expected, atol=1e-5)


# --- what is refused ----------------------------------------------------------------------------------------------------


def refused(recording: Recording, views: list[View], board: Board = BOARD) -> str:
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        solve(recording, views, board)
    message = str(caught.value)
    assert message.endswith(".")
    assert "\n" not in message
    return message


def test_too_few_views_are_refused():
    recording = make_recording(True, 7)
    assert "found in 5 distinct views, but 12 are needed" in refused(recording, recording.draw(5))
    assert "found in 0 distinct views" in refused(recording, [])


def test_views_that_are_too_alike_are_refused():
    recording = make_recording(True, 7)
    assert "too alike" in refused(recording, recording.draw(20, reach=0.1))


def test_views_about_one_axis_are_refused():
    """Only the middle joints move, whose axes are parallel: the camera's place along them is open."""
    recording = make_recording(True, 8)
    views = _moving(recording, [0.0, 1.0, 1.0, 1.2, 0.0])
    assert "about one axis only" in refused(recording, views)


def test_a_joint_that_never_moves_is_named():
    recording = make_recording(False, 8)
    views = _moving(recording, [1.0, 0.7, 0.0, 1.0, 1.3])
    assert "Joint(s) elbow_flex moved by less than 8 degrees" in refused(recording, views)


def test_a_state_of_another_arm_is_refused():
    recording = make_recording(True, 9)
    views = changed(recording.draw(20), lambda number, values: np.zeros(5))
    assert "The state never changes" in refused(recording, views)


def test_motors_in_percent_of_their_range_are_refused():
    """-100 to 100 of a range of 2 x 70 degrees, say: 0.7 degrees a count."""
    recording = make_recording(False, 10)
    views = changed(recording.draw(20), lambda number, values: values / np.array([1.1, 0.7, 0.8, 0.95, 1.5]))
    assert "--robot.use_degrees=true" in refused(recording, views)


def test_a_board_of_another_size_is_refused():
    recording = make_recording(True, 11)
    larger = Board(BOARD.columns, BOARD.rows, 0.033, 0.0242)
    assert "squares are 30.0 mm wide rather than 33.0" in refused(recording, recording.draw(20), larger)


@pytest.mark.parametrize("wrist", [False, True], ids=["fixed", "wrist"])
def test_a_board_that_was_moved_is_refused(wrist):
    recording = make_recording(wrist, 12)
    before = recording.draw(12)
    recording.board = recording.board @ turned(0, 0, 12, (0.02, 0.01, 0.0))
    after = [replace(view, frame=view.frame + 500) for view in recording.draw(12)]
    assert "the board or the camera was moved" in refused(recording, before + after)


def _moving(recording: Recording, reach: list[float]) -> list[View]:
    """Twenty views in which each joint moves this far, radians."""
    views: list[View] = []
    while len(views) < 20:
        drawn = recording.middle + np.array(reach) * recording.random.uniform(-1, 1, (200, 5))
        for values, pixels, shown in zip(drawn, *recording.project(drawn), strict=True):
            if shown.sum() >= len(BOARD.corners) // 2:
                seen = Detection(np.flatnonzero(shown), pixels[shown])
                views.append(View(len(views), values - recording.offsets, seen))
    return views[:20]
