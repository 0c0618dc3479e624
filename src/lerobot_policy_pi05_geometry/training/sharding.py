"""FSDP units of the policy, for a training loop in plain torch (FSDP2, `torch.distributed.fsdp.fully_shard`).

FSDP gathers a unit's parameters in hooks around its `__call__`. So a unit is a module that is called: a transformer layer, and
not a whole transformer, since `PaliGemmaWithExpert` runs the layers one by one for three segments. All parameters of a unit have
one dtype, so modules that stay in float32 are units of their own.
"""

from typing import Any

from torch import nn
from torch.distributed.fsdp import FullyShardedDataParallel, fully_shard
from torch.distributed.tensor import DTensor
from transformers.models.siglip.modeling_siglip import SiglipEncoderLayer

from ..model.gemma import GemmaLayer
from ..model.precision import Float32Module

# Names of the classes whose modules are units, which LeRobot 0.6.2 asks a policy for (`_fsdp_wrap_modules`).
UNIT_CLASSES = (
    "GemmaLayer",
    "SiglipEncoderLayer",
    "LayerNorm",
    "RMSNorm",
    "Float32Linear",
    "GeometryGate",
    "GeometryAdapter",
    "PointAdapter",
)


def fsdp_units(policy: nn.Module) -> list[nn.Module]:
    """Modules to shard one by one, inner ones first; the policy itself is the last unit, and not among them."""
    units: list[nn.Module] = []

    def visit(module: nn.Module) -> None:
        if isinstance(module, Float32Module | nn.LayerNorm):
            units.append(module)
            return
        for child in module.children():
            visit(child)
        if isinstance(module, GemmaLayer | SiglipEncoderLayer):
            units.append(module)

    visit(policy)
    return units


def shard[P: nn.Module](policy: P, **options: Any) -> P:
    """Shard a policy in place; options are those of `fully_shard` (mesh, reshard_after_forward, ...).

    Build the optimiser afterwards, and call `policy(batch)`, not `policy.forward(batch)`, which would skip the hooks.
    """
    for unit in fsdp_units(policy):
        fully_shard(unit, **options)
    fully_shard(policy, **options)
    return policy


def require_whole_parameters(module: nn.Module, setting: str) -> None:
    """Raise ValueError if FSDP shards the parameters of `module`, which `setting` does not allow.

    FSDP expects one backward pass over its units, and gathers them in hooks that a compiled layer would not run.
    """
    sharded = any(isinstance(m, FullyShardedDataParallel) for m in module.modules())
    if sharded or any(isinstance(p, DTensor) for p in module.parameters()):
        raise ValueError(
            f"{setting} does not work with FSDP's sharded parameters; leave --policy.{setting} out and, if memory is short, "
            "lower --batch_size, or train with DDP."
        )
