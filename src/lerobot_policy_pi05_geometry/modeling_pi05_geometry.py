"""The policy. It takes LeRobot's batches and returns losses and actions.

```
   batch ──► prepare_images ─► prefix ─┐
         ──► tokens ─────────► prefix ─┤
         ──► GeometryEncoder ► geometry┼─► PI05Pytorch ─► loss, or an action chunk
         ──► action, or noise ► suffix ┘
```
"""

import logging
import math
from collections import deque
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from accelerate import init_empty_weights
from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from lerobot.configs import PreTrainedConfig
from lerobot.policies.common.vla_utils import pad_vector
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS
from safetensors.torch import save_file
from torch import Tensor, nn

from .compat import make_rtc_processor
from .configuration_checks import refuse_log_gate, require_trained_geometry, rtc_mode, warn_of_random_weights
from .configuration_pi05_geometry import EMPTY_CAMERA, PI05GeometryConfig
from .data.images import ImageRangeCheck, prepare_images
from .data.relative_actions import anchor_of, relative_to
from .data.rtc import HardPrefixLength, without_padding
from .data.small_tokenizer import SMALL_TOKENIZER, small_number_ids
from .data.statistics import check_stats, require_matching_kind
from .data.training_batch import check_actions, require_finite_losses, valid_steps
from .geometry import GeometryEncoder
from .geometry.da3 import Da3Encoder
from .geometry.da3.weights import load_da3
from .geometry.keys import AUGMENTATION_KEY, camera_of
from .geometry.resolve import resolve
from .inference.sampler import ChunkSampler
from .inference.side_stream import PendingGeometry
from .inference.warm_up import ChunkShapes, warm_up
from .model import PI05Pytorch
from .model.config import RunnerName
from .model.flow_matching import FlowDraw, draw_flow
from .model.segments import GeometryTokens
from .training.dropout import Cameras, check_camera_names, drop, went_without
from .training.geometry_log import GeometryLog
from .training.lora import always_in_full, peft_targets
from .training.micro_batches import in_micro_batches, rows_of
from .training.parameter_groups import new_parameters, parameter_groups
from .training.progress import TrainingProgress
from .training.sharding import UNIT_CLASSES, require_whole_parameters
from .weight_files.files import find_file, require_policy_type
from .weight_files.strict_load import load_strictly

logger = logging.getLogger(__name__)

_EVALUATION_STEP = -1  # The evaluation loss draws the same noise at every training step, so that values are comparable.


class PI05GeometryPolicy(PreTrainedPolicy):
    """π0.5 with a geometry segment, as a LeRobot policy."""

    config_class = PI05GeometryConfig
    name = "pi05_geometry"
    _fsdp_wrap_modules = UNIT_CLASSES  # read by LeRobot 0.6.2

    def __init__(
        self,
        config: PI05GeometryConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: Any | None = None,
        encoder: Da3Encoder | None = None,
        **_: Any,
    ) -> None:
        """dataset_stats, dataset_meta: as LeRobot's `make_policy` passes them; its other arguments are not needed.

        encoder: the Depth Anything 3 encoder that `load_da3` returned for this configuration, for a policy that computes
        geometry from RGB (da3, or features without a dataset). None: it is loaded here.
        Raises ValueError if the statistics do not fit the configuration (data/statistics.py).
        """
        super().__init__(config)
        refuse_log_gate(config)
        config.validate_features()
        if dataset_stats:
            check_stats(config, dataset_stats)
        if dataset_meta is not None:
            require_matching_kind(config, dataset_meta)
        self.config: PI05GeometryConfig = config
        self.model = PI05Pytorch(config.network())
        self.init_rtc_processor()
        self.sampler = ChunkSampler(self.model)
        source, changes = resolve(config, dataset_meta, encoder)
        config.record(changes)
        self.geometry = None if source is None else GeometryEncoder(source, self.model.geometry_width)
        check_camera_names(self._cameras(), config.dropout_rates)
        if config.tokenizer == SMALL_TOKENIZER and not self.model.action_in_proj.weight.is_meta:
            self.model.paligemma_with_expert.language_model.initialise_number_embeddings(small_number_ids())
        self._set_trainable()
        if config.gradient_checkpointing:
            self.model.gradient_checkpointing_enable()
        if config.compile_model:
            self.model.compile_training()
        self.progress = TrainingProgress()
        self._acted_on = 0  # rows of the last observation; 0 before the first
        self._present: tuple[bool, ...] = ()  # which cameras it had an image of
        self._hard_prefix_length = HardPrefixLength(config.rtc_training_max_delay)
        self._noise_seed = torch.initial_seed()
        tokens = 0 if self.geometry is None else self.geometry.source.num_tokens
        self.geometry_log = GeometryLog(self.model.paligemma_with_expert, tokens)
        self.image_range = ImageRangeCheck()
        if not self.model.action_in_proj.weight.is_meta:  # Meta tensors get their values in from_pretrained.
            warn_of_random_weights(config)
            self.to(config.device)
        self.reset()

    def _set_trainable(self) -> None:
        network = self.model.paligemma_with_expert
        network.set_trainable(self.config.train_expert_only, self.config.freeze_vision_encoder)
        # A policy without RGB does not run the vision tower, so DDP must not wait for its gradient.
        if all(key.startswith(EMPTY_CAMERA) for key in self.config.image_features):
            network.paligemma.model.vision_tower.requires_grad_(False)
            network.paligemma.model.multi_modal_projector.requires_grad_(False)

    @classmethod
    @torch.inference_mode(False)  # weights made in inference mode could not be joined for the runner, nor trained
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: PreTrainedConfig | None = None,
        force_download: bool = False,
        resume_download: bool | None = None,
        proxies: dict | None = None,
        token: str | bool | None = None,
        cache_dir: str | Path | None = None,
        local_files_only: bool = False,
        revision: str | None = None,
        strict: bool = True,
        **kwargs: Any,
    ) -> "PI05GeometryPolicy":
        """Load a policy from a folder or the hub, in evaluation mode.

        Every weight is loaded and every tensor of the file is used; otherwise this raises (weight_files/strict_load.py).
        strict: part of LeRobot's signature; loading is always strict.
        """
        hub = {
            "force_download": force_download,
            "token": token,
            "cache_dir": cache_dir,
            "local_files_only": local_files_only,
            "revision": revision,
        }
        require_policy_type(pretrained_name_or_path, cls.name, **hub)
        weights = find_file(pretrained_name_or_path, SAFETENSORS_SINGLE_FILE, **hub)
        saved = PreTrainedConfig.from_pretrained(pretrained_name_or_path, **hub)
        config = saved if config is None else config
        live = ("da3", "features") if kwargs.get("dataset_meta") is None else ("da3",)
        if isinstance(config, PI05GeometryConfig) and config.geometry_source in live:
            kwargs["encoder"] = load_da3(config)  # Before init_empty_weights, which would make its parameters empty.
        with init_empty_weights(include_buffers=False):
            policy = cls(config, **kwargs)
        load_strictly(policy, weights)
        if policy.training_step > 0 and isinstance(saved, PI05GeometryConfig):
            require_trained_geometry(config, saved)
        policy.to(config.device)
        policy.eval()
        return policy

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        """Write configuration and weights. LeRobot calls this.

        After acting, weights are parts of the runner's larger matrices, which LeRobot's own way of writing refuses.
        """
        if state_dict is not None:  # gathered from shards
            super()._save_pretrained(save_directory, state_dict)
            return
        self.config._save_pretrained(save_directory)
        tensors = {name: tensor.contiguous() for name, tensor in self.state_dict().items()}
        save_file(tensors, save_directory / SAFETENSORS_SINGLE_FILE, metadata={"format": "pt"})

    @property
    def training_step(self) -> Tensor:
        """Optimiser steps done, a scalar on the policy's device."""
        return self.progress.step

    def _get_default_peft_targets(self) -> dict[str, Any]:
        """What `--peft.*` trains. LeRobot calls this."""
        return peft_targets(self.config)

    def _validate_peft_config(self, peft_config: Any) -> None:
        """Add the new parameters to what a PEFT configuration trains in full. LeRobot calls this before it uses one."""
        super()._validate_peft_config(peft_config)
        given = list(peft_config.modules_to_save or [])
        peft_config.modules_to_save = given + [name for name in always_in_full(self.config) if name not in given]

    # --- training -------------------------------------------------------------------------------------------------

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, Any]]:
        """Flow-matching loss of a training batch.

        batch: `action` (B, S, A) normalised, what the preprocessor makes of an observation, and, where there are padded
        steps, `action_is_pad` (B, S). `padded_actions` of the configuration says whether those count.
        reduction: "mean" for a scalar, "none" for (B,), which LeRobot's sample weighting needs. A sample without a valid
        step has the loss 0.
        Returns the loss and a dict of numbers to log.
        Raises ValueError or FloatingPointError if an action or a loss is not finite (data/training_batch.py).
        """
        if reduction not in ("mean", "none"):
            raise ValueError(f"reduction must be 'mean' or 'none', got {reduction!r}.")
        if self.config.compile_model and self.training:
            require_whole_parameters(self, "compile_model")
        size, steps, action_dim = batch[ACTION].shape
        check_actions(batch[ACTION], batch, self.config.action_feature.shape[0])
        anchor_of(batch, self.config.use_relative_actions)  # raises if the processors disagree with the policy
        self.image_range(batch, self.config)
        draw = self._draw(batch, torch.Size((size, steps, self.config.max_action_dim)))
        valid = valid_steps(batch[ACTION], batch.get("action_is_pad"), self.config.padded_actions)  # (B, S)
        if self.config.rtc_training_max_delay:  # a hard prefix is no target; one valid step remains
            delay = torch.minimum(draw.delay.to(valid.device), (valid.sum(dim=1) - 1).clamp_min(0))  # (B,)
            draw = draw._replace(delay=delay)
            valid = valid & (torch.arange(steps, device=valid.device) >= delay[:, None])
        count = valid.sum().clamp_min(1)
        seen: list[Tensor] = []
        without: list[Tensor] = []

        def part(rows: slice) -> Tensor:
            """What some rows add to the mean of all, or their losses one by one."""
            flow = FlowDraw(*(drawn[rows] for drawn in draw))
            losses, taken = self._losses(rows_of(batch, size, rows), flow)
            losses = losses[..., :action_dim].masked_fill(~valid[rows][..., None], 0.0)
            seen.append(losses.detach())
            if taken is not None:
                without.append(taken)
            if reduction == "none":
                return losses.sum(dim=(1, 2)) / (valid[rows].sum(dim=1).clamp_min(1) * action_dim)
            return losses.sum() / (count * action_dim)

        rows_at_once = self.config.micro_batch_size or size
        with self.geometry_log.measuring(int(self.training_step)) if self.training else nullcontext():
            loss = in_micro_batches(part, size, rows_at_once, self, reduction)
        losses = torch.cat(seen)  # (B, S, action_dim)
        info: dict[str, Any] = {"loss": (losses.sum() / (count * action_dim)).item()}
        if not math.isfinite(info["loss"]):
            require_finite_losses(losses, batch)
        info["loss_per_dim"] = (losses.sum(dim=(0, 1)) / count).tolist()
        if without:
            of_samples = losses.sum(dim=(1, 2)) / (valid.sum(dim=1).clamp_min(1) * action_dim)
            self.geometry_log.went_without(of_samples, torch.cat(without))
        info.update(self.geometry_log.numbers())
        return loss, info

    def _losses(self, batch: dict[str, Any], draw: FlowDraw) -> tuple[Tensor, Tensor | None]:
        """Loss of every action entry (B, S, max_action_dim), the mean over flow samples.

        And (B, 2) bool: the samples from which modality dropout took geometry, and images; None without geometry.
        """
        device = self.training_step.device
        images, img_masks = prepare_images(batch, self.config, device)
        if self.training and self.config.depth_augmentation:
            batch = {**batch, AUGMENTATION_KEY: draw.key.to(device)}
        embs, pad = (None, None) if self.geometry is None else self._measure(batch)
        taken = None
        if self.training:
            left_masks, left_pad = drop(draw, self.config.dropout_rates, self._cameras(), img_masks, pad)
            if pad is not None and left_pad is not None:
                taken = went_without((img_masks, pad), (left_masks, left_pad))
            img_masks, pad = left_masks, left_pad
        losses: Tensor = self.model(
            images,
            img_masks,
            batch[OBS_LANGUAGE_TOKENS],
            batch[OBS_LANGUAGE_ATTENTION_MASK],
            pad_vector(batch[ACTION], self.config.max_action_dim).float(),
            draw.noise.to(device),
            draw.time.to(device),
            embs,
            pad,
            delay=draw.delay.to(device) if self.config.rtc_training_max_delay else None,
        )
        return losses.mean(dim=1) if losses.ndim == 4 else losses, taken

    def _cameras(self) -> Cameras:
        images = [camera_of(key) for key in self.config.image_features]
        if self.geometry is None:
            return Cameras(images, [], across_views=False)
        return Cameras(images, self.geometry.source.cameras, self.geometry.source.across_views)

    def _draw(self, batch: dict[str, Tensor], shape: torch.Size) -> FlowDraw:
        """Draw noise, flow time and dropout, keyed by (seed, step, dataset index), or by the row if there is no index."""
        index = batch.get("index")
        indices = list(range(shape[0])) if index is None else [int(i) for i in index.flatten().tolist()]
        return draw_flow(
            self._noise_seed,
            int(self.training_step) if self.training else _EVALUATION_STEP,
            indices,
            (shape[1], shape[2]),  # (S, D)
            alpha=self.config.time_sampling_beta_alpha,
            beta=self.config.time_sampling_beta_beta,
            scale=self.config.time_sampling_scale,
            offset=self.config.time_sampling_offset,
            samples=self.config.flow_samples,
            max_delay=self.config.rtc_training_max_delay,
        )

    def new_parameters(self) -> dict[str, nn.Parameter]:
        """The parameters that π0.5 does not have, by name: the adapter with its embeddings, and the gate."""
        return new_parameters(self)

    def get_optim_params(self) -> list[dict[str, Any]]:
        """Parameter groups of the optimiser. LeRobot calls this."""
        return parameter_groups(self, self.config)

    @torch.no_grad()
    def update(self) -> None:
        """Count an optimiser step, and measure how far the new parameters moved. LeRobot calls this after every step."""
        self.training_step.add_(1)
        self.geometry_log.moved([p for p in self.new_parameters().values() if p.requires_grad])

    # --- acting ---------------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Start an episode, prepared for: see `start_episode` and `warm_up`."""
        self.start_episode()
        if (self._acted_on or self.rtc_processor is not None) and not self.training:
            self.warm_up()

    def start_episode(self) -> None:
        """Drop the queued actions; the next images and poses are checked, and no camera has been seen."""
        self._action_queue: deque[Tensor] = deque()
        self.image_range.reset()
        if self.geometry is not None:
            self.geometry.reset()

    def warm_up(self, batch_size: int | None = None) -> None:
        """Prepare for episodes of so many robots (as many as acted last, at first one): no chunk then waits for a preparation.

        Where chunks are recorded (on a GPU), one is recorded for every length that a prompt can have. `reset` calls this from the
        second episode on, with real-time chunking from the first; call it after loading for a fast first one. It changes no
        action and draws no random number.
        """
        config = self.config
        shapes = ChunkShapes(
            batch=batch_size or self._acted_on or 1,
            present=self._present or tuple(not key.startswith(EMPTY_CAMERA) for key in config.image_features),
            side=config.image_resolution[0],
            geometry_tokens=0 if self.geometry is None else self.geometry.source.num_tokens,
            geometry_width=self.model.geometry_width,
            longest_prompt=config.tokenizer_max_length,
            steps=config.chunk_size,
            action_dim=config.max_action_dim,
            denoising_steps=config.num_inference_steps,
        )
        warm_up(self.sampler, cast(RunnerName, config.inference_runner), shapes, self.training_step.device)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """The next action (B, action_dim), normalised and absolute. An empty queue is filled with a new chunk's actions."""
        if self.rtc_processor is not None and self.rtc_processor.rtc_config.enabled:
            raise RuntimeError(
                "Real-time chunking works on whole chunks: call predict_action_chunk, not select_action."
            )
        self.eval()
        if not self._action_queue:
            chunk = self.predict_action_chunk(batch, **kwargs)[:, : self.config.n_action_steps]
            self._action_queue.extend(chunk.transpose(0, 1))
        return self._action_queue.popleft()

    # LeRobot's rollout wraps this in torch.compile on --use_torch_compile: minutes at the first chunk, for what the runner does
    # faster. Under `disable` the wrapped function is the function.
    @torch.compiler.disable
    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """An action chunk (B, chunk_size, action_dim), normalised.

        With `use_relative_actions` the network predicts differences to the state; here they become absolute actions, with
        the state of this observation (data/relative_actions.py).
        kwargs: `noise` (B, S, max_action_dim), `num_steps`, `runner` (instead of the configured `inference_runner`), and
        real-time chunking's `inference_delay`, `prev_chunk_left_over` (T, A), absolute, and `execution_horizon`.
        """
        self.eval()
        self.image_range(batch, self.config)
        self._acted_on = len(batch[OBS_LANGUAGE_TOKENS])
        if kwargs.get("prev_chunk_left_over") is not None:
            kwargs |= without_padding(kwargs["prev_chunk_left_over"], kwargs.get("inference_delay"))
            if (
                self.model.rtc_enabled
                and self.model.rtc_mode == "trained"
                and kwargs["prev_chunk_left_over"] is not None
            ):
                steps = kwargs["prev_chunk_left_over"].shape[-2]
                kwargs["inference_delay"] = self._hard_prefix_length(kwargs.get("inference_delay"), steps)
        anchor = anchor_of(batch, self.config.use_relative_actions)  # (B, A)
        if anchor is not None and kwargs.get("prev_chunk_left_over") is not None:
            kwargs["prev_chunk_left_over"] = relative_to(anchor, kwargs["prev_chunk_left_over"])
        images, img_masks = prepare_images(batch, self.config, self.training_step.device)
        self._present = tuple(image is not None for image in images)
        geometry = None
        if self.geometry is not None:  # On a GPU it is measured on a stream of its own, beside vision and prefix.
            geometry = PendingGeometry(self.geometry.source.num_tokens, partial(self._measure, batch))
        actions = self.sampler(
            images,
            img_masks,
            batch[OBS_LANGUAGE_TOKENS],
            batch[OBS_LANGUAGE_ATTENTION_MASK],
            geometry=geometry,
            **{"runner": self.config.inference_runner, "num_steps": self.config.num_inference_steps, **kwargs},
        )
        actions = actions[..., : self.config.action_feature.shape[0]]
        return actions if anchor is None else actions + anchor[:, None].to(actions)

    def _measure(self, batch: dict[str, Tensor]) -> GeometryTokens:
        assert self.geometry is not None
        tokens: GeometryTokens = self.geometry(batch)
        return tokens

    def supports_rtc(self) -> bool:
        return True

    def init_rtc_processor(self) -> None:
        """Set up real-time chunking. LeRobot calls this after it has set `config.rtc_config`."""
        rtc, mode = self.config.rtc_config, rtc_mode(self.config)
        trained = self.config.rtc_training_max_delay > 0
        self.rtc_processor = None if rtc is None else make_rtc_processor(rtc, trained)
        self.model.rtc_processor, self.model.rtc_mode = self.rtc_processor, mode
