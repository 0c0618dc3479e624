"""A policy that takes no memory, and what it does in training and at inference, counted.

The policy is built without weights, its parameters become fake tensors on the CPU, and the real network runs on them, forward
and backward. Fakes on the CPU rather than on "cuda", so that every machine gives the same answer: PyTorch switches
autocast off for a CUDA it does not find. Attention then counts as PyTorch's fused CPU kernel, which like CUDA's fused kernels
keeps its output and one number per query. What CUDA's autocast does otherwise is in `CudaAutocast`.
"""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import torch
from accelerate import init_empty_weights
from lerobot.policies.common.vla_utils import pad_vector
from torch import Tensor
from torch._subclasses import FakeTensorMode
from torch.overrides import TorchFunctionMode

from ..configuration_pi05_geometry import PI05GeometryConfig
from ..geometry.da3 import Da3Backbone, Da3Encoder, Da3Source, Da3Variant
from ..geometry.da3.encoder import store_products_in
from ..geometry.keys import is_geometry_key
from ..inputs import prepare_images
from ..model.precision import DTYPES, compute_in_float32
from ..modeling_pi05_geometry import PI05GeometryPolicy
from .counting import CUDA_BLOCK, MemoryCounter, MemorySplit, storage_bytes
from .lora import LoraPlan, add_lora
from .optimisers import step_bytes

CPU = torch.device("cpu")
Target = Literal["cuda", "cpu"]


@dataclass(frozen=True)
class Load:
    """What is asked of the policy at once.

    batch_size: samples of a training step, or observations of a prediction. micro_batch_size: samples whose activations
    live at the same time, None for all. prompt_tokens: padded length of the prompts. optimizer: its name in `optimisers.py`.
    lora: low-rank adapters, None for none. target: whose kernels, autocast and allocator are assumed.
    """

    batch_size: int = 1
    micro_batch_size: int | None = None
    prompt_tokens: int = 200
    optimizer: str = "adamw"
    lora: LoraPlan | None = None
    target: Target = "cuda"

    @property
    def rows(self) -> int:
        """Samples of one micro-batch."""
        return min(self.micro_batch_size or self.batch_size, self.batch_size)


class _Step(NamedTuple):
    """Largest moment of a forward and backward pass, without the optimiser; bytes of all gradients, and of the batch."""

    largest: MemorySplit
    gradients: int
    batch: int


class CudaAutocast(TorchFunctionMode):
    """Where CUDA's autocast differs from the CPU's for an operation of this network: layer norms return float32."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is torch.nn.functional.layer_norm and torch.is_autocast_enabled("cpu"):
            args = [a.float() if isinstance(a, Tensor) else a for a in args]
            kwargs = {k: a.float() if isinstance(a, Tensor) else a for k, a in (kwargs or {}).items()}
        return func(*args, **(kwargs or {}))


class FakePolicy:
    """A policy of this configuration on fake tensors, ready to be counted.

    config: features included; its calibration must be complete, as for a real policy. da3: the encoder's size, for
    geometry_source=da3.
    """

    def __init__(self, config: PI05GeometryConfig, lora: LoraPlan | None = None, da3: Da3Variant | None = None) -> None:
        config.device = "cpu"
        self._steps: dict[Load, _Step] = {}
        self.mode = FakeTensorMode(allow_non_fake_inputs=True)
        encoder = None
        if config.geometry_source == "da3":
            if da3 is None:
                raise ValueError("geometry_source=da3 needs the encoder's size to be planned.")
            with torch.device("meta"):
                backbone = Da3Backbone(da3)
            store_products_in(backbone, DTYPES[config.da3_dtype])
            encoder = Da3Encoder(backbone, DTYPES[config.da3_dtype])
            with self.mode:
                encoder.to_empty(device=CPU)
        with init_empty_weights(include_buffers=False):
            self.policy = PI05GeometryPolicy(config, encoder=encoder)
        with self.mode:
            self.policy.to_empty(device=CPU)
            if lora is not None:
                add_lora(self.policy, lora)

    # --- what is exactly known ------------------------------------------------------------------------------------

    def weights(self, block: int = 1) -> int:
        """Bytes of parameters and buffers."""
        return storage_bytes([*self.policy.parameters(), *self.policy.buffers()], block)

    def trainable(self) -> list[torch.nn.Parameter]:
        return [parameter for parameter in self.policy.parameters() if parameter.requires_grad]

    def resident(self, load: Load) -> MemorySplit:
        """What is there at every optimiser step whatever the batch: weights, gradients and optimiser."""
        block, trainable = _block(load.target), self.trainable()
        state, _ = step_bytes(load.optimizer, trainable, block)
        encoder = self._encoder()
        return MemorySplit(
            weights=self.weights(block),
            gradients=storage_bytes(trainable, block),
            optimiser=state,
            da3=0 if encoder is None else storage_bytes([*encoder.parameters(), *encoder.buffers()], block),
        )

    def _encoder(self) -> Da3Encoder | None:
        source = None if self.policy.geometry is None else self.policy.geometry.source
        return source.encoder if isinstance(source, Da3Source) else None

    # --- what has to be run ---------------------------------------------------------------------------------------

    def training(self, load: Load) -> MemorySplit:
        """The largest moment of a training step after the first, when the optimiser's state is there."""
        block = _block(load.target)
        state, workspace = step_bytes(load.optimizer, self.trainable(), block, foreach=load.target == "cuda")
        step = self._step(replace(load, optimizer=""))
        running = replace(step.largest, optimiser=state)
        updating = replace(step.largest, gradients=step.gradients, optimiser=state, activations=workspace + step.batch)
        return max(running, updating, key=lambda split: split.total)

    def _step(self, load: Load) -> "_Step":
        """Forward and backward pass, which do not depend on the optimiser; each load is run once."""
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
            if load.rows < load.batch_size:  # every micro-batch but the first finds all gradients there
                for parameter in trainable:
                    parameter.grad = torch.empty_like(parameter)
                    counter.label([parameter.grad], "gradients")
            _loss(policy, {key: value[: load.rows] for key, value in batch.items()}).backward()
            gradients = storage_bytes([p.grad for p in trainable if p.grad is not None], block)
            for hook in hooks:
                hook.remove()
            for parameter in trainable:
                parameter.grad = None
            self._steps[load] = _Step(counter.peak, gradients, storage_bytes(batch.values(), block))
        return self._steps[load]

    def inference(self, load: Load) -> MemorySplit:
        """The largest moment of predicting one action chunk by the plain path. Two denoising steps stand for all.

        The runner needs as much, and its masks and modulations beyond: some 20 MB at the released size.
        """
        policy = self.policy.eval()
        with ExitStack() as stack, torch.no_grad():
            counter = self._counter(stack, load.target)
            network = policy.model.paligemma_with_expert
            hook = network.register_forward_pre_hook(
                lambda _, __, given: _label_cache(counter, given), with_kwargs=True
            )
            batch = self._batch(load.batch_size, load.prompt_tokens)
            images, masks = prepare_images(batch, policy.config, CPU)
            embs, pad = _geometry(policy, batch)
            policy.model.sample_actions(
                images, masks, batch["observation.language.tokens"], batch["observation.language.attention_mask"],
                geom_embs=embs, geom_pad=pad, num_steps=2,
            )  # fmt: skip
            hook.remove()
        return counter.peak

    def _counter(self, stack: ExitStack, target: Target) -> MemoryCounter:
        """A counter at work over fake tensors, until the stack is left, with the weights already in it."""
        stack.enter_context(self.mode)
        if target == "cuda":
            stack.enter_context(CudaAutocast())
        counter = MemoryCounter(_block(target))
        counter.label([*self.policy.parameters(), *self.policy.buffers()], "weights")
        encoder = self._encoder()
        if encoder is not None:
            counter.label([*encoder.parameters(), *encoder.buffers()], "da3")
        return stack.enter_context(counter)

    def _batch(self, size: int, prompt_tokens: int) -> dict[str, Tensor]:
        """A batch as the preprocessor hands it to the policy: float images and depth in the data's own sizes."""
        config = self.policy.config
        observed = {key: feature.shape for key, feature in config.image_features.items()}
        observed |= {key: feature.shape for key, feature in config.geometry_features.items()}
        observed |= {key: feature.shape for key, feature in config.input_features.items() if not is_geometry_key(key)}
        batch = {key: torch.zeros(size, *shape) for key, shape in observed.items()}
        batch["observation.language.tokens"] = torch.zeros(size, prompt_tokens, dtype=torch.int64)
        batch["observation.language.attention_mask"] = torch.ones(size, prompt_tokens, dtype=torch.bool)
        batch["action"] = torch.zeros(size, config.chunk_size, config.action_feature.shape[0])
        return batch


def _block(target: Target) -> int:
    return CUDA_BLOCK if target == "cuda" else 1


def _label_cache(counter: MemoryCounter, given: Mapping[str, Any]) -> None:
    cache = given.get("past_key_values")
    if cache is not None:
        counter.label([cache.keys, cache.values], "cache")


def _geometry(policy: PI05GeometryPolicy, batch: Mapping[str, Tensor]) -> tuple[Tensor | None, Tensor | None]:
    """Geometry tokens without looking into values, which fakes have not."""
    if policy.geometry is None:
        return None, None
    with compute_in_float32(CPU):
        return policy.geometry.adapter(policy.geometry.source(batch, check=False))


def _loss(policy: PI05GeometryPolicy, batch: Mapping[str, Tensor]) -> Tensor:
    """`PI05GeometryPolicy.forward` without what looks into values: logging, checks, and the draw of the noise."""
    config = policy.config
    images, masks = prepare_images(batch, config, CPU)
    actions = pad_vector(batch["action"], config.max_action_dim).float()
    samples = () if config.flow_samples == 1 else (config.flow_samples,)
    noise = torch.zeros(actions.shape[0], *samples, *actions.shape[1:])
    time = torch.zeros(actions.shape[0], *samples)
    tokens, token_mask = batch["observation.language.tokens"], batch["observation.language.attention_mask"]
    losses = policy.model(images, masks, tokens, token_mask, actions, noise, time, *_geometry(policy, batch))
    losses = losses[..., : config.action_feature.shape[0]]
    if losses.ndim == 4:
        losses = losses.mean(dim=1)
    valid = torch.ones(losses.shape[:2], dtype=torch.bool)
    losses = losses.masked_fill(~valid[..., None], 0.0)
    return losses.sum() / (valid.sum() * losses.shape[-1])
