"""How a chunk is computed: by the runner, or by the plain path where the runner is not wanted or not able."""

import inspect
import logging
import threading
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from ..model.config import RunnerName
from ..model.pi05 import PI05Pytorch
from .backend import Backend
from .cuda_graphs import PROMPT_STEP, GraphRunner
from .fused_weights import UnsupportedLayerError
from .runner import ChunkRunner
from .side_stream import PendingGeometry

logger = logging.getLogger(__name__)

RUNNER_ARGUMENTS = frozenset(inspect.signature(ChunkRunner.__call__).parameters) - {"self"}
# Arguments of the plain path that the runner does not take, and why.
PLAIN_ONLY = {
    "use_cache": "use_cache=False is the slow reference",
    "geom_att": "geom_att makes blocks inside the geometry segment, which no policy does",
}


class ChunkSampler(nn.Module):
    """Samples action chunks from a network. Reports once when it falls back to the plain path.

    The runner holds copies of weights, modulations and recorded graphs. It is built at the first chunk in evaluation mode, and
    dropped with all that it holds

    - when training begins, when weights are loaded, and when the network moves or changes its dtype. The sampler is a module
      without parameters, so that PyTorch tells it: a policy owns it beside the network.
    - when a chunk is asked for after a module or parameter was replaced, or after a write that PyTorch counted.
    - by `refresh()`. Call it after a write that PyTorch does not count: through `parameter.data`, or by a fused optimiser while
      the network stayed in evaluation mode.

    Chunks are computed one at a time, also if several threads ask: a recorded chunk has one set of buffers, and LeRobot resets a
    policy while its thread for real-time chunking predicts.

    network: not a submodule of the sampler. backend: makes what the runner has to know of a device.
    """

    def __init__(self, network: PI05Pytorch, backend: Callable[[torch.device], Backend] = Backend) -> None:
        super().__init__()
        self._networks = (network,)  # in a tuple, so that its parameters are not the sampler's
        self._make_backend = backend
        self._runners: dict[type[ChunkRunner], ChunkRunner] = {}
        self._reported: str | None = None
        self._reserved = 0  # shapes of inputs
        self._one_at_a_time = threading.RLock()

    def __reduce__(self) -> tuple:
        """A copy builds its own runner: recorded graphs cannot be copied."""
        return ChunkSampler, (self._network, self._make_backend)

    @property
    def _network(self) -> PI05Pytorch:
        return self._networks[0]

    @property
    def _device(self) -> torch.device:
        return self._network.action_in_proj.weight.device

    # --- when a runner is dropped ---------------------------------------------------------------------------------------

    def refresh(self) -> None:
        """Drop the runner; the next chunk builds a new one from the weights as they are then."""
        self._runners.clear()

    def train(self, mode: bool = True) -> "ChunkSampler":
        if mode:
            self.refresh()
        return super().train(mode)

    def _apply(self, *args: Any, **kwargs: Any) -> "ChunkSampler":  # PyTorch moves and casts modules by it
        self.refresh()
        return super()._apply(*args, **kwargs)

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        self.refresh()
        super()._load_from_state_dict(*args, **kwargs)

    # --- a chunk --------------------------------------------------------------------------------------------------------

    def forward(self, *observation: Any, runner: RunnerName = "fast", **kwargs: Any) -> Tensor:
        """An action chunk (B, S, D); arguments as in `ChunkRunner.__call__` or `PI05Pytorch.sample_actions`."""
        with self._one_at_a_time:
            return self._chunk(*observation, runner=runner, **kwargs)

    def _chunk(self, *observation: Any, runner: RunnerName, **kwargs: Any) -> Tensor:
        given = {name: value for name, value in kwargs.items() if value is not None}
        if runner == "plain":
            return self._plain(*observation, **given)
        reason = self._unsupported_reason(runner, set(given))
        if reason is not None:
            if reason != self._reported:
                logger.warning("The plain path computes the actions, since %s.", reason)
            self._reported = reason
            return self._plain(*observation, **given)
        self._reported = None
        return self._runners[self._kind(runner)](*observation, **given)

    def _plain(self, *observation: Any, geometry: PendingGeometry | None = None, **given: Any) -> Tensor:
        if geometry is not None:
            given["geom_embs"], given["geom_pad"] = geometry.measure()
        return self._network.sample_actions(*observation, **given)

    def _kind(self, runner: RunnerName) -> type[ChunkRunner]:
        return GraphRunner if runner == "fast" and self._make_backend(self._device).can_record else ChunkRunner

    def records(self, runner: RunnerName = "fast") -> bool:
        """Whether the runner that is asked for records chunks by the shape of their inputs."""
        return runner != "plain" and self._kind(runner) is GraphRunner

    def prepare(self, runner: RunnerName = "fast", num_steps: int | None = None) -> str | None:
        """Build the runner and its modulations, if they are not there. Returns why the plain path serves instead, or None.

        num_steps: denoising steps of a chunk, the network's if None.
        """
        with self._one_at_a_time:
            reason = "inference_runner=plain" if runner == "plain" else self._unsupported_reason(runner, set())
            if reason is None:
                self._runners[self._kind(runner)].compute_flow_times(
                    num_steps or self._network.config.num_inference_steps
                )
        return reason

    def reserve(self, shapes: int) -> None:
        """Keep recorded chunks of so many shapes of inputs or more, where they are recorded."""
        self._reserved = max(self._reserved, shapes)
        for built in self._runners.values():
            if isinstance(built, GraphRunner):
                built.reserve(shapes)

    def has_recorded(self, *observation: Any, **inputs: Any) -> bool:
        """Whether a chunk with inputs of these shapes is recorded; arguments as in `GraphRunner.has_recorded`."""
        built = self._runners.get(GraphRunner)
        return isinstance(built, GraphRunner) and built.has_recorded(*observation, **inputs)

    def _unsupported_reason(self, runner: RunnerName, given: set[str]) -> str | None:
        """Why the runner cannot compute this chunk, as the rest of a sentence; if it can, None, and the runner is there."""
        rtc = self._network.rtc_processor
        if self._network.rtc_enabled and rtc.is_debug_enabled():
            return "rtc_config.debug records every denoising step"
        if self._network.training:
            return "the network is in training mode"
        for name in sorted(given - RUNNER_ARGUMENTS):
            return PLAIN_ONLY.get(name, f"the runner does not know the argument {name}")
        kind = self._kind(runner)
        if not all(built.is_current() for built in self._runners.values()):
            self.refresh()
        if kind not in self._runners:
            try:
                self._runners[kind] = kind(self._network, self._make_backend(self._device))
            except UnsupportedLayerError as error:
                return str(error)
            self.reserve(self._reserved)
        return None

    # --- for a person ---------------------------------------------------------------------------------------------------

    def tensors(self) -> list[Tensor]:
        """The tensors that outlive a chunk; some of them are the network's own storage (fused_weights.py)."""
        return [tensor for runner in self._runners.values() for tensor in runner.tensors()]

    def explain(self, runner: RunnerName = "fast") -> dict[str, str]:
        """What is active and what was declined, and why, for a person to read. runner: the one that is asked for."""
        if runner == "plain":
            return {"runner": "declined: inference_runner=plain; the plain path serves"}
        reason = self._unsupported_reason(runner, set())
        if reason is not None:
            return {"runner": f"declined: {reason}; the plain path serves"}
        network, active = self._network, self._runners[self._kind(runner)]
        shared = all(
            layer.self_attn.q_proj.weight.dtype == network.config.dtype
            for layer in network.paligemma_with_expert.expert.layers
        )
        return {
            "runner": "active",
            "matrices": "joined (q, k, v; gate, up), "
            + ("in the network's own storage" if shared else "copies in the compute dtype until weights change"),
            "flow time": "modulations of all denoising steps computed once, until weights change",
            "attention": "written-out products (measured: faster on a CPU in bf16)"
            if active.backend.attention_in_products(network.config.dtype)
            else "SDPA",
            "last VLM layer": "stops at keys and values",
            "cameras": "one vision batch, absent ones not encoded",
            "geometry": self._explain_geometry(),
            "real-time chunking": f"active: {network.rtc_mode}" if network.rtc_enabled else "off",
            **self._explain_graphs(active),
            "compilation": "left out: on a CPU it costs more than it gains (docs/results-speed.md); not measured on a GPU",
        }

    def _explain_geometry(self) -> str:
        if self._network.config.geometry is None:
            return "none"
        if self._network.geometry_in_prefix:
            return "measured before the prefix, which it is part of"
        if self._device.type == "cuda":
            return "measured on a side stream, beside vision and prefix"
        return f"measured after the prefix: a {self._device.type} has no streams"

    def _explain_graphs(self, active: ChunkRunner) -> dict[str, str]:
        if isinstance(active, GraphRunner):
            state = f"active: {len(active.recorded)} of at most {active.capacity} shapes of inputs recorded"
            return {"CUDA graphs": state, "prompt": f"padded to a multiple of {PROMPT_STEP} tokens, one graph each"}
        why = "inference_runner=eager" if active.backend.can_record else f"a {self._device.type} has none"
        return {"CUDA graphs": f"declined: {why}", "prompt": "as long as the longest of the batch"}
