"""Micro-batches inside one loss: a large training batch with the memory of a small one.

LeRobot's loop calls forward, backward and the optimiser once per batch. So the gradients of all micro-batches are computed
in the forward pass. The activations of one micro-batch are freed before the next begins. An autograd function, whose inputs
are the trainable parameters, returns the sums of the gradients in the backward pass. For DDP, gradient clipping and a loss
scale this is an ordinary loss: each parameter gets its gradient once per step.

A loss per sample has weights that are known in the backward pass only. Then micro-batches run forward without a graph, and
once more in the backward pass.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from ..geometry.keys import CALIBRATION_PREFIX, RIG
from ..model.layer_calls import draws
from .sharding import require_whole_parameters

Part = Callable[[], Tensor]  # computes the loss of one micro-batch, with its graph


def in_micro_batches(
    part: Callable[[slice], Tensor], size: int, step: int, policy: nn.Module, reduction: str
) -> Tensor:
    """`part` of `step` rows of `size` at a time: the sum of its scalars, or, with reduction "none", its (b,) joined to (B,)."""
    parts: list[Part] = [partial(part, slice(start, start + step)) for start in range(0, size, step)]
    if len(parts) == 1:
        return parts[0]()
    parameters = [p for p in policy.parameters() if p.requires_grad]
    if reduction == "none" and draws(policy):
        parts = [_SameDraws(run) for run in parts]
    if torch.is_grad_enabled() and parameters:
        require_whole_parameters(policy, "micro_batch_size")
        return (each_of if reduction == "none" else sum_of)(parts, parameters)
    losses = [run() for run in parts]
    return torch.cat(losses) if reduction == "none" else torch.stack(losses).sum()


class _SameDraws:
    """A part that draws in its second run, in the backward pass, what it drew in its first one."""

    def __init__(self, run: Part) -> None:
        self._run = run
        self._state: tuple[Tensor, list[Tensor]] | None = None

    def __call__(self) -> Tensor:
        gpu = torch.cuda.is_initialized()
        if self._state is None:
            self._state = torch.get_rng_state(), torch.cuda.get_rng_state_all() if gpu else []
            return self._run()
        with torch.random.fork_rng(range(torch.cuda.device_count()) if gpu else []):
            torch.set_rng_state(self._state[0])
            if self._state[1]:
                torch.cuda.set_rng_state_all(self._state[1])
            return self._run()


def sum_of(parts: Sequence[Part], parameters: Sequence[nn.Parameter]) -> Tensor:
    """Sum of scalar losses, whose gradients by `parameters` are computed now."""
    total: Tensor = _GradientsInForward.apply(parts, *parameters)
    return total


def each_of(parts: Sequence[Part], parameters: Sequence[nn.Parameter]) -> Tensor:
    """Losses per sample (B,), joined from the parts' (b,); gradients by `parameters` are computed in the backward pass."""
    losses: Tensor = _GradientsInBackward.apply(parts, *parameters)
    return losses


def rows_of(batch: Mapping[str, Any], size: int, rows: slice) -> dict[str, Any]:
    """Some rows of a batch of `size` samples. Entries that are not per sample are kept whole."""

    def per_sample(key: str, value: Any) -> bool:
        if isinstance(value, Tensor):
            # Once for the batch, unless it is the rigs of 16 samples.
            pose_of_all = key.startswith(CALIBRATION_PREFIX) and key != RIG and value.shape in ((4, 4), (16,))
            return value.ndim > 0 and value.shape[0] == size and not pose_of_all
        return isinstance(value, list | tuple) and len(value) == size

    return {key: value[rows] if per_sample(key, value) else value for key, value in batch.items()}


class _GradientSums:
    """Sums of gradients over several backward passes, one buffer per parameter.

    A hook adds each gradient to its sum as soon as autograd has computed it, and frees it. So the sums and all gradients of
    one pass are never in memory together. `torch.autograd.grad` does not touch `.grad` and does not run DDP's hooks.
    """

    def __init__(self, parameters: Sequence[Tensor]) -> None:
        self.parameters = parameters
        self.sums: list[Tensor | None] = [None] * len(parameters)

    def add(self, outputs: Tensor, weights: Tensor | None = None) -> None:
        """Add the gradients of `outputs`, a scalar, or (b,) with `weights` (b,)."""

        def take(index: int) -> Callable[[Tensor], Tensor]:
            def hook(gradient: Tensor) -> Tensor:
                found = self.sums[index]
                if found is None:
                    self.sums[index] = gradient.detach().clone()
                else:
                    found.add_(gradient.detach())
                return gradient.new_zeros(()).expand(gradient.shape)  # autograd keeps this one until the pass ends

            return hook

        handles = [parameter.register_hook(take(i)) for i, parameter in enumerate(self.parameters)]
        try:
            torch.autograd.grad(outputs, self.parameters, weights, allow_unused=True)
        finally:
            for handle in handles:
                handle.remove()

    def result(self) -> list[Tensor]:
        """One gradient per parameter, zeros where there was none: DDP waits for every input of the autograd function."""
        found = zip(self.sums, self.parameters, strict=True)
        return [torch.zeros_like(parameter) if total is None else total for total, parameter in found]


class _GradientsInForward(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, parts: Sequence[Part], *parameters: Tensor) -> Tensor:
        sums = _GradientSums(parameters)
        losses = []
        for part in parts:
            with torch.enable_grad():
                loss = part()
            sums.add(loss)
            losses.append(loss.detach())
            del loss
        ctx.gradients = sums.result()
        return torch.stack(losses).sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, weight: Tensor) -> tuple[Tensor | None, ...]:
        gradients, ctx.gradients = ctx.gradients, None
        if gradients is None:
            raise RuntimeError(
                "A loss in micro-batches has one backward pass, since its gradients are freed then; call forward again."
            )
        for gradient in gradients:
            gradient.mul_(weight)
        return None, *gradients


class _GradientsInBackward(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, parts: Sequence[Part], *parameters: Tensor) -> Tensor:
        ctx.parts = parts
        ctx.save_for_backward(*parameters)
        losses = [part() for part in parts]
        ctx.sizes = [len(loss) for loss in losses]
        return torch.cat(losses)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, weights: Tensor) -> tuple[Tensor | None, ...]:
        sums = _GradientSums(ctx.saved_tensors)
        for part, part_weights in zip(ctx.parts, weights.split(ctx.sizes), strict=True):
            with torch.enable_grad():
                losses = part()
            sums.add(losses, part_weights)
            del losses
        return None, *sums.result()
