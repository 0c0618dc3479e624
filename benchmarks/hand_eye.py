"""How good hand-eye calibration is on synthetic recordings: `python -m benchmarks.hand_eye [--seeds 8] [--views 20 40 80 120]`.

An SO-101-like arm, a 7 x 5 board of 30 mm squares, 0.3 pixels and 0.2 degrees of noise, joint offsets of up to 5 degrees. Errors
are those of the camera's pose, after the rotation about the first (fixed camera) or last joint (wrist) that no recording
can tell. Beside them stands what the noise alone leaves (the Cramér-Rao bound of these views), which no method can go below.
"""

import argparse

import numpy as np
from tests.robot.recordings import BOARD, INTRINSICS, aligned_errors, make_recording

from lerobot_policy_pi05_geometry.robot.hand_eye import solve_hand_eye


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--views", type=int, nargs="+", default=[20, 40, 80, 120])
    given = parser.parse_args()
    for wrist in (False, True):
        for views in given.views:
            _measure(wrist, views, given.seeds)


def _measure(wrist: bool, views: int, seeds: int) -> None:
    rows = []
    for seed in range(100, 100 + seeds):
        recording = make_recording(wrist, seed)
        found = solve_hand_eye(recording.kinematics, recording.draw(views), BOARD, INTRINSICS, [0.0] * 5, wrist)
        held, bound = found.held_out, found.spread
        errors = aligned_errors(recording, found.camera)
        rows.append([*errors, bound.millimetres, bound.degrees, held.millimetres, held.degrees, held.pixels])
    median, largest = np.median(rows, axis=0), np.max(rows, axis=0)
    names = (
        "camera mm",
        "camera degrees",
        "noise leaves mm",
        "degrees",
        "held-out mm",
        "held-out degrees",
        "held-out px",
    )
    told = ", ".join(f"{n} {m:.2f} ({x:.2f})" for n, m, x in zip(names, median, largest, strict=True))
    print(f"{'wrist' if wrist else 'fixed'}, {views} views, median (largest) of {seeds}: {told}", flush=True)


if __name__ == "__main__":
    main()
