"""The policy on the robot's side: observations to the server, action chunks back.

```
   batch of B rows ──► one request per row ──► B sessions of the server ──► chunks (B, S, A), ready for the robot
```

Every row of a batch is a robot with a session of its own, which the server computes together.
"""

from collections import deque
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION
from torch import Tensor

from ...geometry.keys import RIG, is_geometry_key
from ..extras import require_extra

require_extra("serve", "websockets", "msgpack")

from ..client import PolicyClient  # noqa: E402
from ..keys import read_key  # noqa: E402
from ..limits import PROTOCOL  # noqa: E402
from .configuration_pi05_geometry_remote import NO_TRAINING, PI05GeometryRemoteConfig  # noqa: E402
from .robot_session import RobotSession, chunks_of, require_same_policy  # noqa: E402
from .rows import requests_of  # noqa: E402


class PI05GeometryRemotePolicy(PreTrainedPolicy):
    """Asks a `pi05-geometry serve`. Its actions are the server's, already in the robot's units."""

    config_class = PI05GeometryRemoteConfig
    name = "pi05_geometry_remote"

    def __init__(self, config: PI05GeometryRemoteConfig, **_: Any) -> None:
        """Connects, and completes the configuration. Raises ServerLostError if it is not there, ValueError if none is named."""
        super().__init__(config)
        self.config: PI05GeometryRemoteConfig = config
        if not config.server:
            raise ValueError("The remote policy needs a server: give --policy.server=ws://<host>:8000.")
        self._key = read_key(None if config.key_file is None else Path(config.key_file))
        self._metadata: dict[str, Any] = {}
        self._sessions = [RobotSession(self._connect, config.reconnect)]
        self._metadata = self._sessions[0].client.metadata
        self._complete()
        self.reset()

    @classmethod
    def from_pretrained(
        cls, pretrained_name_or_path: str | Path | None, *, config: PreTrainedConfig | None = None, **_: Any
    ) -> "PI05GeometryRemotePolicy":
        """There are no weights here: the configuration is all that is read."""
        if config is None:
            config = PreTrainedConfig.from_pretrained(pretrained_name_or_path)
        assert isinstance(config, PI05GeometryRemoteConfig)
        return cls(config).eval()

    def _connect(self) -> PolicyClient:
        """A new session. Raises ServerLostError, and ValueError if the server has another policy than the first one had."""
        client = PolicyClient(self.config.server, self._key, self.config.timeout)
        if self._metadata:
            try:
                require_same_policy(self._metadata, client.metadata)
            except ValueError:
                client.close()
                raise
        return client

    def _complete(self) -> None:
        """Features and sizes as the server's checkpoint has them."""
        told, config = self._metadata, self.config
        if told.get("protocol") != PROTOCOL:
            raise ValueError(
                f"{config.server} is a server of openpi's protocol, but not `pi05-geometry serve`: it does not say what its "
                "policy expects."
            )
        given = config.action_feature
        if given is not None and given.shape[0] != told["action_dim"]:
            raise ValueError(
                f"The server's policy gives {told['action_dim']} action dimensions, but {given.shape[0]} are expected here; "
                "serve a checkpoint of this robot."
            )
        config.chunk_size, config.action_feature_names = told["chunk_size"], told["action_names"]
        self._action_steps = config.n_action_steps or told["n_action_steps"]
        if self._action_steps > config.chunk_size:
            raise ValueError(
                f"n_action_steps ({self._action_steps}) must not exceed the server's chunk_size ({config.chunk_size})."
            )
        self._rigs = told.get("rigs") or []
        if config.rig is not None and config.rig not in self._rigs:
            have = f"the rigs {', '.join(map(str, self._rigs))}" if self._rigs else "no rigs"
            raise ValueError(f"The server's policy has {have}, but --policy.rig is {config.rig}.")
        config.output_features = {ACTION: PolicyFeature(FeatureType.ACTION, (told["action_dim"],))}
        # As a local policy does, geometry stays out of the features that LeRobot compares with the robot's cameras.
        config.input_features = {
            key: PolicyFeature(FeatureType.VISUAL, (3, *entry["trained_size"]))
            if entry["trained_size"]
            else PolicyFeature(FeatureType.STATE, tuple(entry["shape"]))
            for key, entry in told["inputs"].items()
            if not is_geometry_key(key)
        }

    def reset(self) -> None:
        """Start of an episode: forget the queued actions, and tell the server with the next request."""
        self._action_queue: deque[Tensor] = deque(maxlen=self._action_steps)
        for session in self._sessions:
            session.reset()

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """One action (B, action_dim) per call; the server is asked when the queue is empty."""
        if self.config.rtc_config is not None and self.config.rtc_config.enabled:
            raise RuntimeError(
                "Real-time chunking works on whole chunks: call predict_action_chunk, not select_action."
            )
        if not self._action_queue:
            chunk = self.predict_action_chunk(batch, **kwargs)[:, : self._action_steps]
            self._action_queue.extend(chunk.transpose(0, 1))
        return self._action_queue.popleft()

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """An action chunk (B, chunk_size, action_dim) float32, in the robot's units.

        kwargs: `noise` (B, S, max_action_dim), and real-time chunking's `inference_delay`, `prev_chunk_left_over` (T, A) or
        (B, T, A) and `execution_horizon`. Raises ServerLostError, RefusedError with the server's sentence,
        and ValueError if a server that was lost came back with another policy.
        """
        requests = requests_of(batch, self._metadata["inputs"])
        while len(self._sessions) < len(requests):
            self._sessions.append(RobotSession(self._connect, self.config.reconnect))
        sessions = self._sessions[: len(requests)]
        noise = kwargs.get("noise")
        if noise is None and self.config.noise == "client":
            noise = torch.randn(len(requests), *self._metadata["noise"]["shape"])
        for row, (session, request) in enumerate(zip(sessions, requests, strict=True)):
            if noise is not None:
                request["noise"] = noise[row].float().cpu().numpy()
            request.update(self._guidance(session, row, **kwargs))
            request.update(self._rig(batch, row))
        return torch.stack(chunks_of(sessions, requests)).to(self.config.device)

    def _rig(self, batch: dict[str, Any], row: int) -> dict[str, int]:
        """Which rig a row's robot is, as the configuration or else the batch says; nothing if the server need not know."""
        if not self._rigs or (self.config.rig is None and RIG not in batch):
            return {}
        return {"rig": int(batch[RIG].flatten()[row]) if self.config.rig is None else self.config.rig}

    def _guidance(
        self,
        session: RobotSession,
        row: int,
        inference_delay: int | None = None,
        prev_chunk_left_over: Tensor | None = None,
        execution_horizon: int | None = None,
        **_: Any,
    ) -> dict[str, Any]:
        """Real-time chunking's part of a request; nothing if there is no chunk to continue."""
        rtc = self.config.rtc_config
        if rtc is None or not rtc.enabled or prev_chunk_left_over is None:
            return {}
        left_over = prev_chunk_left_over if prev_chunk_left_over.ndim == 2 else prev_chunk_left_over[row]
        executed = session.executed(left_over.float().cpu())
        if executed is None:
            return {}
        return {
            "inference_delay": min(inference_delay or 0, self.config.chunk_size),
            "executed_steps": executed,
            "execution_horizon": min(execution_horizon or rtc.execution_horizon, self.config.chunk_size),
            "max_guidance_weight": float(rtc.max_guidance_weight),
            "prefix_attention_schedule": rtc.prefix_attention_schedule.value.lower(),
        }

    def supports_rtc(self) -> bool:
        return True

    def init_rtc_processor(self) -> None:
        """LeRobot calls this after setting `config.rtc_config`; the server guides."""

    def forward(self, batch: dict[str, Tensor]) -> Any:
        raise NotImplementedError(NO_TRAINING)

    def get_optim_params(self) -> Any:
        raise NotImplementedError(NO_TRAINING)
