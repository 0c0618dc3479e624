"""How the network calls a transformer layer: as it is, checkpointed, and in training also compiled.

Compiled is the call of one layer, not the whole network. Layers of the same kind share what is compiled: their weights are
inputs. So compiling takes as long for 18 layers as for one. Each kind (vision, and of prefix, geometry and suffix a middle and
a last layer) is one graph without a break (`fullgraph`). Sizes are symbols (`dynamic`), so that another prompt length needs no
other graph; only a size of 1 does.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import torch
from torch import nn
from torch.utils.checkpoint import checkpoint

# How many graphs there may be: those kinds, with and without a gradient by the input, in batches of one and of more, and
# again for an input that is a view. PyTorch's own limit is 8.
_GRAPHS = 64


def call_layer(layer: nn.Module, *arguments: Any, checkpointing: bool = False, compiled: bool = False) -> Any:
    """The result of `layer(*arguments)`. checkpointing: its activations are recomputed in the backward pass.

    compiled: by torch.compile, where a gradient is asked for. A layer with a hook in it is called as it is: a graph is not
    compiled again for a hook, which would not run.
    """
    call = _call
    if compiled and torch.is_grad_enabled() and not _has_hooks(layer):
        call = _call_compiled
    if checkpointing:
        return checkpoint(call, layer, *arguments, use_reentrant=False, preserve_rng_state=draws(layer))
    return call(layer, *arguments)


def draws(module: nn.Module) -> bool:
    """Whether a module draws random numbers when it is called, as LoRA's dropout does: run again, it must draw the same."""
    return any(isinstance(part, nn.Dropout) and part.p > 0 and part.training for part in module.modules())


def _call(layer: nn.Module, *arguments: Any) -> Any:
    return layer(*arguments)


@cache
def _compiled() -> Callable[..., Any]:
    from torch._inductor import config  # only where something is compiled: the import takes long

    # On a GPU this analysis of PyTorch 2.11 ends in an AssertionError for the backward pass of a layer with symbolic sizes
    # (seen on an H200). It chooses tiles; without it the compiler chooses them by its older rule. Older versions have none.
    tiles = "coalesce_tiling_analysis"
    options: dict[str, Any] = {f"triton.{tiles}": False} if hasattr(config.triton, tiles) else {}
    return torch.compile(_call, fullgraph=True, dynamic=True, options=options)


def _call_compiled(layer: nn.Module, *arguments: Any) -> Any:
    # PyTorch would cut a graph at DDP's buckets in the forward pass and not where checkpointing runs it again. A layer is small
    # enough as it is: DDP sends its gradients while the layers before it are computed.
    with torch._dynamo.config.patch(recompile_limit=_GRAPHS, optimize_ddp=False):
        return _compiled()(layer, *arguments)


def _has_hooks(layer: nn.Module) -> bool:
    return any(
        module._forward_hooks or module._forward_pre_hooks or module._backward_hooks or module._backward_pre_hooks
        for module in layer.modules()
    )
