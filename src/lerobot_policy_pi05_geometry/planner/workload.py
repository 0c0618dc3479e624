"""Memory of a policy in training and at inference, counted without allocating it.

The policy is built without weights, its parameters become fake tensors on the CPU, and the real network runs on them, forward
and backward. The fake tensors are on the CPU and not on "cuda", so that every machine gives the same answer: PyTorch switches
autocast off where it finds no CUDA. Attention counts as PyTorch's fused CPU kernel, which like CUDA's fused kernels keeps its
output and one number per query. `as_cudas_autocast` has the difference of CUDA's autocast.
"""

from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import torch
from accelerate import init_empty_weights
from lerobot.utils.constants import OBS_STATE
from torch import Tensor
from torch._subclasses import FakeTensorMode

from ..configuration_pi05_geometry import PI05GeometryConfig
from ..geometry.da3 import Da3Backbone, Da3Encoder, Da3Source, Da3Variant
from ..geometry.da3.encoder import store_products_in
from ..geometry.keys import RAW_STATE, is_geometry_key
from ..geometry.with_rays import WithRays
from ..model.precision import DTYPES
from ..training.micro_batches import rows_of, sum_of
from .acting import CountedSampler, Target
from .adapters import add_lora
from .counting import CUDA_BLOCK, MemoryCounter, MemorySplit, storage_bytes
from .optimisers import rounded, step_bytes
from .planned import PlannedPolicy

CPU = torch.device("cpu")


@dataclass(frozen=True)
class Load:
    """The size of a training step or a prediction.

    batch_size: samples of a training step, or observations of a prediction. micro_batch_size: samples whose activations
    live at the same time, None or 0 for all. prompt_tokens: padded length of the prompts. optimizer: as in the policy's
    configuration. target: whose kernels, autocast and allocator are assumed.
    """

    batch_size: int = 1
    micro_batch_size: int | None = None
    prompt_tokens: int = 200
    optimizer: str = "adamw"
    target: Target = "cuda"

    @property
    def rows(self) -> int:
        """Samples of one micro-batch."""
        return min(self.micro_batch_size or self.batch_size, self.batch_size)


class _Step(NamedTuple):
    """Peak of a forward and backward pass, without the optimiser; bytes of all gradients, and of the batch."""

    largest: MemorySplit
    gradients: int
    batch: int


def as_cudas_autocast(norm: torch.nn.LayerNorm, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """The difference between CUDA's autocast and the CPU's for this network: layer norms compute and return float32.

    A hook before a layer norm. It also acts where checkpointing runs a layer again in the backward pass.
    """
    return tuple(x.float() for x in inputs) if torch.is_autocast_enabled("cpu") else inputs


class FakePolicy:
    """A policy of this configuration on fake tensors, ready to be counted.

    config: features included; its calibration must be complete, as for a real policy. lora_rank: rank of LoRA on the
    configuration's `lora_targets`, None for none. da3: the encoder's size, for geometry_source=da3 and features. A policy
    with features can be planned in training; plan its inference with geometry_source=da3, since it runs the encoder then.
    """

    def __init__(self, config: PI05GeometryConfig, lora_rank: int | None = None, da3: Da3Variant | None = None) -> None:
        config.device = "cpu"
        self._steps: dict[Load, _Step] = {}
        self.mode = FakeTensorMode(allow_non_fake_inputs=True)
        encoder = None
        if config.geometry_source in ("da3", "features"):
            if da3 is None:
                raise ValueError(f"geometry_source={config.geometry_source} needs the encoder's size to be planned.")
            with torch.device("meta"):
                backbone = Da3Backbone(da3)
            store_products_in(backbone, DTYPES[config.da3_dtype])
            encoder = Da3Encoder(backbone, DTYPES[config.da3_dtype])
            with self.mode:
                encoder.to_empty(device=CPU)
        with init_empty_weights(include_buffers=False):
            self.policy = PlannedPolicy(config, encoder=encoder)
        if lora_rank is not None:
            with torch.device("meta"):
                add_lora(self.policy, lora_rank)
        with self.mode:
            self.policy.to_empty(device=CPU)

    # --- known exactly ----------------------------------------------------------------------------------------------

    def weights(self, block: int = 1) -> int:
        """Bytes of parameters and buffers."""
        return storage_bytes([*self.policy.parameters(), *self.policy.buffers()], block)

    def trainable(self) -> list[torch.nn.Parameter]:
        return [parameter for parameter in self.policy.parameters() if parameter.requires_grad]

    def resident(self, load: Load) -> MemorySplit:
        """The memory of every optimiser step, whatever the batch: weights, gradients and optimiser."""
        block = _block(load.target)
        state, _ = self._optimiser(load)
        encoder = self._encoder()
        return MemorySplit(
            weights=self.weights(block),
            gradients=sum(rounded(parameter.nbytes, block) for parameter in self.trainable()),
            optimiser=state,
            da3=0 if encoder is None else storage_bytes([*encoder.parameters(), *encoder.buffers()], block),
        )

    def _optimiser(self, load: Load) -> tuple[int, int]:
        """Bytes of the optimiser's state, and of the workspace of its step."""
        self.policy.config.optimizer = load.optimizer  # which decides the parameter groups
        groups = self.policy.get_optim_params()
        return step_bytes(load.optimizer, groups, _block(load.target), foreach=load.target == "cuda")

    def _encoder(self) -> Da3Encoder | None:
        source = None if self.policy.geometry is None else self.policy.geometry.source
        source = source.source if isinstance(source, WithRays) else source
        return source.encoder if isinstance(source, Da3Source) else None

    # --- found by running -------------------------------------------------------------------------------------------

    def training(self, load: Load) -> MemorySplit:
        """The peak of a training step after the first, when the optimiser's state exists."""
        state, workspace = self._optimiser(load)
        step = self._step(replace(load, optimizer="adamw"))
        new = [p for p in self.policy.new_parameters().values() if p.requires_grad]
        # `update` keeps a copy of them, to measure their updates.
        before = sum(rounded(p.nbytes, _block(load.target)) for p in new)
        running = replace(step.largest, optimiser=state, activations=step.largest.activations + before)
        at_update = before + workspace + step.batch
        updating = replace(step.largest, gradients=step.gradients, optimiser=state, activations=at_update)
        return max(running, updating, key=lambda split: split.total)

    def _step(self, load: Load) -> _Step:
        """Peak of the forward and backward pass, which do not depend on the optimiser; computed once per load."""
        load = replace(load, micro_batch_size=load.rows)
        if load in self._steps:
            return self._steps[load]
        policy, block, trainable = self.policy.train(), _block(load.target), self.trainable()
        with ExitStack() as stack:
            counter = self._counter(stack, load.target)
            hooks = [
                parameter.register_post_accumulate_grad_hook(lambda p: counter.label([p.grad], "gradients"))
                for parameter in trainable
            ]
            batch = self._batch(load.batch_size, load.prompt_tokens)
            if load.rows == load.batch_size:
                loss = policy.loss(batch, load.batch_size)
            else:  # the second micro-batch stands for all later ones: all gradients exist when it begins
                parts = [slice(0, load.rows), slice(load.rows, 2 * load.rows)]
                given = [rows_of(batch, load.batch_size, part) for part in parts]
                loss = sum_of([partial(policy.loss, part, load.batch_size) for part in given], trainable)
            loss.backward()
            gradients = [p.grad for p in trainable if p.grad is not None]
            step = _Step(counter.peak, storage_bytes(gradients, block), storage_bytes(batch.values(), block))
            for hook in hooks:
                hook.remove()
            for parameter in trainable:
                parameter.grad = None
        if (
            load.rows < load.batch_size
        ):  # the sums of gradients are labelled at the end, when the backward pass returns them
            missing = step.gradients - step.largest.gradients
            named = {"gradients": step.gradients, "activations": step.largest.activations - missing}
            step = step._replace(largest=replace(step.largest, **named))
        self._steps[load] = step
        return step

    def inference(self, load: Load) -> MemorySplit:
        """The peak of predicting one action chunk. Two denoising steps stand for all."""
        policy = self.policy.eval()
        with ExitStack() as stack:
            counter = self._counter(stack, load.target)
            policy.sampler = CountedSampler(policy.model, counter, load.target)
            batch = self._batch(load.batch_size, load.prompt_tokens)
            del batch["action"]
            policy.predict_action_chunk(batch, num_steps=2)
        return counter.peak

    def _counter(self, stack: ExitStack, target: Target) -> MemoryCounter:
        """A counter of fake tensors that is active until the stack is closed and has counted the weights."""
        stack.enter_context(self.mode)
        if target == "cuda":
            for norm in (m for m in self.policy.modules() if isinstance(m, torch.nn.LayerNorm)):
                stack.callback(norm.register_forward_pre_hook(as_cudas_autocast).remove)
        counter = MemoryCounter(_block(target))
        counter.label([*self.policy.parameters(), *self.policy.buffers()], "weights")
        encoder = self._encoder()
        if encoder is not None:
            counter.label([*encoder.parameters(), *encoder.buffers()], "da3")
        return stack.enter_context(counter)

    def _batch(self, size: int, prompt_tokens: int) -> dict[str, Tensor]:
        """A batch as the preprocessor gives it to the policy: float images and depth in the sizes of the data."""
        config = self.policy.config
        observed = {key: feature.shape for key, feature in config.image_features.items()}
        observed |= {key: feature.shape for key, feature in config.geometry_features.items()}
        observed |= {key: feature.shape for key, feature in config.input_features.items() if not is_geometry_key(key)}
        batch = {key: torch.zeros(size, *shape) for key, shape in observed.items()}
        if OBS_STATE in batch:  # forward kinematics of a camera on the arm reads it
            batch[RAW_STATE] = batch[OBS_STATE]
        batch["observation.language.tokens"] = torch.zeros(size, prompt_tokens, dtype=torch.int64)
        batch["observation.language.attention_mask"] = torch.ones(size, prompt_tokens, dtype=torch.bool)
        batch["action"] = torch.zeros(size, config.chunk_size, config.action_feature.shape[0])
        return batch


def _block(target: Target) -> int:
    return CUDA_BLOCK if target == "cuda" else 1
