"""Checked requests of a batch in, action chunks out: processors and policy, as a local run calls them."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import torch
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from torch import Tensor

from ..checkpoint.load import LoadedPolicy
from ..compat import rtc_config_of
from ..configuration_checks import rtc_mode
from ..configuration_pi05_geometry import PI05GeometryConfig
from ..geometry.keys import CALIBRATION_PREFIX, DEPTH_SUFFIX, RIG, camera_of, is_geometry_key
from ..geometry.resolve import one_metre
from ..inference.warm_up import prompt_lengths
from .inputs import Guidance, Inputs, Request
from .limits import RequestError
from .noise import request_noise
from .session import Session


class Job(NamedTuple):
    """A request with what its session adds.

    noise: (S, max_action_dim). begins: the first of an episode. left_over: what of the session's last chunk was not executed,
    normalised, (T, A); None without guidance.
    """

    request: Request
    noise: Tensor
    begins: bool
    left_over: Tensor | None = None

    @property
    def group(self) -> tuple:
        """Jobs with the same one can share a batch."""
        arrays = sorted((key, array.shape, array.dtype.str) for key, array in self.request.observation.items())
        return tuple(arrays), self.guidance, None if self.left_over is None else len(self.left_over)

    @property
    def guidance(self) -> Guidance | None:
        """What guides this chunk. How many steps were executed has had its effect already: it cut the left-over."""
        given = self.request.guidance
        return None if given is None or self.left_over is None else given._replace(executed_steps=0)


class Answer(NamedTuple):
    """A chunk (S, A) float32 for the robot, and normalised for the session; how long its batch was computed and how many
    requests were in it, and how long it waited."""

    actions: np.ndarray
    chunk: Tensor
    infer_ms: float
    batch: int
    queue_ms: float = 0.0


def make_job(session: Session, request: Request, seed: int, shape: tuple[int, int]) -> Job:
    """The job of a session's next request. shape: of the noise."""
    if request.noise is None:
        noise = request_noise(seed, session.name, session.requests, shape)
    else:
        noise = torch.from_numpy(np.array(request.noise))  # a copy: the frame's own memory cannot be written to
    left_over = None
    if request.guidance is not None and session.chunk is not None:
        executed = request.guidance.executed_steps
        if executed < len(session.chunk):  # else nothing is left to continue
            left_over = session.chunk[executed:]
    return Job(request, noise, session.begins, left_over)


def note_answer(session: Session, request: Request, answer: Answer) -> None:
    """What the session keeps of an answer that is being sent."""
    session.requests += 1
    session.begins = False
    session.seen.update(key for key in request.observation if is_geometry_key(key))
    session.chunk, session.rig = answer.chunk, request.rig


class PolicyEngine:
    """Runs a loaded policy on batches of jobs. One thread at a time."""

    def __init__(self, loaded: LoadedPolicy, guidance: RTCConfig | None = None) -> None:
        """guidance: what real-time chunking uses where a request does not say; the checkpoint's by default."""
        self.policy, self.config = loaded.policy.eval(), loaded.policy.config
        self._preprocess, self._postprocess = loaded.preprocess, loaded.postprocess
        self._continues = self.config.rtc_config is not None or self.config.rtc_training_max_delay > 0
        self._guidance = guidance or self.config.rtc_config or rtc_config_of(rtc_mode(self.config))
        self._set_guidance(None)

    @property
    def noise_shape(self) -> tuple[int, int]:
        """(S, max_action_dim)."""
        return self.config.chunk_size, self.config.max_action_dim

    def run(self, jobs: Sequence[Job], size: int) -> list[Answer]:
        """Chunks of jobs of one group, computed as a batch of `size`: the last job fills it up.

        Raises RequestError if a chunk holds a number that is not finite, ValueError for what the policy refuses.
        """
        start = time.perf_counter()
        filled = [*jobs, *[jobs[-1]] * (size - len(jobs))]
        if any(job.begins for job in jobs):
            self.policy.start_episode()  # values of observations are looked into then
        with torch.no_grad():  # real-time chunking differentiates, which inference mode forbids
            batch = self._preprocess(collate([job.request for job in filled]))
            noise = torch.stack([job.noise for job in filled]).to(self.config.device)
            with self._guided(filled) as how:
                chunk = self.policy.predict_action_chunk(batch, noise=noise, **how)
            actions = self._postprocess(chunk).float().cpu()  # (B, S, A)
            chunk = chunk.cpu()
        if not actions.isfinite().all():
            raise RequestError("The policy computed an action that is not finite from this observation.")
        spent = (time.perf_counter() - start) * 1e3
        # Copies: a row must not keep its whole batch in memory.
        return [Answer(actions[i].numpy().copy(), chunk[i].clone(), spent, len(jobs)) for i in range(len(jobs))]

    def warm(self, inputs: Inputs, sizes: Sequence[int]) -> None:
        """Run every size of batch once with a short and a long instruction, so that kernels are loaded and graphs recorded.

        A checkpoint that is set up or trained for real-time chunking is run with it, too. Nothing that is recorded is dropped:
        there is a place for every size and length of prompt, with real-time chunking and without.
        """
        rig, nothing = next(iter(inputs.rigs.ids), None), torch.zeros(self.noise_shape)
        self.policy.sampler.reserve(2 * len(sizes) * len(prompt_lengths(self.config.tokenizer_max_length)))
        left_over = torch.zeros(self.noise_shape[0], self.config.action_feature.shape[0])
        for size, words in product(sizes, (1, 6)):
            for guidance in (None, Guidance(0, 0)) if self._continues else (None,):
                request = Request(_blank(inputs, self.config, rig), "warm up " * words, guidance, None, rig)
                self.run([Job(request, nothing, True, None if guidance is None else left_over)], size)
        self.policy.start_episode()

    @contextmanager
    def _guided(self, jobs: Sequence[Job]) -> Iterator[dict[str, Any]]:
        """Real-time chunking switched on for these jobs, if they want it: arguments of `predict_action_chunk`."""
        guidance = jobs[0].guidance
        if guidance is None:
            yield {}
            return
        self._set_guidance(guidance)
        try:
            left_over = torch.stack([job.left_over for job in jobs if job.left_over is not None])  # (B, T, A)
            yield {
                "inference_delay": guidance.inference_delay,
                "prev_chunk_left_over": left_over.to(self.config.device),
            }
        finally:
            self._set_guidance(None)

    def _set_guidance(self, guidance: Guidance | None) -> None:
        self.config.rtc_config = None
        if guidance is not None:
            given, default = guidance, self._guidance
            self.config.rtc_config = replace(
                default,
                enabled=True,
                debug=False,
                execution_horizon=given.execution_horizon or default.execution_horizon,
                max_guidance_weight=given.max_guidance_weight or default.max_guidance_weight,
                prefix_attention_schedule=given.prefix_attention_schedule or default.prefix_attention_schedule,
            )
        self.policy.init_rtc_processor()


def collate(requests: Sequence[Request]) -> dict[str, Any]:
    """A raw observation batch, converted as LeRobot's robots and environments do: images (B, 3, H, W) float32 in [0, 1]."""
    batch: dict[str, Any] = {"task": [request.task for request in requests]}
    if requests[0].rig is not None:
        batch[RIG] = torch.tensor([[request.rig] for request in requests])  # (B, 1), as in data of several rigs
    for key in requests[0].observation:
        arrays = torch.from_numpy(np.stack([request.observation[key] for request in requests]))
        if key.startswith(CALIBRATION_PREFIX) or arrays.ndim < 3:
            batch[key] = arrays
        elif arrays.ndim == 3:  # depth (B, H, W); an image has colours, whatever its name
            batch[key] = arrays[:, None]
        else:
            images = arrays.float() / 255 if arrays.dtype == torch.uint8 else arrays
            batch[key] = images.permute(0, 3, 1, 2).contiguous()
    return batch


def _blank(inputs: Inputs, config: PI05GeometryConfig, rig: int | None) -> dict[str, np.ndarray]:
    """An observation with every key: grey images, a wall 1 m away, cameras at the origin."""
    observation = {}
    for key, entry in inputs.expected.items():
        if key.startswith(CALIBRATION_PREFIX):
            observation[key] = np.eye(4, dtype=np.float32)
        elif len(entry.shape) == 2:
            metre = one_metre(config, camera_of(key).removesuffix(DEPTH_SUFFIX), rig)
            observation[key] = np.full(entry.shape, metre, dtype=np.float32)
        elif len(entry.shape) == 3:
            size = inputs.trained_size[key]
            observation[key] = np.full((*size, 3), 127, dtype=np.uint8)
        else:
            observation[key] = np.zeros(entry.shape, dtype=np.float32)
    return observation
