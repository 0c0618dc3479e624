"""`pi05-geometry plan`: from options to what is printed."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.console import RenderableType

from ..configuration_pi05_geometry import DEFAULT_ENCODER, PI05GeometryConfig
from .configuration import complete
from .gpus import GIB, gpu_bytes
from .lora import LORA_TARGETS, LoraPlan
from .options import configuration, da3_variant, policy_options, typed
from .proposals import Fixed, Proposal, Rejection, propose
from .tables import explanation, proposal_table, split_table
from .workload import FakePolicy, Load


@dataclass(frozen=True)
class Data:
    """What observations are like, where no checkpoint says it. image_size: (height, width)."""

    cameras: int = 2
    depth_cameras: int = 1
    image_size: tuple[int, int] = (480, 640)
    prompt_tokens: int | None = None


@dataclass(frozen=True)
class Wish:
    """What the user asks beside the policy's settings; see the command's help. None is open."""

    gpu: str | None = None
    batch_size: int = 8
    micro_batch_size: int | None = None
    optimizer: str | None = None
    lora: str | None = None
    lora_rank: int = 16
    proposals: int = 3
    explain: bool = False


def run(arguments: Sequence[str], data: Data, wish: Wish) -> Iterator[RenderableType]:
    """What to print, piece by piece.

    Raises ValueError, with one sentence, for what cannot be read, and where nothing fits.
    """
    options = policy_options(arguments)

    def make_config(changes: Mapping[str, Any]) -> PI05GeometryConfig:
        text = {name: str(value).lower() for name, value in changes.items()}
        return complete(configuration(text | options), data.cameras, data.depth_cameras, data.image_size)

    config = make_config({})
    budget = None if wish.gpu is None else gpu_bytes(wish.gpu)
    lora = None
    if wish.lora is not None:
        if wish.lora not in LORA_TARGETS:
            raise ValueError(f"--lora must be one of {', '.join(LORA_TARGETS)}, got '{wish.lora}'.")
        lora = LoraPlan(wish.lora_rank, wish.lora)
    da3 = da3_variant(config.da3_encoder or DEFAULT_ENCODER) if config.geometry_source == "da3" else None
    load = Load(
        wish.batch_size,
        wish.micro_batch_size,
        data.prompt_tokens or config.tokenizer_max_length,
        wish.optimizer or "adamw",
        lora,
    )
    if budget is None:
        policy = FakePolicy(config, lora, da3)
        prediction = FakePolicy(config, None, da3) if lora else policy  # adapters are merged before a policy acts
        splits = {
            "training": policy.training(load),
            "inference": prediction.inference(Load(1, None, load.prompt_tokens)),
        }
        yield split_table(splits)
    else:
        fixed = Fixed(typed(options, config), wish.optimizer, lora)
        found: list[Proposal] = []
        rejected: list[Rejection] = []
        for outcome in propose(make_config, load, budget, fixed, da3):
            (found if isinstance(outcome, Proposal) else rejected).append(outcome)  # type: ignore[arg-type]
            if len(found) == wish.proposals:
                break
        if not found:
            least = rejected[-1] if rejected else None
            why = f"{least.recipe.name}: {least.why}" if least else "the given settings leave no recipe to try"
            raise ValueError(f"Nothing fits {budget / GIB:.1f} GiB ({why}); give a larger GPU, or fix fewer settings.")
        yield proposal_table(found, budget)
        for number, proposal in enumerate(found, 1):
            adapters = proposal.recipe.lora
            note = "" if adapters is None else f" (with adapters of rank {adapters.rank})"
            yield f"{number}. lerobot-train --policy.type=pi05_geometry {' '.join(proposal.options())} ...{note}"
        if wish.explain:
            for rejection in rejected:
                yield f"{rejection.recipe.name} does not fit: {rejection.why}."
    if wish.explain:
        yield explanation(config, load)
