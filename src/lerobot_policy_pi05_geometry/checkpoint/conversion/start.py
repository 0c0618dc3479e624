"""Values that the parameters start with which π0.5 does not have."""

import torch
from torch import Tensor, nn

from ...geometry.adapter import GeometryAdapter
from ...model.paligemma_with_expert import PaliGemmaWithExpert
from ...model.segment_gate import GeometryGate
from ...modeling_pi05_geometry import PI05GeometryPolicy
from .names import PREFIX
from .tensor_file import StoredTensor

_NETWORK = f"{PREFIX}paligemma_with_expert."
_GATE, _ADAPTER, _OWN_EXPERT = f"{_NETWORK}geometry_gate.", "geometry.adapter.", f"{_NETWORK}geometry_expert."
_EXPERT = f"{_NETWORK}gemma_expert.model."
_STEP = "progress.step"


def is_new(name: str) -> bool:
    """Whether π0.5 has no such tensor."""
    return name == _STEP or name.startswith((_GATE, _ADAPTER, _OWN_EXPERT))


def inherited_shapes(policy: PI05GeometryPolicy) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the tensors that a policy has from π0.5."""
    return {name: tuple(tensor.shape) for name, tensor in policy.state_dict().items() if not is_new(name)}


def start_values(
    policy: PI05GeometryPolicy, stored: dict[str, StoredTensor], seed: int
) -> dict[str, StoredTensor | Tensor]:
    """Every new tensor of a policy on the meta device, by its name in the state dict.

    The adapter is drawn anew, the gate as open as configured, an own expert is a copy of the action expert.

    stored: π0.5's tensors by their names in the state dict. seed: another draws another adapter.
    """
    values: dict[str, StoredTensor | Tensor] = {_STEP: torch.zeros((), dtype=torch.int64)}
    network = policy.model.paligemma_with_expert
    assert isinstance(network, PaliGemmaWithExpert)
    if network.geometry_gate is not None:
        layers, heads = network.geometry_gate.openness.shape
        values |= _state(_GATE, GeometryGate(layers, heads, policy.config.geometry_gate_openness))
    if network.geometry_expert is not None:
        values |= {
            name.replace(_EXPERT, _OWN_EXPERT): tensor for name, tensor in stored.items() if name.startswith(_EXPERT)
        }
    if policy.geometry is not None:
        source = policy.geometry.source
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            adapter = GeometryAdapter(source.feature_dim, policy.model.geometry_width, source.grid, len(source.cameras))
        values |= _state(_ADAPTER, adapter)
    return values


def _state(prefix: str, module: nn.Module) -> dict[str, Tensor]:
    return {prefix + name: tensor for name, tensor in module.state_dict().items()}
