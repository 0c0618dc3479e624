"""Charts of a study's results. Each function returns a matplotlib figure."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")

from matplotlib.figure import Figure

INK = "#22303c"
COLOURS = {
    "geometry": "#0b7285",
    "geometry-after-rgb": "#5f3dc4",
    "rgb": "#e8590c",
    "rgb-wide": "#f59f00",
    "rgb+rays": "#4263eb",
    "rgb+modulation": "#2f9e44",
    "random": "#ae3ec9",
    "blind": "#868e96",
}
OTHER = "#74b8c4"  # variants of geometry


def success_figure(
    conditions: Sequence[str], arms: Mapping[str, Sequence[tuple[float, float, float] | None]]
) -> Figure:
    """Success rates with intervals, one panel per condition.

    arms: per arm one (rate, low, high) per condition, None where it was not evaluated.
    """
    columns = min(len(conditions), 4)
    rows = -(-len(conditions) // columns)
    size = (1.6 + 2.9 * columns, rows * (0.9 + 0.36 * len(arms)))
    figure = Figure(figsize=size, layout="constrained")
    panels = list(figure.subplots(rows, columns, sharey=True, sharex=True, squeeze=False).flat)
    y = np.arange(len(arms))[::-1]
    for i, condition in enumerate(conditions):
        axes = panels[i]
        for yi, (arm, values) in zip(y, arms.items(), strict=True):
            value = values[i]
            if value is None:
                axes.text(0.02, yi, "not evaluated", va="center", color=OTHER, fontsize=8)
                continue
            rate, low, high = value
            axes.barh(yi, rate, 0.62, color=COLOURS.get(arm, OTHER))
            axes.plot([low, high], [yi, yi], color=INK, linewidth=1.4)
            axes.text(high + 0.02, yi, f"{rate:.0%}", va="center", color=INK, fontsize=9)
        axes.set_title(textwrap.fill(condition, 30), fontsize=10)
        axes.set_xlim(0, 1.15)
        axes.set_xticks(np.linspace(0, 1, 3), [f"{v:.0%}" for v in np.linspace(0, 1, 3)])
        axes.set_yticks(y, list(arms))
        axes.spines[["top", "right"]].set_visible(False)
    for axes in panels[len(conditions) :]:
        axes.set_visible(False)
    figure.supxlabel("episodes that succeed, with 95 % intervals", fontsize=10)
    return figure


def curves_figure(curves: Mapping[str, Mapping[str, Sequence[float]]]) -> Figure:
    """Training loss per arm. curves: per arm {"step": [...], "loss": [...]}."""
    figure = Figure(figsize=(5.2, 3.4), layout="constrained")
    axes = figure.subplots()
    for arm, curve in curves.items():
        axes.plot(curve["step"], curve["loss"], color=COLOURS.get(arm), label=arm)
    axes.set_xlabel("training step")
    axes.set_ylabel("flow-matching loss")
    axes.set_yscale("log")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def horizon_figure(arms: Mapping[str, np.ndarray]) -> Figure:
    """Error by step ahead. arms: per arm (3, S), mean, low and high."""
    figure = Figure(figsize=(6.2, 3.6), layout="constrained")
    axes = figure.subplots()
    for arm, (mean, low, high) in arms.items():
        steps = np.arange(1, len(mean) + 1)
        (line,) = axes.plot(steps, mean, color=COLOURS.get(arm), label=arm, marker="o", markersize=3)
        axes.fill_between(steps, low, high, color=line.get_color(), alpha=0.15, linewidth=0)
    axes.set_xlabel("step ahead")
    axes.set_ylabel("error (standard deviations)")
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def growth_figure(
    panels: Sequence[str],
    steps: Sequence[int],
    arms: Mapping[str, Sequence[Mapping[int, Sequence[float]]]],
    floors: Sequence[float | None],
) -> Figure:
    """Success against training steps, one thin line per training seed and one thick line for their mean.

    panels: titles. steps: training steps of each multiple. arms: per arm and panel the success rate of every training seed, by
    training steps; not every arm has all of them. floors: per panel the blind policy's success rate.
    """
    figure, axes_of = _panels(len(panels), 3.4, 2.9)
    for i, title in enumerate(panels):
        axes = axes_of[i]
        floor = floors[i]
        if floor is not None:
            axes.axhline(floor, color=COLOURS["blind"], linestyle=":", label="blind floor" if i == 0 else None)
        for arm, of_panel in arms.items():
            if not of_panel[i]:
                continue
            x, of_steps = zip(*sorted(of_panel[i].items()), strict=True)
            rates = np.array(of_steps)  # (multiples, seeds)
            colour = COLOURS.get(arm, OTHER)
            axes.plot(x, rates, color=colour, linewidth=0.7, marker=".", markersize=4, alpha=0.5)
            axes.plot(x, rates.mean(axis=1), color=colour, linewidth=2, marker="o", label=arm if i == 0 else None)
        axes.set_title(textwrap.fill(title, 40), fontsize=10)
        axes.set_xscale("log", base=2)
        axes.set_xticks(list(steps), [f"{step:,}" for step in steps])
        _rate_axis(axes)
    figure.supxlabel("training steps", fontsize=10)
    figure.legend(loc="outside upper center", ncols=len(arms) + 1, frameon=False, fontsize=9)
    return figure


def sweep_figure(
    panels: Sequence[str],
    azimuths: Sequence[float],
    arms: Mapping[str, Sequence[np.ndarray | None]],
    trained: tuple[float, float],
) -> Figure:
    """Success against the camera's azimuth, with 95 % intervals.

    panels: titles. arms: per arm and panel (3, azimuths): rate, low, high, or None. trained: azimuths of the training range.
    """
    figure, axes_of = _panels(len(panels), 4.2, 3.0)
    for i, title in enumerate(panels):
        axes = axes_of[i]
        axes.axvspan(*trained, color="#e9ecef", label="training range" if i == 0 else None)
        for arm, of_panel in arms.items():
            values = of_panel[i]
            if values is None:
                continue
            rate, low, high = values
            colour = COLOURS.get(arm, OTHER)
            axes.plot(azimuths, rate, color=colour, marker="o", markersize=3, label=arm if i == 0 else None)
            axes.fill_between(azimuths, low, high, color=colour, alpha=0.12, linewidth=0)
        axes.set_title(textwrap.fill(title, 40), fontsize=10)
        axes.set_xticks(list(azimuths))
        _rate_axis(axes)
    figure.supxlabel("azimuth of the camera, degrees from the middle of the training range", fontsize=10)
    figure.legend(loc="outside upper center", ncols=len(arms) + 1, frameon=False, fontsize=9)
    return figure


def _panels(count: int, width: float, height: float) -> tuple[Figure, list[Any]]:
    """A figure with panels in rows of two, and the used ones of them."""
    columns = min(count, 2)
    rows = -(-count // columns)
    figure = Figure(figsize=(1.0 + width * columns, 0.9 + height * rows), layout="constrained")
    axes = list(figure.subplots(rows, columns, sharey=True, squeeze=False).flat)
    for unused in axes[count:]:
        unused.set_visible(False)
    return figure, axes[:count]


def _rate_axis(axes: Any) -> None:
    axes.set_ylim(0, 1.02)
    axes.set_yticks(np.linspace(0, 1, 5), [f"{rate:.0%}" for rate in np.linspace(0, 1, 5)])
    axes.spines[["top", "right"]].set_visible(False)
