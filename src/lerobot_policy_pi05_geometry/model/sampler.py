"""Which way a chunk is computed: by the runner, or by the plain path where the runner is not wanted or does not apply."""

import logging
from typing import Any, Literal

import torch
from torch import Tensor

from .pi05 import PI05Pytorch
from .runner import ChunkRunner, why_not

logger = logging.getLogger(__name__)

RunnerName = Literal["fast", "plain"]
_KNOWN_TO_RUNNER = {"noise", "num_steps", "geom_embs", "geom_pad"}


class ChunkSampler:
    """Samples action chunks from a network. The plain path is always there; a fallback to it is reported, once."""

    def __init__(self, network: PI05Pytorch) -> None:
        self._network = network
        self._runner: ChunkRunner | None = None
        self._declined: str | None = None

    def __call__(self, *observation: Any, runner: RunnerName = "fast", **kwargs: Any) -> Tensor:
        """An action chunk (B, S, D); observation and kwargs as in `PI05Pytorch.sample_actions`."""
        given = {name: value for name, value in kwargs.items() if value is not None}
        if runner == "plain":
            return self._network.sample_actions(*observation, **given)
        declined = self._why_not(set(given))
        if declined is not None:
            if declined != self._declined:
                logger.warning("The plain path computes the actions, since %s.", declined)
            self._declined = declined
            return self._network.sample_actions(*observation, **given)
        self._declined = None
        assert self._runner is not None
        return self._runner(*observation, **given)

    def _why_not(self, given: set[str]) -> str | None:
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
        try:
            if self._runner is None:
                self._runner = self._make_runner()
            self._runner.refresh()
        except TypeError as error:
            self._runner = None
            return str(error)
        return None

    def _make_runner(self) -> ChunkRunner:
        return ChunkRunner(self._network)

    def explain(self) -> dict[str, str]:
        """What is active and what was declined, and why, for a person to read."""
        reason = self._why_not(set())
        if reason is not None:
            return {"runner": f"declined: {reason}; the plain path serves"}
        network = self._network
        shared = all(
            layer.self_attn.q_proj.weight.dtype == network.config.dtype
            for layer in network.paligemma_with_expert.expert.layers
        )
        on_cpu = network.action_in_proj.weight.device.type == "cpu"
        written_out = on_cpu and network.config.dtype == torch.bfloat16
        return {
            "runner": "active",
            "matrices": "joined (q, k, v; gate, up), "
            + ("in the network's own storage" if shared else "copies in the compute dtype"),
            "flow time": "modulations of every denoising step computed once, until weights change",
            "attention": "written-out products (measured: faster on a CPU in bf16)" if written_out else "SDPA",
            "last VLM layer": "stops at keys and values",
            "cameras": "one vision batch, absent ones not encoded",
            "real-time chunking": "declined: the plain path serves it",
            "CUDA graphs": "not built yet",
            "compilation": "not built yet",
        }
