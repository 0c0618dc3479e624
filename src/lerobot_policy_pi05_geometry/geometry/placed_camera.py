"""One camera on one or several rigs: its intrinsics, depth scale and pose for every row of a batch, on the batch's device."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from .calibration import Rig
from .camera import CameraCalibration, sensor_T_images
from .depth import LEROBOT_COUNT
from .keys import RAW_STATE, RIG, batch_like
from .kinematics import ForwardKinematics
from .rigid import compose


class PlacedCamera:
    """A camera and where it stands. rigs: by id; data of one rig has one. size: (H, W) of its images, of depth or of colour.

    Frames differ in rig only if the data says so (`observation.calibration.rig`); `only` is the rig of a robot whose observations
    do not.
    """

    def __init__(self, name: str, rigs: Mapping[int, Rig], size: tuple[int, int], only: int | None = None) -> None:
        self.name, self.only = name, only
        self.ids = sorted(rigs)
        self.cameras: Sequence[CameraCalibration] = [rigs[number].cameras[name].as_recorded() for number in self.ids]
        self._rotations = [rigs[number].cameras[name].rotation for number in self.ids]
        self.kinematics = [
            None
            if camera.mount is None
            else ForwardKinematics(rigs[number].arms[camera.mount.arm], [camera.mount.link])
            for number, camera in zip(self.ids, self.cameras, strict=True)
        ]
        self._size = size
        self._at: dict[torch.device, tuple[Tensor, Tensor, Tensor, Tensor, Tensor]] = {}

    def check_view(self) -> None:
        """Raise ValueError if the images have another shape than the calibration of a rig.

        For depth, whose size is the data's. Camera rays depend on no size, and a checkpoint may declare another one for RGB.
        """
        for camera in self.cameras:
            camera.check_view(self.name, *self._size)

    @property
    def on_arm(self) -> bool:
        """Whether the pose follows from the state, on any rig."""
        return any(kinematics is not None for kinematics in self.kinematics)

    @property
    def placed(self) -> bool:
        """Whether every rig says where the camera is, by extrinsics or a mount."""
        return all(camera.extrinsics is not None or camera.mount is not None for camera in self.cameras)

    def rows(self, batch: Mapping[str, Tensor]) -> Tensor | None:
        """Position in `ids` of every row's rig, (B,); None if all rows are of one.

        Raises ValueError for data of several rigs that does not say which.
        """
        if len(self.ids) == 1:
            return None
        if RIG not in batch:
            if self.only is not None:
                return torch.tensor([self.ids.index(self.only)], device=batch_like(batch).device)
            raise ValueError(
                f"The policy was trained on data of several rigs ({', '.join(map(str, self.ids))}), and the "
                f"observation has no {RIG}; "
                "say which this robot is with --policy.rig, or give its own calibration with --policy.calibration_path."
            )
        return torch.searchsorted(torch.tensor(self.ids, device=batch[RIG].device), batch[RIG].flatten().long())

    def check_rigs(self, batch: Mapping[str, Tensor]) -> None:
        """Raise ValueError for a row whose rig is not known, or another than `only`.

        It looks at values, for which a GPU is waited for.
        """
        if len(self.ids) > 1 and RIG in batch:
            told = set(batch[RIG].flatten().tolist())
            if self.only is not None and told != {self.only}:
                raise ValueError(
                    f"{RIG} has {', '.join(map(str, sorted(told)))}, but --policy.rig is {self.only}; train on data of several "
                    "rigs with --policy.rig=null, and act with the rig that the robot is."
                )
            unknown = sorted(told - set(self.ids))
            if unknown:
                raise ValueError(
                    f"{RIG} has {', '.join(map(str, unknown))}, but the calibration has the rigs "
                    f"{', '.join(map(str, self.ids))}."
                )

    def intrinsics(self, rows: Tensor | None, device: torch.device) -> Tensor:
        """fx, fy, cx, cy of images as they arrive, (4,) or (B, 4)."""
        found = self._constants(device)[0]
        return found[0] if rows is None else found.index_select(0, rows)

    def depth_factor(self, rows: Tensor | None, device: torch.device) -> Tensor:
        """True metres per metre that LeRobot's count of a millimetre gives, (1,) or (B,)."""
        found = self._constants(device)[1]
        return found if rows is None else found.index_select(0, rows)

    def poses(self, batch: Mapping[str, Tensor], rows: Tensor | None, device: torch.device) -> Tensor:
        """`base_T_camera`, (4, 4) or (B, 4, 4), by the calibration and, for a camera on an arm, by the raw state."""
        _, _, fixed, mounts, _ = self._constants(device)
        if not self.on_arm:
            return fixed[0] if rows is None else fixed.index_select(0, rows)
        state = batch[RAW_STATE].to(device).float()
        by_rig = [
            fixed[number].expand(state.shape[0], 4, 4)
            if kinematics is None
            else compose(kinematics(state)[:, 0], mounts[number])
            for number, kinematics in enumerate(self.kinematics)
        ]
        if rows is None:
            return by_rig[0]
        rows = rows.expand(state.shape[0])
        return torch.stack(by_rig, dim=1)[torch.arange(state.shape[0], device=device), rows]

    def frame_poses(self, pose: Tensor, rows: Tensor | None) -> Tensor:
        """`base_T_camera` of images as they arrive, from poses of the sensor, (B, 4, 4) or (4, 4), that came with the frames."""
        if not any(self._rotations):
            return pose
        turns = self._constants(pose.device)[4]
        return compose(pose, (turns[0] if rows is None else turns.index_select(0, rows.to(pose.device))).to(pose.dtype))

    def _constants(self, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Intrinsics (R, 4), factors (R,), `base_T_camera` and `link_T_camera` (R, 4, 4), NaN where there is none, and
        `sensor_T_images` (R, 4, 4).

        Kept, since a copy to a GPU blocks.
        """
        if device not in self._at:
            nowhere = [[float("nan")] * 4] * 4
            intrinsics = [camera.scaled_intrinsics(*self._size) for camera in self.cameras]
            factors = [1.0 if c.depth_scale is None else c.depth_scale / LEROBOT_COUNT for c in self.cameras]
            fixed = [nowhere if c.extrinsics is None else c.extrinsics for c in self.cameras]
            mounts = [nowhere if c.mount is None else c.mount.link_T_camera for c in self.cameras]
            turns = [sensor_T_images(rotation) for rotation in self._rotations]
            made = [torch.tensor(values, device=device) for values in (intrinsics, factors, fixed, mounts, turns)]
            self._at[device] = (made[0], made[1], made[2], made[3], made[4])
        return self._at[device]
