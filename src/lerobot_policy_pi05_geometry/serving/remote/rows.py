"""A LeRobot batch -> one request per row, in the smallest form that loses nothing."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...geometry.depth import check_dtype
from ...geometry.keys import CALIBRATION_PREFIX, is_geometry_key
from ...geometry.point_map import as_pose


def requests_of(batch: Mapping[str, Any], inputs: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Requests with what the server expects of this batch.

    batch: images (B, 3, H, W) or (B, H, W, 3), depth (B, 1, H, W), (B, H, W, 1) or (B, H, W), poses (B, 4, 4) or (4, 4), or as
    16 numbers, the rest (B, D), and `task`, one for all rows or one for each. inputs: of the server's metadata; what it does not
    name stays here. Raises ValueError for nothing that is expected, another number of tasks, and depth that is no distance.
    """
    tensors = {key: batch[key].detach().cpu() for key in inputs if isinstance(batch.get(key), Tensor)}
    if not tensors:
        raise ValueError(f"The observation has nothing of what the server expects: {', '.join(inputs)}.")
    size = next(t.shape[0] for key, t in tensors.items() if not key.startswith(CALIBRATION_PREFIX))
    tasks = batch.get("task") or ""
    tasks = [tasks] if isinstance(tasks, str) else list(tasks)
    tasks = tasks * size if len(tasks) == 1 else tasks
    if len(tasks) != size:
        raise ValueError(f"The batch has {size} rows but {len(tasks)} tasks; give one task, or one for each.")
    arrays = {key: _packed(key, tensor, size) for key, tensor in tensors.items()}
    return [{**{key: array[row] for key, array in arrays.items()}, "task": tasks[row]} for row in range(size)]


def _packed(key: str, tensor: Tensor, size: int) -> np.ndarray:
    """A batch in the dtype and layout of the wire."""
    if key.startswith(CALIBRATION_PREFIX):
        return as_pose(tensor.float(), key).expand(size, 4, 4).contiguous().numpy()
    if is_geometry_key(key):
        check_dtype(tensor, key)
        return _packed_depth(tensor)
    if tensor.ndim == 4:
        return _packed_images(tensor)
    return tensor.float().contiguous().numpy()


def _packed_images(images: Tensor) -> np.ndarray:
    """(B, H, W, 3): uint8 if that is what the floats were made of, else float32."""
    if images.shape[-1] != 3:
        images = images.permute(0, 2, 3, 1)
    if images.dtype != torch.uint8:
        images = images.float()
        whole = (images * 255).round()
        exact = torch.equal(whole / 255, images) and whole.min() >= 0 and whole.max() <= 255  # beyond, uint8 would wrap
        images = whole.to(torch.uint8) if exact else images
    return images.contiguous().numpy()


def _packed_depth(depth: Tensor) -> np.ndarray:
    """uint16 if all distances are whole numbers of that range (millimetres), else float32."""
    if depth.dtype == torch.uint16:
        return depth.contiguous().numpy()
    depth = depth.float()
    if torch.equal(depth.round(), depth) and depth.min() >= 0 and depth.max() <= 65535:  # NaN is equal to nothing
        return depth.contiguous().numpy().astype(np.uint16)
    return depth.contiguous().numpy()
