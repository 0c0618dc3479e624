"""The demo's page: the answer first, then what it is made of."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from ..inspect.inspection import frame_batch
from ..inspect.page import Page, picture, video
from ..inspect.pictures import curves_figure, depth_figure, layout_figure, segment_share_figure, success_figure
from ..loading import LoadedPolicy, load_policy
from ..sim.evaluate import Evaluation
from .run import ARMS, CONDITIONS, DemoSettings, checkpoint, read_curve


def write_report(folder: Path, settings: DemoSettings, results: Mapping[str, Mapping[str, Evaluation]]) -> Path:
    """Write report.html, results.json and the pictures; returns the path of the page."""
    numbers = {arm: {c: e.to_json() for c, e in by_condition.items()} for arm, by_condition in results.items()}
    (folder / "results.json").write_text(json.dumps(numbers, indent=2))
    pictures = folder / "pictures"
    pictures.mkdir(exist_ok=True)
    page = Page("Does geometry help? One task, one training run each")
    page.lead(answer(results))
    bars = {arm: [(e.rate, *e.interval()) for e in by.values()] for arm, by in results.items()}
    page.row(
        picture(
            success_figure(list(CONDITIONS.values()), bars),
            f"{settings.evaluation_episodes} unseen seeds per bar, the same for every policy.",
            pictures / "success.png",
        )
    )
    page.table(
        ["policy", "what it sees", *CONDITIONS.values()],
        [[arm, ARMS[arm], *(_cell(e) for e in results[arm].values())] for arm in ARMS],
    )
    page.text(
        f"Task: {settings.task}. {settings.episodes} expert episodes with the camera within the training range; "
        f"{settings.steps} training steps of {settings.batch_size} samples each ({settings.blind_steps} for blind). The same "
        "data, seed and sizes for all. One training seed: a difference within the intervals is no difference."
    )
    page.heading("What it looks like")
    for condition, title in CONDITIONS.items():
        clips = _side_by_side(results, condition)
        if clips is not None:
            page.row(
                video(clips, 10, f"Geometry left, RGB only right; {title}.", pictures / f"rollout_{condition}.mp4")
            )
    page.heading("Inside the policy with geometry")
    loaded, batch = _observation(folder)
    page.row(
        picture(
            depth_figure(loaded.policy, batch),
            "The first frame of the dataset. Right: attention of the action tokens on geometry at the last denoising "
            "step, mean over layers, heads and tokens.",
            pictures / "depth.png",
        )
    )
    page.row(
        picture(
            layout_figure(loaded.policy, batch),
            "Rows look at columns. The prefix never sees geometry; the actions see everything.",
            pictures / "layout.png",
        ),
        picture(
            segment_share_figure(loaded.policy, batch),
            "What the action tokens attend to, layer by layer.",
            pictures / "shares.png",
        ),
    )
    page.heading("Training")
    curves = {arm: read_curve(folder, arm) for arm in ARMS}
    page.row(picture(curves_figure(curves), "Loss on training batches.", pictures / "curves.png"))
    page.heading("Again, or on your own")
    page.code(
        "pi05-geometry demo\n"
        f"pi05-geometry evaluate {checkpoint(folder, 'geometry')} --cameras far\n"
        f"pi05-geometry inspect {checkpoint(folder, 'geometry')} --dataset.root={folder / 'dataset'}"
    )
    path = folder / "report.html"
    page.write(path)
    return path


def answer(results: Mapping[str, Mapping[str, Evaluation]]) -> str:
    """What came out, in one sentence, whatever it is."""
    outside = {arm: results[arm]["outside"] for arm in ARMS}
    inside = {arm: results[arm]["train"] for arm in ARMS}
    geometry, rgb = outside["geometry"], outside["rgb"]
    apart = geometry.interval()[0] > rgb.interval()[1] or rgb.interval()[0] > geometry.interval()[1]
    verdict = "the intervals do not overlap" if apart else "the intervals overlap, so this run does not tell them apart"
    return (
        f"With the camera outside the range it was trained on, the policy with geometry succeeds in {geometry.rate:.0%} of "
        f"episodes and RGB only in {rgb.rate:.0%} ({verdict}); within the range it is {inside['geometry'].rate:.0%} and "
        f"{inside['rgb'].rate:.0%}. A policy that sees nothing reaches {outside['blind'].rate:.0%}."
    )


def _cell(evaluation: Evaluation) -> str:
    low, high = evaluation.interval()
    return f"{evaluation.rate:.0%} ({low:.0%} to {high:.0%})"


def _side_by_side(results: Mapping[str, Mapping[str, Evaluation]], condition: str) -> np.ndarray | None:
    """The first episodes of geometry and RGB only on the same seeds, one after the other, (T, H, 2 W, 3)."""
    clips = []
    for left, right in zip(results["geometry"][condition].videos, results["rgb"][condition].videos, strict=True):
        length = max(len(left), len(right)) + 5  # a short rest between episodes
        padded = [np.concatenate([clip, clip[-1:].repeat(length - len(clip), axis=0)]) for clip in (left, right)]
        clips.append(np.concatenate(padded, axis=2))
    return np.concatenate(clips) if clips else None


def _observation(folder: Path) -> tuple[LoadedPolicy, dict]:
    """The policy with geometry and the dataset's first frame, preprocessed."""
    loaded = load_policy(checkpoint(folder, "geometry"))
    return loaded, loaded.preprocess(frame_batch(LeRobotDataset("local/demo", root=folder / "dataset"), 0))
