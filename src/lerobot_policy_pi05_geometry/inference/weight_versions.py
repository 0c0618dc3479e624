"""Whether a network's weights are still those that something was computed from."""

from torch import Tensor, nn


class WeightVersions:
    """The modules and parameters of a network, and the versions of the parameters, as PyTorch counts them.

    PyTorch counts every write to a parameter but those through `parameter.data` and those of its fused optimisers.
    """

    def __init__(self, network: nn.Module) -> None:
        modules = list(network.modules())
        self._members = [members for module in modules for members in (module._modules, module._parameters) if members]
        self._parameters = list(network.parameters())
        # References, not ids: a new object may get the address of a freed one.
        self._found = [tuple(members.values()) for members in self._members]
        self._version = self._versions()

    def _versions(self) -> int:
        """The sum of all versions, each of which only grows."""
        return sum(_version(parameter) for parameter in self._parameters)

    def unchanged(self) -> bool:
        """Whether all modules and parameters are the same objects, and no write to a parameter was counted."""
        for members, found in zip(self._members, self._found, strict=True):
            if len(members) != len(found) or any(a is not b for a, b in zip(members.values(), found, strict=True)):
                return False
        return self._versions() == self._version


def _version(parameter: Tensor) -> int:
    return 0 if parameter.is_inference() else parameter._version  # tensors made in inference mode have no version
