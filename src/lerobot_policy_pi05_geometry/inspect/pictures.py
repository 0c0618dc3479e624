"""Figures. Each function returns a matplotlib figure of measured values."""

import math
from collections.abc import Mapping

import matplotlib
import numpy as np
import torch
from torch import Tensor

matplotlib.use("Agg")

from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from ..geometry.depth import to_metres
from ..geometry.keys import find_depth_key
from ..modeling_pi05_geometry import PI05GeometryPolicy
from .attention import attention_layout, suffix_attention

SEGMENT_COLOURS = ("#4263eb", "#0b7285", "#e8590c")
SEGMENT_NAMES = ("prefix", "geometry", "suffix")


def layout_figure(policy: PI05GeometryPolicy, batch: Mapping[str, Tensor]) -> Figure:
    """The attention mask of the batch's first sample, coloured by the segment of the key."""
    mask, lengths = attention_layout(policy, batch)
    column_segment = np.repeat(np.arange(3), lengths)
    image = np.where(mask.cpu().numpy(), column_segment[None] + 1, 0)
    figure = Figure(figsize=(5.2, 4.8), layout="constrained")
    axes = figure.subplots()
    axes.imshow(image, cmap=ListedColormap(["#f1f3f5", *SEGMENT_COLOURS]), vmin=0, vmax=3, interpolation="nearest")
    ends = np.cumsum(lengths)
    for end in ends[:-1]:
        axes.axhline(end - 0.5, color="white", linewidth=1.5)
        axes.axvline(end - 0.5, color="white", linewidth=1.5)
    shown = [i for i in range(3) if lengths[i]]
    centres = [ends[i] - lengths[i] / 2 - 0.5 for i in shown]
    labels = [f"{SEGMENT_NAMES[i]} ({lengths[i]})" for i in shown]
    axes.set_xticks(centres, labels)
    axes.set_yticks(centres, labels, rotation=90, va="center")
    axes.set_xlabel("key (white columns: padding and holes)")
    axes.set_ylabel("query")
    axes.set_title("Attention mask, as the network applied it")
    return figure


def depth_figure(policy: PI05GeometryPolicy, batch: Mapping[str, Tensor]) -> Figure:
    """Per depth camera: RGB, depth with its grid cells, and the attention of the action tokens on the cells."""
    source = policy.geometry.source
    attention = suffix_attention(policy, batch)
    prefix, geometry, _ = attention.lengths
    per_view = attention.weights[0, prefix : prefix + geometry].cpu()
    grid = source.grid
    views = per_view.reshape(len(source.cameras), grid, grid) if geometry else None
    figure = Figure(figsize=(11, 3.9 * len(source.cameras)), layout="constrained")
    axes = figure.subplots(len(source.cameras), 3, squeeze=False)
    for row, camera in zip(axes, source.cameras, strict=True):
        rgb = _rgb(batch, camera)
        size = policy.config.depth_cameras()[camera]
        shown = np.full(size, np.nan)
        key = find_depth_key(camera, batch, policy.config.depth_keys)
        if key is not None:
            raw = batch[key][:1].cpu()
            placed = source.placed[camera]
            factor = placed.depth_factor(
                placed.rows({name: value[:1] for name, value in batch.items() if isinstance(value, Tensor)}), raw.device
            )
            bounds = source.bounds.get(camera, (0.0, math.inf))
            depth, valid = to_metres(
                raw, camera, policy.config.depth_unit, size, policy.config.max_depth, factor, bounds
            )
            shown[:] = np.where(valid[0, 0].numpy(), depth[0, 0].numpy(), np.nan)
        if rgb is not None:
            row[0].imshow(rgb)
        row[0].set_title(f"{camera}: RGB, input of the VLM")
        drawn = row[1].imshow(shown, cmap="viridis_r")
        figure.colorbar(drawn, ax=row[1], label="metres", shrink=0.8)
        _grid_lines(row[1], shown.shape, grid)
        row[1].set_title(f"{camera}: depth, {grid} x {grid} cells")
        if rgb is not None:
            row[2].imshow(rgb, alpha=0.55)
        if views is not None:
            heat = views[source.cameras.index(camera)].numpy()
            height, width = shown.shape
            drawn = row[2].imshow(
                heat, cmap="magma", alpha=0.6, extent=(-0.5, width - 0.5, height - 0.5, -0.5), interpolation="nearest"
            )
            figure.colorbar(drawn, ax=row[2], label="attention", shrink=0.8)
        row[2].set_title("attention of the action tokens")
    for ax in axes.flat:
        ax.set_xticks([])
        ax.set_yticks([])
    return figure


def segment_share_figure(policy: PI05GeometryPolicy, batch: Mapping[str, Tensor]) -> Figure:
    """Share of the action tokens' attention per segment and layer."""
    attention = suffix_attention(policy, batch)
    ends = np.cumsum((0, *attention.lengths))
    per_layer = attention.per_layer.mean(dim=1).cpu().numpy()  # (layers, keys)
    figure = Figure(figsize=(5.2, 3.4), layout="constrained")
    axes = figure.subplots()
    bottom = np.zeros(len(per_layer))
    for i, name in enumerate(SEGMENT_NAMES):
        share = per_layer[:, ends[i] : ends[i + 1]].sum(axis=1)
        axes.bar(np.arange(len(share)) + 1, share, bottom=bottom, color=SEGMENT_COLOURS[i], label=name)
        bottom += share
    axes.set_xticks(np.arange(len(per_layer)) + 1)
    axes.set_xlabel("layer")
    axes.set_ylabel("share of the action tokens' attention")
    axes.set_ylim(0, 1)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=3, frameon=False)
    return figure


def _rgb(batch: Mapping[str, Tensor], camera: str) -> np.ndarray | None:
    """RGB of the batch's first sample, (H, W, 3) in [0, 1]; None if the depth camera has no colour twin."""
    image = batch.get(f"observation.images.{camera}")
    if image is None:
        return None
    image = image[0].cpu()
    image = image.permute(1, 2, 0) if image.shape[0] == 3 else image
    return (image.float() / 255 if image.dtype == torch.uint8 else image.float()).clamp(0, 1).numpy()


def _grid_lines(axes, shape: tuple[int, ...], grid: int) -> None:
    for i in range(1, grid):
        axes.axhline(i * shape[0] / grid - 0.5, color="white", linewidth=0.5)
        axes.axvline(i * shape[1] / grid - 0.5, color="white", linewidth=0.5)
