"""torchao's AdamW with moments in 8 bits, in a form that LeRobot's loop can run, save and resume.

torchao quantises both moments in blocks of 256 numbers (Dettmers et al., arXiv 2110.02861), in tensors of 4,096 numbers
or more. Four of its properties do not fit LeRobot and are changed here:

* Its state dict holds tensors of its own class, which safetensors cannot write. Here it holds codes and scales.
* Its learning rate is a tensor, which LeRobot cannot write to JSON or log. Here it is a tensor during `step` only.
* Loading casts a state to the dtype of its parameter and moves it to its device. Here codes stay codes, and the step
  counter stays on the CPU, so that a resumed run computes the same powers of the betas.
* Moments below 1e-12 are lost, and gradients behind a closed gate are that small. Groups with `full_state` keep their
  moments in the dtype of their parameters.

On a GPU torchao compiles the step (once per shape, seconds each); on a CPU it runs as it is, without a compiler.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torchao.optim import AdamW8bit as TorchaoAdamW8bit
from torchao.optim.subclass_8bit import OptimState8bit

from .parameter_groups import FULL_STATE

_SIGNED = {"exp_avg": True, "exp_avg_sq": False}  # the first moment has a sign
_CODES, _SCALE = "_codes", "_scale"


class AdamW8bit(TorchaoAdamW8bit):
    """AdamW with 8-bit moments; groups as `torch.optim.AdamW` takes them, and `full_state`."""

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Add a group, whose learning rate stays a number."""
        lr = float(param_group.get("lr", self.defaults["lr"]))
        super().add_param_group(param_group)
        self.param_groups[-1]["lr"] = lr

    def _new_buffer(self, p: Tensor, signed: bool) -> Tensor:
        """torchao asks here for a new moment of a parameter."""
        if any(p is other for group in self.param_groups if group.get(FULL_STATE) for other in group["params"]):
            return torch.zeros_like(p)
        moment: Tensor = super()._new_buffer(p, signed)
        return moment

    def step(self, closure: Callable[[], float] | None = None) -> float | None:
        """One update of all parameters that have a gradient."""
        rates = [group["lr"] for group in self.param_groups]
        on_cpu = all(p.device.type == "cpu" for group in self.param_groups for p in group["params"])
        for group in self.param_groups:
            group["lr"] = torch.tensor(group["lr"], dtype=torch.float32)
        try:
            with torch.compiler.set_stance("force_eager" if on_cpu else "default"):
                loss: float | None = super().step(closure)
                return loss
        finally:
            for group, rate in zip(self.param_groups, rates, strict=True):
                group["lr"] = rate

    def state_dict(self) -> dict[str, Any]:
        """Plain tensors, each with memory of its own: codes (uint8) and scales (float32) of the moments that have them."""
        found = super().state_dict()
        found["state"] = {index: _plain(state) for index, state in found["state"].items()}
        return found

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load what `state_dict` returned."""
        state = {index: _quantised(state) for index, state in state_dict["state"].items()}
        super().load_state_dict({**state_dict, "state": state})


def _plain(state: dict[str, Tensor]) -> dict[str, Tensor]:
    plain: dict[str, Tensor] = {}
    for name, value in state.items():
        if isinstance(value, OptimState8bit):
            plain |= {name + _CODES: value.codes, name + _SCALE: value.scale}
        else:
            plain[name] = value
    return plain


def _quantised(plain: dict[str, Tensor]) -> dict[str, Tensor]:
    state: dict[str, Tensor] = {"step": plain["step"].cpu()}
    for name, signed in _SIGNED.items():
        if name in plain:
            state[name] = plain[name]
            continue
        codes, scale = plain[name + _CODES], plain[name + _SCALE]
        empty = OptimState8bit.zeros(codes.shape, signed, codes.numel() // scale.numel(), codes.device)
        state[name] = OptimState8bit(codes, scale, empty.qmap, signed, dtype=torch.float32)
    return state
