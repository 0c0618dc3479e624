"""The commands that make and check a calibration file: calibrate board, camera, arm, hand-eye, depth; scene shows it."""

from pathlib import Path
from typing import Annotated

import typer

from .app import app, console

calibrate = typer.Typer(no_args_is_help=True, help="Calibrate a real robot's cameras (docs/real-robot.md).")
app.add_typer(calibrate, name="calibrate")

File = Annotated[Path, typer.Option("--file", help="Calibration file to read, if it is there, and to write.")]
BoardText = Annotated[
    str, typer.Option("--board", help="COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY], sides in mm as measured on the print.")
]
Root = Annotated[Path, typer.Option("--dataset.root", help="Folder of a LeRobotDataset.")]
RepoId = Annotated[str, typer.Option("--dataset.repo_id", help="Its id.")]
DEFAULT_BOARD = "7x5:30:22:4X4_50"


@calibrate.command()
def board(
    output: Annotated[Path, typer.Argument(help="PNG to write.")] = Path("board.png"),
    board: BoardText = DEFAULT_BOARD,
) -> None:
    """Write the ChArUco board as a picture to print. Measure its squares afterwards: printers scale."""
    import cv2

    from lerobot_policy_pi05_geometry.robot.board import Board

    made = Board.parse(board)
    cv2.imwrite(str(output), made.picture())
    console.print(
        f"Print [bold]{output}[/bold] {made.columns * made.square * 1e3:.0f} x {made.rows * made.square * 1e3:.0f} mm "
        f"large, glue "
        "it onto something flat, and measure a square."
    )


@calibrate.command()
def camera(
    name: Annotated[str, typer.Option("--camera", help="Its name in the robot's configuration.")],
    serial: Annotated[str | None, typer.Option(help="Of a RealSense (lerobot-find-cameras realsense).")] = None,
    dataset_root: Annotated[
        Path | None, typer.Option("--dataset.root", help="Of any camera: a recording in which it sees the board.")
    ] = None,
    dataset_repo_id: RepoId = "local/dataset",
    board: BoardText = DEFAULT_BOARD,
    width: Annotated[int, typer.Option(help="As in the robot's configuration, before rotation.")] = 640,
    height: Annotated[int, typer.Option(help="As in the robot's configuration, before rotation.")] = 480,
    fps: Annotated[int, typer.Option(help="As in the robot's configuration.")] = 30,
    rotation: Annotated[int, typer.Option(help="As in the robot's configuration: 0, 90, 180 or 270 (its -90).")] = 0,
    file: File = Path("calibration.json"),
) -> None:
    """Read what a connected RealSense knows (--serial), or find intrinsics from images of a board (--dataset.root)."""
    from lerobot_policy_pi05_geometry.geometry.calibration import write_calibration_file

    if (serial is None) == (dataset_root is None):
        raise ValueError("Give either --serial of a RealSense, or --dataset.root of a recording with the board.")
    calibration = _read(file)
    before = calibration.cameras.get(name)
    if serial is not None:
        calibration.cameras[name], told = _read_realsense(serial, width, height, fps, rotation, before)
    else:
        assert dataset_root is not None
        calibration.cameras[name], told = _see_board(name, dataset_root, dataset_repo_id, board, before)
    write_calibration_file(file, calibration)
    console.print(f"{name}: {told} Wrote [bold]{file}[/bold].")


def _read_realsense(serial: str, width: int, height: int, fps: int, rotation: int, before):
    from dataclasses import replace

    from lerobot_policy_pi05_geometry.robot.realsense import read_camera

    found = read_camera(serial, width, height, fps, rotation % 360)
    if before is not None:  # where it stands is still true
        found = replace(found, extrinsics=before.extrinsics, mount=before.mount)
    told = (
        f"focal lengths {found.intrinsics[0]:.1f} and {found.intrinsics[1]:.1f} px of {found.size[0]} x {found.size[1]}, one "
        f"count of depth is {found.depth_scale * 1e3:g} mm."
    )
    return found, told


def _see_board(name: str, root: Path, repo_id: str, board: str, before):
    from lerobot_policy_pi05_geometry.robot.board import Board
    from lerobot_policy_pi05_geometry.robot.intrinsics import read_intrinsics, with_intrinsics

    found = read_intrinsics(root, repo_id, name, Board.parse(board))
    fx, fy, cx, cy = found.intrinsics
    told = (
        f"focal lengths {fx:.1f} and {fy:.1f} px, centre {cx:.1f}, {cy:.1f} of {found.size[0]} x {found.size[1]}, each known to "
        f"{max(found.spread):.1f} px; {found.views} views, {found.residual:.2f} px remain. The lens bends the image by up to "
        f"{found.bend:.1f} px, which hand-eye calibration takes into account and points of depth do not."
    )
    return with_intrinsics(name, before, found), told


@calibrate.command()
def arm(
    model: Annotated[Path, typer.Option(help="URDF or MJCF file of the arm.")],
    dataset_root: Root,
    dataset_repo_id: RepoId = "local/dataset",
    name: Annotated[str, typer.Option("--arm", help="A name for it.")] = "arm",
    base: Annotated[str | None, typer.Option(help="Link that is the base. Default: the file's root.")] = None,
    joint: Annotated[
        list[str] | None, typer.Option(help="JOINT=STATE_ENTRY, where they are not JOINT and JOINT.pos.")
    ] = None,
    flip: Annotated[list[str] | None, typer.Option(help="A joint that turns the other way than the file says.")] = None,
    unit: Annotated[
        list[str] | None,
        typer.Option(
            help="Of the joints in the state: degrees (default) or radians; of one: JOINT=UNIT, as lift=millimetres."
        ),
    ] = None,
    file: File = Path("calibration.json"),
) -> None:
    """Write an arm's links and joints into the calibration: from its link file, and a dataset that names the state's entries."""
    from dataclasses import replace

    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_policy_pi05_geometry.dataset_folder import require_dataset
    from lerobot_policy_pi05_geometry.geometry.calibration import write_calibration_file
    from lerobot_policy_pi05_geometry.robot.calibrate import keep_offsets, make_arm, named_state
    from lerobot_policy_pi05_geometry.robot.link_files import read_links

    pairs = [text.partition("=") for text in joint or []]
    if any(not sign or not entry for _, sign, entry in pairs):
        raise ValueError("--joint is written JOINT=STATE_ENTRY, as elbow=elbow_flex.pos.")
    calibration = _read(file)
    names = named_state(LeRobotDataset(dataset_repo_id, root=require_dataset(dataset_root)))
    units = [text.rpartition("=") for text in unit or []]
    of_all = [text for _, sign, text in units if not sign] or ["degrees"]
    if len(of_all) > 1:
        raise ValueError("--unit is given once for all joints, and as JOINT=UNIT for one.")
    made = make_arm(
        read_links(model, base), names, {left: right for left, _, right in pairs}, of_all[0],
        {left: right for left, sign, right in units if sign},
    )  # fmt: skip
    known = [each.joint for each in made.joints]
    if set(flip or []) - set(known):
        raise ValueError(f"--flip names a joint that the state does not have; it has {', '.join(known)}.")
    made.joints = [replace(each, sign=-1 if each.joint in (flip or []) else 1) for each in made.joints]
    kept = keep_offsets(made, calibration.arms.get(name))
    mounted = sorted(key for key, each in calibration.cameras.items() if each.mount and each.mount.arm == name)
    calibration.arms[name] = made
    write_calibration_file(file, calibration)
    still = sorted({link.joint for link in made.links if link.joint} - set(known))
    console.print(
        f"{name}: {', '.join(f'{each.joint} = {each.state}' for each in made.joints)}"
        + (f"; not in the state, so always at 0: {', '.join(still)}" if still else "")
        + (f"; offsets kept from the file: {', '.join(kept)}" if kept else "")
        + f". Wrote [bold]{file}[/bold]."
    )
    if mounted:
        console.print(
            f"{', '.join(mounted)}: placed with the arm as it was in the file before; run pi05-geometry calibrate hand-eye again "
            "if its links or joints have changed."
        )


@calibrate.command("hand-eye")
def hand_eye(
    camera: Annotated[str, typer.Option(help="The camera to calibrate.")],
    link: Annotated[str, typer.Option(help="Link that carries the camera, or, with --fixed, the board.")],
    dataset_root: Root,
    dataset_repo_id: RepoId = "local/dataset",
    fixed: Annotated[
        bool, typer.Option("--fixed", help="The camera stands still, and the arm carries the board.")
    ] = False,
    arm: Annotated[str, typer.Option(help="The arm's name in the calibration.")] = "arm",
    keep_offsets: Annotated[
        bool,
        typer.Option("--keep-offsets", help="Find only the camera; the arm's joints keep the offsets in the file."),
    ] = False,
    board: BoardText = DEFAULT_BOARD,
    file: File = Path("calibration.json"),
    picture: Annotated[Path, typer.Option(help="PNG to write: what all cameras see, in the base frame.")] = Path(
        "scene.png"
    ),
) -> None:
    """Find where a camera is, and the joints' offsets, from a recording in which the arm moves and a board is seen."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_policy_pi05_geometry.dataset_folder import require_dataset
    from lerobot_policy_pi05_geometry.geometry.calibration import Rig, write_calibration_file
    from lerobot_policy_pi05_geometry.geometry.kinematics import joint_kinds
    from lerobot_policy_pi05_geometry.inspect.inspection import frame_batch
    from lerobot_policy_pi05_geometry.inspect.scene import scene_figure, scene_of
    from lerobot_policy_pi05_geometry.robot.board import Board
    from lerobot_policy_pi05_geometry.robot.calibrate import calibrate_hand_eye, cameras_on_arm
    from lerobot_policy_pi05_geometry.robot.joint_offsets import LEVER, shown

    changed, found = calibrate_hand_eye(
        dataset_root, dataset_repo_id, _read(file), camera, arm, link, Board.parse(board), not fixed, keep_offsets
    )
    write_calibration_file(file, changed)
    # The recording may be of one arm of several: another one's state is not in it.
    cameras = {key: each for key, each in changed.cameras.items() if each.mount is None or each.mount.arm == arm}
    scene = scene_of(
        frame_batch(LeRobotDataset(dataset_repo_id, root=require_dataset(dataset_root)), found.views[0]),
        Rig(cameras, {arm: changed.arms[arm]}),
    )
    scene_figure(scene).savefig(picture, dpi=130)
    console.print(f"{len(found.views)} views. Board in the image and as predicted from the reported joints:")
    for title, residuals in (("  all views", found.fitted), ("  held out", found.held_out)):
        console.print(
            f"{title}: {residuals.pixels:.1f} px, {residuals.millimetres:.1f} mm, {residuals.degrees:.2f} degrees "
            f"(root mean square)"
        )
    console.print(
        f"Noise alone leaves the camera open to {found.spread.millimetres:.1f} mm and {found.spread.degrees:.2f} "
        f"degrees; joints were off "
        f"by {found.deviation}. Four times as many poses leave half of it."
    )
    if keep_offsets:
        console.print(
            f"The joints of '{arm}' kept their offsets. Wrote [bold]{file}[/bold]; look at [bold]{picture}[/bold]."
        )
        return
    kinds = joint_kinds(changed.arms[arm].links)
    for joint, offset in found.offsets.items():
        told = (
            "as it was, by convention"
            if joint in found.fixed_joints
            else f"changed by {shown(offset, LEVER if kinds[joint] == 'prismatic' else 1.0, '+.2f')}"
        )
        console.print(f"  offset of {joint}: {told}")
    others = cameras_on_arm(changed, arm, other_than=camera)
    if others:
        console.print(
            f"{', '.join(others)}: placed with the offsets that the arm had before; run pi05-geometry calibrate hand-eye again "
            "for what the arm carries, with --keep-offsets."
        )
    console.print(
        f"No recording can tell the offsets of {', '.join(found.fixed_joints)} from a motion of the base or of what the hand "
        f"carries: they stay as they were. Wrote [bold]{file}[/bold]; look at [bold]{picture}[/bold]."
    )


@calibrate.command()
def depth(
    camera: Annotated[str, typer.Option(help="The camera to check.")],
    model: Annotated[Path, typer.Option(help="URDF or MJCF file of the arm, with its meshes.")],
    dataset_root: Root,
    dataset_repo_id: RepoId = "local/dataset",
    arm: Annotated[str, typer.Option(help="The arm's name in the calibration.")] = "arm",
    file: File = Path("calibration.json"),
) -> None:
    """Check a camera's depth against the arm in its view: more than 10 % off is an error."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_policy_pi05_geometry.dataset_folder import require_dataset
    from lerobot_policy_pi05_geometry.robot.link_depth import check_link_depth

    found = check_link_depth(
        LeRobotDataset(dataset_repo_id, root=require_dataset(dataset_root)), _read(file), camera, arm, model
    )
    console.print(
        f"{camera}: measured depth of the arm is {found.ratio:.3f} times what its links say (median of {found.pixels} pixels in "
        f"{found.frames} frames)."
    )


@app.command()
def scene(
    dataset_root: Root,
    dataset_repo_id: RepoId = "local/dataset",
    file: Annotated[
        Path | None, typer.Option("--file", help="Calibration file. Default: what the dataset carries.")
    ] = None,
    frame: Annotated[int, typer.Option(help="Index of the frame.")] = 0,
    output: Annotated[Path, typer.Option(help="PNG to write.")] = Path("scene.png"),
    rerun: Annotated[
        Path | None, typer.Option(help="A file for the rerun viewer to write, too (needs rerun-sdk).")
    ] = None,
) -> None:
    """What a calibration says: the points of all depth cameras in the base frame, with the arm's links drawn into them."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_policy_pi05_geometry.dataset_folder import require_dataset
    from lerobot_policy_pi05_geometry.geometry.calibration import read_calibration_file
    from lerobot_policy_pi05_geometry.geometry.dataset_calibration import check_state_names, read_dataset_calibration
    from lerobot_policy_pi05_geometry.geometry.dataset_depth import codec_bounds
    from lerobot_policy_pi05_geometry.geometry.keys import depth_features, find_depth_keys
    from lerobot_policy_pi05_geometry.inspect.inspection import frame_batch
    from lerobot_policy_pi05_geometry.inspect.scene import log_to_rerun, scene_figure, scene_of

    dataset = LeRobotDataset(dataset_repo_id, root=require_dataset(dataset_root))
    features = dataset.meta.features
    depth_keys = find_depth_keys(features, {})
    calibration = read_dataset_calibration(dataset.meta, depth_keys) if file is None else read_calibration_file(file)
    check_state_names(calibration, features)
    bounds = codec_bounds(features, list(depth_features(features, depth_keys)), depth_keys)
    ends = {camera: (low, high) for camera, (low, high) in bounds.items()}
    seen = scene_of(frame_batch(dataset, frame), calibration, bounds=ends, depth_keys=depth_keys)
    if not seen.points:
        raise ValueError(
            "No camera of the calibration has both depth in the dataset and a pose; run pi05-geometry calibrate."
        )
    scene_figure(seen).savefig(output, dpi=130)
    if rerun is not None:
        log_to_rerun(seen, str(rerun))
    console.print(f"Open [bold]{output}[/bold]")


def _read(file: Path):
    from lerobot_policy_pi05_geometry.geometry.calibration import Calibration, read_calibration_file

    return read_calibration_file(file) if file.exists() else Calibration()
