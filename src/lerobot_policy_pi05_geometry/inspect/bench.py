"""Latency of an action chunk of a checkpoint on this machine, of its parts, and advice that follows from it."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from lerobot.configs import FeatureType
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS, OBS_STATE

from ..checkpoint.load import LoadedPolicy
from ..configuration_pi05_geometry import PI05GeometryConfig
from ..data.images import prepare_images
from ..geometry.keys import (
    CALIBRATION_PREFIX,
    RIG,
    depth_camera_name,
    extrinsics_key,
    find_depth_key,
    is_depth_key,
)
from ..geometry.resolve import one_metre
from ..inference.runner import ChunkRunner, ChunkSettings, Observation
from ..model.segments import GeometryTokens

PARTS = ("prompt and state", "geometry features", "vision and text", "prefix", "geometry", "denoising", "actions out")
STEPS = (1, 2, 3, 5, 10)  # numbers of denoising steps that are timed beside the checkpoint's own
_LARGE = 0.3  # a part with at least this share of the time gets advice


@dataclass(frozen=True)
class Timing:
    """Milliseconds: median and 95th percentile."""

    p50: float
    p95: float


@dataclass(frozen=True)
class BenchResult:
    """Timings of a prediction with the configured runner and with the plain path, of its parts, and advice.

    steps: the prediction with other numbers of denoising steps, fewest first.
    """

    chunk: Timing
    plain: Timing
    parts: dict[str, Timing]
    steps: dict[int, Timing]
    explanation: dict[str, str]
    peak_bytes: int | None
    advice: list[str]


def random_observation(config: PI05GeometryConfig, task: str = "do the task") -> dict[str, Any]:
    """An observation of one sample with the shapes that a checkpoint expects: noise for images, depth 1 m at every pixel.

    Raises ValueError for a checkpoint whose cameras come from the data that it will be trained on.
    """
    if not config.input_features:
        raise ValueError(
            "This checkpoint names no cameras and no state yet (the data that it is trained on will), so no observation can be "
            "made up for it; give --dataset.root, or train it first."
        )
    random = torch.Generator().manual_seed(0)
    observation: dict[str, Any] = {"task": [task]}
    rig = config.rig if config.rig is not None else next(iter(sorted(map(int, config.rigs))), None)
    for key, feature in {**(config.input_features or {}), **config.geometry_features}.items():
        shape = (1, *feature.shape)
        if key == RIG:
            observation[key] = torch.tensor([[rig or 0]])
        elif key.startswith(CALIBRATION_PREFIX):
            observation[key] = torch.eye(4)[None]
        elif is_depth_key(key, config.depth_keys) and key in config.geometry_features:
            camera = next((name for name, own in config.depth_keys.items() if own == key), depth_camera_name(key))
            observation[key] = torch.full(shape, one_metre(config, camera, rig))
        elif feature.type is FeatureType.VISUAL:
            observation[key] = torch.rand(shape, generator=random)
        elif key == OBS_STATE:
            observation[key] = torch.zeros(shape)
    for camera, calibration in config.calibration.items():
        if calibration.extrinsics is not None or calibration.mount is not None:
            continue  # its pose is known, or computed from the state, which is timed too
        if find_depth_key(camera, observation, config.depth_keys) is not None:
            observation.setdefault(extrinsics_key(camera), torch.eye(4)[None])
    return observation


@torch.inference_mode()
def bench(loaded: LoadedPolicy, observation: dict[str, Any], rounds: int = 20) -> BenchResult:
    """Time predictions from one observation, after two warm-up predictions.

    Raises ValueError for fewer than one round.
    """
    if rounds < 1:
        raise ValueError(f"rounds must be at least 1, got {rounds}.")
    policy, device = loaded.policy, str(loaded.policy.config.device)
    policy.eval()
    _reset_peak(device)

    def predict(**how: Any) -> None:
        chunk = policy.predict_action_chunk(loaded.preprocess(dict(observation)), **how)
        loaded.postprocess(chunk[:, 0])

    chunk = _time(predict, rounds, device)
    peak = torch.cuda.max_memory_allocated() if device.startswith("cuda") else None
    plain = _time(lambda: predict(runner="plain"), rounds, device)
    explanation = policy.sampler.explain(policy.config.inference_runner)  # type: ignore[arg-type]
    parts = _parts(loaded, observation, rounds, device) if explanation["runner"] == "active" else {}
    own = policy.config.num_inference_steps
    steps = {n: _time(partial(predict, num_steps=n), rounds, device) for n in STEPS if n != own}
    steps = dict(sorted((steps | {own: chunk}).items()))
    advice = _advice(policy.config, steps, parts, explanation)
    return BenchResult(chunk, plain, parts, steps, explanation, peak, advice)


def _parts(loaded: LoadedPolicy, observation: dict[str, Any], rounds: int, device: str) -> dict[str, Timing]:
    """The same prediction in parts. On a GPU this is without CUDA graphs, so the parts take longer than the whole."""
    policy = loaded.policy
    config, runner = policy.config, ChunkRunner(policy.model)
    in_prefix = policy.model.geometry_in_prefix
    times: dict[str, list[float]] = {part: [] for part in PARTS}
    noise = torch.randn(1, config.chunk_size, config.max_action_dim).to(device)

    def step(part: str, run: Callable[[], Any]) -> Any:
        _synchronise(device)
        start = time.perf_counter()
        result = run()
        _synchronise(device)
        times[part].append(1e3 * (time.perf_counter() - start))
        return result

    def measure(batch: dict[str, Any]) -> GeometryTokens | None:
        return None if policy.geometry is None else policy.geometry(batch)

    def embed(batch: dict[str, Any], tokens: GeometryTokens | None) -> Any:
        images, masks = prepare_images(batch, config, torch.device(device))
        text = (batch[OBS_LANGUAGE_TOKENS], batch[OBS_LANGUAGE_ATTENTION_MASK])
        return runner.embed_prefix(Observation(images, masks, *text), tokens if in_prefix else None)

    width = config.action_feature.shape[0]
    for _ in range(rounds + 2):
        batch = step("prompt and state", partial(loaded.preprocess, dict(observation)))
        tokens = step("geometry features", partial(measure, batch))
        prefix = step("vision and text", partial(embed, batch, tokens))
        own = None if in_prefix else tokens  # a segment of its own
        lengths = (0 if own is None else own.pad.shape[1], config.chunk_size)
        settings = ChunkSettings(lengths[0], lengths, config.num_inference_steps, 0.0)
        context = step("prefix", partial(runner.prefill_prefix, prefix, lengths))
        segment = step("geometry", partial(runner.prefill_geometry, context, own))
        actions = step("denoising", partial(runner.denoise_suffix, context, noise, segment, None, settings))
        step("actions out", partial(loaded.postprocess, actions[:, 0, :width]))
    return {part: _timing(values[2:]) for part, values in times.items()}


def _advice(
    config: PI05GeometryConfig, steps: dict[int, Timing], parts: dict[str, Timing], explanation: dict[str, str]
) -> list[str]:
    """Advice that follows from the measurement, for the largest part first."""
    advice = []
    if explanation["runner"] != "active":
        advice.append(f"The runner is off ({explanation['runner']}): enable it first.")
    whole = sum(part.p50 for part in parts.values())
    large = {name: part.p50 / whole for name, part in parts.items() if part.p50 > _LARGE * whole}
    cameras = len(config.image_features)
    for name, share in sorted(large.items(), key=lambda item: -item[1]):
        own = config.num_inference_steps
        fewer = [count for count in steps if count <= own // 2]
        if name == "denoising" and fewer:
            advice.append(
                f"Denoising takes {share:.0%}: with {fewer[-1]} steps instead of {own} a chunk took "
                f"{steps[fewer[-1]].p50:.1f} ms instead of {steps[own].p50:.1f} (--policy.num_inference_steps; check the "
                "success rate)."
            )
        if name in ("vision and text", "prefix") and cameras > 1:
            advice.append(f"{name.capitalize()} takes {share:.0%} for {cameras} cameras: it grows with each.")
        if name == "geometry features":
            advice.append(
                f"Geometry features take {share:.0%}: use a smaller encoder or image size, or a depth camera."
            )
        if name == "prompt and state":
            advice.append(f"Tokenising and normalising take {share:.0%}: the network is small in comparison.")
    if config.dtype == "float32" and config.paligemma_variant == "gemma_2b":
        advice.append(
            "Matrix products are computed in float32: --policy.dtype=bfloat16 (and param_dtype=bfloat16) halves memory traffic."
        )
    if config.n_action_steps < config.chunk_size // 2:
        advice.append(
            f"Only {config.n_action_steps} of {config.chunk_size} predicted actions are used per chunk: "
            "a larger --policy.n_action_steps needs fewer predictions."
        )
    return advice


def _time(run: Callable[[], Any], rounds: int, device: str) -> Timing:
    values = []
    for _ in range(rounds + 2):
        _synchronise(device)
        start = time.perf_counter()
        run()
        _synchronise(device)
        values.append(1e3 * (time.perf_counter() - start))
    return _timing(values[2:])


def _timing(values: list[float]) -> Timing:
    ordered = sorted(values)
    return Timing(statistics.median(values), ordered[min(len(ordered) - 1, round(0.95 * len(ordered)))])


def _synchronise(device: str) -> None:
    if device.startswith("cuda"):
        torch.cuda.synchronize()


def _reset_peak(device: str) -> None:
    if device.startswith("cuda"):
        torch.cuda.reset_peak_memory_stats()
