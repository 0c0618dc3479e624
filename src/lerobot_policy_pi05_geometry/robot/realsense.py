"""What a connected RealSense camera knows about itself: intrinsics, depth scale, and where its colour sensor stands."""

from typing import Any

import numpy as np

from ..geometry.camera import CameraCalibration, ColorStream


def read_camera(serial: str, width: int, height: int, fps: int, rotation: int = 0) -> CameraCalibration:
    """Calibration of the depth stream of the camera with this serial number, with its colour stream.

    width, height, fps: of the sensor, as in the robot's camera configuration (before `rotation`, degrees clockwise).
    Raises ModuleNotFoundError without pyrealsense2, and ConnectionError or ValueError with one sentence.
    """
    rs = _pyrealsense2()
    config = rs.config()
    config.enable_device(serial)
    config.enable_stream(rs.stream.depth, width, height, rs.format.z16, fps)
    config.enable_stream(rs.stream.color, width, height, rs.format.rgb8, fps)
    pipeline = rs.pipeline()
    try:
        started = pipeline.start(config)
    except RuntimeError as error:
        raise ConnectionError(
            f"RealSense {serial} does not start with {width} x {height} at {fps} fps ({error}); `lerobot-find-cameras realsense` "
            "lists what is connected."
        ) from error
    try:
        scale = started.get_device().first_depth_sensor().get_depth_scale()
        return calibration_of(started.get_stream(rs.stream.depth), started.get_stream(rs.stream.color), scale, rotation)
    finally:
        pipeline.stop()


def calibration_of(depth: Any, color: Any, depth_scale: float, rotation: int = 0) -> CameraCalibration:
    """Calibration from two stream profiles of pyrealsense2. depth_scale: metres of one count."""
    of_depth, of_color = (profile.as_video_stream_profile().get_intrinsics() for profile in (depth, color))
    if any(abs(value) > 1e-9 for value in of_depth.coeffs):
        raise ValueError(
            "The camera's depth stream is distorted, which no pinhole describes; RealSense D400 cameras give rectified depth."
        )
    between = color.get_extrinsics_to(depth)
    depth_T_color = np.eye(4)
    depth_T_color[:3, :3] = np.array(between.rotation).reshape(3, 3).T  # librealsense stores columns
    depth_T_color[:3, 3] = between.translation
    stream = ColorStream(
        _numbers(of_color), [of_color.width, of_color.height], depth_T_color.tolist(), _distortion(of_color)
    )
    camera = CameraCalibration(
        _numbers(of_depth),
        [of_depth.width, of_depth.height],
        depth_scale=round(float(depth_scale), 8),
        rotation=rotation,
        color=stream,
    )
    camera.check("RealSense")
    return camera


def _numbers(intrinsics: Any) -> list[float]:
    # librealsense has the centre of pixel (0, 0) at (0, 0), as OpenCV and this package have.
    return [float(value) for value in (intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy)]


def _distortion(intrinsics: Any) -> list[float]:
    """OpenCV's five coefficients. RealSense's "inverse Brown-Conrady" of colour undistorts; its coefficients are near 0."""
    rs = _pyrealsense2()
    known = (rs.distortion.none, rs.distortion.brown_conrady, rs.distortion.inverse_brown_conrady)
    if intrinsics.model not in known:
        raise ValueError(f"The colour stream has the lens model {intrinsics.model}, which is not OpenCV's.")
    sign = -1.0 if intrinsics.model == rs.distortion.inverse_brown_conrady else 1.0
    return [sign * float(value) for value in intrinsics.coeffs]


def _pyrealsense2() -> Any:
    try:
        import pyrealsense2
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "Reading a RealSense needs pyrealsense2; install it with `pip install 'lerobot_policy_pi05_geometry[robot]'`."
        ) from error
    return pyrealsense2
