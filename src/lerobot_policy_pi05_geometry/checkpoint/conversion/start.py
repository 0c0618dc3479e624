"""Values that the parameters start with which π0.5 does not have."""

from copy import deepcopy

import torch
from accelerate import init_empty_weights
from torch import Tensor, nn

from ...configuration_pi05_geometry import PI05GeometryConfig
from ...geometry.adapter import make_adapter
from ...geometry.da3.weights import meta_da3
from ...model.paligemma_with_expert import PaliGemmaWithExpert
from ...model.segment_gate import GeometryGate
from ...modeling_pi05_geometry import PI05GeometryPolicy
from .names import PREFIX
from .tensor_file import StoredTensor

_NETWORK = f"{PREFIX}paligemma_with_expert."
GATE, ADAPTER, OWN_EXPERT = f"{_NETWORK}geometry_gate.", "geometry.adapter.", f"{_NETWORK}geometry_expert."
_EXPERT = f"{_NETWORK}gemma_expert.model."
STEP = "progress.step"


def is_new(name: str) -> bool:
    """Whether π0.5 has no such tensor."""
    return name == STEP or name.startswith((GATE, ADAPTER, OWN_EXPERT))


def meta_policy(config: PI05GeometryConfig) -> PI05GeometryPolicy:
    """The policy of a configuration without values; records the hash of its Depth Anything 3 encoder in the configuration."""
    encoder = None
    if config.geometry_source in ("da3", "features"):
        encoder = meta_da3(config)
        config.da3_hash = encoder.content_hash
    with init_empty_weights(include_buffers=False):
        return PI05GeometryPolicy(deepcopy(config), encoder=encoder)  # a policy completes its configuration


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
    values: dict[str, StoredTensor | Tensor] = {STEP: torch.zeros((), dtype=torch.int64)}
    network = policy.model.paligemma_with_expert
    assert isinstance(network, PaliGemmaWithExpert)
    if network.geometry_gate is not None:
        layers, heads = network.geometry_gate.openness.shape
        values |= _state(GATE, GeometryGate(layers, heads, policy.config.geometry_gate_openness))
    if network.geometry_expert is not None:
        values |= {
            name.replace(_EXPERT, OWN_EXPERT): tensor for name, tensor in stored.items() if name.startswith(_EXPERT)
        }
    if policy.geometry is not None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            adapter = make_adapter(policy.geometry.source, policy.model.geometry_width)
        values |= _state(ADAPTER, adapter)
    return values


def _state(prefix: str, module: nn.Module) -> dict[str, Tensor]:
    return {prefix + name: tensor for name, tensor in module.state_dict().items()}
