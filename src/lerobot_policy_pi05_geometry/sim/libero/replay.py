"""LIBERO's original demonstrations, rendered anew with depth and calibration, and with moved cameras if asked.

Every state is set, not simulated: a simulation drifts. What was rendered is checked before it is written: the stored image
against the rendered one, the task's goal in the last state, and depth against ray casting.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .cameras import CameraMove, find_range
from .demonstrations import Demonstration, read_demonstrations, task_of
from .environment import depth_key, extrinsics_key, hand_state, public_orientation
from .record import DatasetWriter
from .rendering import CAMERAS, CameraRig, ray_errors
from .scene import LiberoScene

MAX_IMAGE_ERROR = 6.0  # mean absolute difference to the stored image, of 255; shadows off would give some 4
MAX_DEPTH_ERROR = 0.002  # metres, median over rays
CHECKED_FRAMES = 4


@dataclass(frozen=True)
class Replayed:
    """What became of one demonstration. reason: why it was left out, or empty."""

    demonstration: str
    frames: int
    reason: str = ""


def replay(
    files: Sequence[Path],
    root: Path,
    repo_id: str,
    cameras: str = "fixed",
    views: Sequence[str] = tuple(CAMERAS),
    image_size: int = 256,
    rendering: str = "full",
    limit: int | None = None,
) -> Iterator[Replayed]:
    """Render demonstrations into one LeRobotDataset at `root`; yields what became of each.

    cameras: range that the front camera's place is drawn from, anew for every demonstration. limit: of demonstrations of
    each file. No-ops are dropped by OpenVLA's rule, and so are demonstrations that do not end in success.

    Raises ValueError if a demonstration does not show what its states say (another version of LIBERO or of its meshes).
    """
    chosen = find_range(cameras)
    writer = DatasetWriter(root, repo_id, views, image_size)
    calibration: dict[str, Any] = {}
    for file in files:
        scene = LiberoScene(task_of(Path(file)), image_size, tuple(views), rendering)
        try:
            for number, demonstration in enumerate(read_demonstrations(Path(file))):
                if limit is not None and number >= limit:
                    break
                generator = np.random.default_rng([number, len(demonstration.states)])
                frames, reason = _render(scene, demonstration, chosen.draw(generator), views)
                if not reason:
                    writer.add_episode(frames, scene.task.instruction)
                yield Replayed(demonstration.name, len(frames), reason)
            if scene.rig is not None:
                calibration = {name: scene.rig.calibration[name] for name in views}
        finally:
            scene.close()
    writer.finish(calibration)


def _render(
    scene: LiberoScene, demonstration: Demonstration, move: CameraMove, views: Sequence[str]
) -> tuple[list[dict], str]:
    """Frames of a demonstration, or none and the reason why it is left out."""
    _prepare(scene, demonstration)
    if not _succeeds(scene, demonstration):
        return [], "its last state is not a success"
    _check_images(scene, demonstration)
    scene.move_camera(move)
    frames = []
    kept = demonstration.kept()
    checked = set(np.linspace(0, len(kept) - 1, CHECKED_FRAMES).astype(int).tolist())
    for number, step in enumerate(kept):
        observation = scene.set_state(demonstration.states[step])
        if number in checked:
            check_depth(scene, demonstration.name)
        frame: dict[str, Any] = {
            "observation.state": hand_state(observation, scene.base),
            "action": demonstration.actions[step].astype(np.float32),
        }
        for name in views:
            seen = scene.frames[name]
            millimetres = np.rint(seen.depth * 1000.0)
            frame[f"observation.images.{name}"] = public_orientation(seen.pixels)
            frame[f"observation.{depth_key(name)}"] = np.where(millimetres > 10_000, 0, millimetres)[..., None].astype(
                np.uint16
            )
            frame[f"observation.{extrinsics_key(name)}"] = seen.extrinsics.astype(np.float32).flatten()
        frames.append(frame)
    return frames, ""


def _prepare(scene: LiberoScene, demonstration: Demonstration) -> None:
    """Reset the scene, then put its fixtures where the demonstration had them: states do not say."""
    expected = 1 + scene.model.nq + scene.model.nv
    if demonstration.states.shape[1] != expected:
        raise ValueError(
            f"{demonstration.name} has states of {demonstration.states.shape[1]} numbers; this LIBERO's {scene.task.name} "
            f"has {expected}: the file is of another version of LIBERO."
        )
    scene.reset(0, state=demonstration.states[0])
    for name, fixture in scene.env.fixtures_dict.items():
        if not hasattr(fixture, "root_body") or fixture.root_body not in demonstration.fixtures:
            if name in scene.env.obj_body_id and name in scene.env.object_states_dict:
                raise ValueError(f"{demonstration.name}: its model_file does not say where {name} stands.")
            continue
        body = scene.model.body(fixture.root_body).id
        scene.model.body_pos[body], scene.model.body_quat[body] = demonstration.fixtures[fixture.root_body]


def _succeeds(scene: LiberoScene, demonstration: Demonstration) -> bool:
    """Whether the goal is reached in the last state, or by the last action, which no state follows."""
    scene.set_state(demonstration.states[-1])
    if scene.env._check_success():
        return True
    return scene.step(demonstration.actions[-1])[1]


def _check_images(scene: LiberoScene, demonstration: Demonstration) -> None:
    if demonstration.images is None:
        return
    rig = CameraRig(scene.model, demonstration.images.shape[1], "full", depth=False)
    try:
        for step in np.linspace(0, len(demonstration.states) - 2, CHECKED_FRAMES).astype(int):
            scene.set_state(demonstration.states[step + 1])
            rendered = rig.take(scene.data, "front").pixels.astype(float)
            error = float(np.abs(rendered - demonstration.images[step]).mean())
            if error > MAX_IMAGE_ERROR:
                raise ValueError(
                    f"{demonstration.name}, step {step}: the stored image differs by {error:.1f} of 255 from what its state "
                    f"renders to (at most {MAX_IMAGE_ERROR} is accepted); its LIBERO, robosuite or meshes are other ones."
                )
    finally:
        rig.close()


def check_depth(scene: LiberoScene, where: str) -> None:
    """Raise ValueError if a camera's depth is not what rays meet."""
    if scene.rig is None:
        return
    for name, frame in scene.frames.items():
        error = float(np.median(ray_errors(scene.rig, scene.data, name, frame)))
        if not error < MAX_DEPTH_ERROR:
            raise ValueError(f"{where}: depth of camera '{name}' differs by {error * 1000:.1f} mm from ray casting.")
