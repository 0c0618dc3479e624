"""Which tensor of a π0.5 file is which parameter of the network.

The network has LeRobot's names, so what differs is little. Sources: LeRobot 0.6.1 `PI05Policy.from_pretrained` and
`_fix_pytorch_state_dict_keys`; openpi `models_pytorch/pi0_pytorch.py` and `convert_jax_model_to_pytorch.py`.

* `model.` before a name: LeRobot's own checkpoints have it, openpi's and those made from them do not.
* `paligemma.lm_head` and `language_model.embed_tokens` are one tensor in openpi, and safetensors' `save_model` keeps the
  first name only: the embedding is then found under `lm_head`. LeRobot's own files have both, no longer tied, and the
  embedding is the one that is read.
* `action_time_mlp_*` is π0's name of `time_mlp_*`; LeRobot renames it.
"""

import re
from collections.abc import Iterable

PREFIX = "model."  # of the network's parameters in a policy's state dict
VLM_HEAD = "paligemma_with_expert.paligemma.lm_head.weight"
EXPERT_HEAD = "paligemma_with_expert.gemma_expert.lm_head.weight"
EMBEDDING = "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"

_RENAMED = re.compile(r"^action_(time_mlp_(?:in|out)\.)")
_EXPERT = re.escape("paligemma_with_expert.gemma_expert.model.")
_ADAPTIVE_NORM = re.compile(_EXPERT + r".*norm\.dense\.")
_LEFT_FROM_PI0 = re.compile(
    r"^state_proj\.|" + _EXPERT + r"(norm|layers\.\d+\.(input_layernorm|post_attention_layernorm))\.weight$"
)


def is_unused(name: str) -> bool:
    """Whether π0.5 never reads this tensor: the whole list.

    The two output matrices of the language models, and what a π0.5 that was made from a π0 may still carry (LeRobot's
    loader skips it too): π0's state projection and the plain norms that adaptive ones have replaced.
    """
    return name in (VLM_HEAD, EXPERT_HEAD) or _LEFT_FROM_PI0.match(name) is not None


def canonical(name: str) -> str:
    """The network's name of a tensor of a π0.5 file."""
    return _RENAMED.sub(r"\1", name.removeprefix(PREFIX))


def find_parameters(path: object, names: Iterable[str]) -> dict[str, str]:
    """Network parameter -> name in the file, for every tensor that is not on the list of unused ones.

    path: of the file, for messages. Raises ValueError for a π0 checkpoint, or if a parameter stands there twice.
    """
    found: dict[str, str] = {}
    for name in sorted(names):
        parameter = canonical(name)
        if parameter in found:
            raise ValueError(
                f"Checkpoint {path} has {parameter} twice, as {found[parameter]} and as {name}, so it does not say which "
                "holds; remove one of them."
            )
        found[parameter] = name
    if not any(map(_ADAPTIVE_NORM.match, found)) and any(map(_LEFT_FROM_PI0.match, found)):
        raise ValueError(
            f"Checkpoint {path} is a π0, not a π0.5: its action expert has no adaptive norms (*.dense.*); choose a π0.5 "
            "checkpoint, such as lerobot/pi05_base."
        )
    if EMBEDDING not in found and VLM_HEAD in found:
        found[EMBEDDING] = found[VLM_HEAD]
    return {parameter: name for parameter, name in found.items() if not is_unused(parameter)}
