"""Which way a chunk is computed: by the runner, or by the plain path where the runner is not wanted or does not apply."""

import logging
from typing import Any

import torch
from torch import Tensor

from ..model.config import RunnerName
from ..model.pi05 import PI05Pytorch
from .cuda_graphs import PROMPT_STEP, GraphRunner
from .fused_weights import NotPlainError
from .layers import write_attention_out
from .runner import ChunkRunner, why_not
from .side_stream import PendingGeometry

logger = logging.getLogger(__name__)

_KNOWN_TO_RUNNER = {"noise", "num_steps", "geom_embs", "geom_pad", "geometry"}


class ChunkSampler:
    """Samples action chunks from a network. The plain path is always there; a fallback to it is reported, once."""

    def __init__(self, network: PI05Pytorch) -> None:
        self._network = network
        self._runners: dict[type[ChunkRunner], ChunkRunner] = {}
        self._declined: str | None = None

    def __reduce__(self) -> tuple:
        """A copy builds its own runner: recorded graphs have no copies."""
        return ChunkSampler, (self._network,)

    def __call__(self, *observation: Any, runner: RunnerName = "fast", **kwargs: Any) -> Tensor:
        """An action chunk (B, S, D); observation and kwargs as in `ChunkRunner.sample` or `PI05Pytorch.sample_actions`."""
        given = {name: value for name, value in kwargs.items() if value is not None}
        if runner == "plain":
            return self._plainly(*observation, **given)
        declined = self._why_not(runner, set(given))
        if declined is not None:
            if declined != self._declined:
                logger.warning("The plain path computes the actions, since %s.", declined)
            self._declined = declined
            return self._plainly(*observation, **given)
        self._declined = None
        return self._runners[self._class(runner)].sample(*observation, **given)

    def _plainly(self, *observation: Any, geometry: PendingGeometry | None = None, **given: Any) -> Tensor:
        if geometry is not None:
            given["geom_embs"], given["geom_pad"] = geometry.measure()
        return self._network.sample_actions(*observation, **given)

    @property
    def _device(self) -> torch.device:
        return self._network.action_in_proj.weight.device

    def _class(self, runner: RunnerName) -> type[ChunkRunner]:
        return GraphRunner if runner == "fast" and self._device.type == "cuda" else ChunkRunner

    def _why_not(self, runner: RunnerName, given: set[str]) -> str | None:
        """Why the runner cannot serve this call; builds it if it can."""
        network = self._network
        if network.rtc_processor is not None and network.rtc_processor.rtc_config.enabled:
            return "real-time chunking guides every step"
        unknown = given - _KNOWN_TO_RUNNER
        if unknown:
            return f"the runner does not know {', '.join(sorted(unknown))}"
        reason = why_not(network)
        if reason is not None:
            return reason
        wanted = self._class(runner)
        # One that was built where the network is no longer would keep that device's memory.
        self._runners = {kind: built for kind, built in self._runners.items() if built.device == self._device}
        try:
            if wanted not in self._runners:
                self._runners[wanted] = self._make_runner(wanted)
            self._runners[wanted].refresh()
        except NotPlainError as error:
            self._runners.clear()
            return str(error)
        return None

    def _make_runner(self, kind: type[ChunkRunner]) -> ChunkRunner:
        return kind(self._network)

    def tensors(self) -> list[Tensor]:
        """All that is kept between chunks; some of it is the network's own storage (fused_weights.py)."""
        return [tensor for runner in self._runners.values() for tensor in runner.tensors()]

    def explain(self, runner: RunnerName = "fast") -> dict[str, str]:
        """What is active and what was declined, and why, for a person to read. runner: the one that is asked for."""
        if runner == "plain":
            return {"runner": "declined: inference_runner=plain; the plain path serves"}
        reason = self._why_not(runner, set())
        if reason is not None:
            return {"runner": f"declined: {reason}; the plain path serves"}
        network = self._network
        shared = all(
            layer.self_attn.q_proj.weight.dtype == network.config.dtype
            for layer in network.paligemma_with_expert.expert.layers
        )
        written_out = write_attention_out(self._device.type, network.config.dtype)
        return {
            "runner": "active",
            "matrices": "joined (q, k, v; gate, up), "
            + (
                "in the network's own storage" if shared else "copies in the compute dtype, compared before every chunk"
            ),
            "flow time": "modulations of all denoising steps computed at once, "
            + ("until weights change" if self._device.type == "cpu" else "in every chunk"),
            "attention": "written-out products (measured: faster on a CPU in bf16)" if written_out else "SDPA",
            "last VLM layer": "stops at keys and values",
            "cameras": "one vision batch, absent ones not encoded",
            "geometry": self._explain_geometry(),
            "real-time chunking": "declined: the plain path serves it",
            **self._explain_graphs(runner),
            "compilation": "left out: on a CPU it gains less than it costs (docs/results.md); on a GPU it has not been measured",
        }

    def _explain_geometry(self) -> str:
        if self._network.config.geometry is None:
            return "none"
        if self._network.geometry_in_prefix:
            return "measured before the prefix, which it is part of"
        if self._device.type == "cuda":
            return "measured on a side stream, beside vision and prefix"
        return f"measured after the prefix: a {self._device.type} has no streams"

    def _explain_graphs(self, runner: RunnerName) -> dict[str, str]:
        active = self._runners[self._class(runner)]
        if isinstance(active, GraphRunner):
            state = f"active: {len(active.recorded)} of at most {active.capacity} shapes of inputs recorded"
            return {"CUDA graphs": state, "prompt": f"padded to a multiple of {PROMPT_STEP} tokens, one graph each"}
        why = "inference_runner=eager" if self._device.type == "cuda" else f"a {self._device.type} has none"
        return {"CUDA graphs": f"declined: {why}", "prompt": "as long as the longest of the batch"}
