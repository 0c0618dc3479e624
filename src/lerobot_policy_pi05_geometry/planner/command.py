"""`pi05-geometry plan`: from options to tables."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.console import RenderableType
from rich.markup import escape

from ..configuration_pi05_geometry import DEFAULT_ENCODER, PI05GeometryConfig
from .adapters import SOMEWHERE
from .configuration import acting, complete
from .gpus import GIB, gpu_bytes
from .options import configuration, da3_variant, lora_rank, policy_options, typed
from .proposals import Fixed, Proposal, Rejection, propose
from .tables import explanation, proposal_table, split_table
from .workload import FakePolicy, Load


@dataclass(frozen=True)
class Data:
    """Observations, where no checkpoint describes them. image_size: (height, width)."""

    cameras: int = 2
    depth_cameras: int = 1
    image_size: tuple[int, int] = (480, 640)
    prompt_tokens: int | None = None


@dataclass(frozen=True)
class Wish:
    """Arguments beside the policy's settings; see the command's help."""

    gpu: str | None = None
    batch_size: int = 8
    proposals: int = 3
    explain: bool = False


def run(arguments: Sequence[str], data: Data, wish: Wish) -> Iterator[RenderableType]:
    """The tables and lines to print, one by one. arguments: `--policy.*` and `--peft.*`, as lerobot-train takes them.

    Raises ValueError, with one sentence, for arguments that cannot be read, and where nothing fits.
    """
    rank, others = lora_rank(arguments)
    options = policy_options(others)

    def make_config(changes: Mapping[str, Any]) -> PI05GeometryConfig:
        text = {name: str(value).lower() for name, value in changes.items()}
        found = configuration(text | options)
        if "path" not in options:
            found.calibration_path = None  # of cameras that are made up here; memory does not depend on it
        return complete(found, data.cameras, data.depth_cameras, data.image_size)

    config = make_config({})
    budget = None if wish.gpu is None else gpu_bytes(wish.gpu)
    has_encoder = config.geometry_source in ("da3", "features")
    da3 = da3_variant(config.da3_encoder or DEFAULT_ENCODER) if has_encoder else None
    prompt = data.prompt_tokens or config.tokenizer_max_length
    load = Load(wish.batch_size, config.micro_batch_size, prompt, config.optimizer)
    if budget is None:
        training = FakePolicy(config, rank, da3).training(load)
        # Adapters are merged before a policy acts.
        inference = FakePolicy(acting(make_config({})), None, da3).inference(Load(1, None, prompt))
        yield split_table({"training": training, "inference": inference})
    else:
        yield from _proposals(
            make_config, load, budget, Fixed(typed(options, configuration(options)), rank), da3, wish, options
        )
    if wish.explain:
        yield explanation(config, load)


def _proposals(
    make_config: Any, load: Load, budget: int, fixed: Fixed, da3: Any, wish: Wish, options: Mapping[str, str]
) -> Iterator[RenderableType]:
    """The table, the commands, and with `explain` the recipes that do not fit."""
    found: list[Proposal] = []
    rejected: list[Rejection] = []
    for outcome in propose(make_config, load, budget, fixed, da3):
        if isinstance(outcome, Rejection):
            rejected.append(outcome)
        else:
            found.append(outcome)
        if len(found) == wish.proposals:
            break
    if not found:
        why = (
            f"{rejected[-1].recipe.name}: {rejected[-1].why}"
            if rejected
            else "no recipe agrees with the given settings"
        )
        raise ValueError(f"Nothing fits {budget / GIB:.1f} GiB ({why}); give a larger GPU, or fix fewer settings.")
    yield proposal_table(found, budget)
    variant = make_config({}).paligemma_variant
    for number, proposal in enumerate(found, 1):
        start = start_option(options.get("path"), variant, proposal.recipe.lora)
        yield escape(f"{number}. lerobot-train {start} {' '.join(proposal.options())} ...")
    if wish.explain:
        yield split_table({str(number): proposal.split for number, proposal in enumerate(found, 1)})
    for rejection in rejected if wish.explain else [r for r in rejected if r.unavailable]:
        yield escape(f"Not proposed: {rejection.recipe.name}, since {rejection.why}.")


def start_option(path: str | None, variant: str, lora: bool) -> str:
    """What lerobot-train begins with: a checkpoint, or random weights. path: the user's checkpoint; None if none was given."""
    if path is None and variant != "gemma_2b" and not lora:
        return "--policy.type=pi05_geometry"
    return f"--policy.path={path or SOMEWHERE}"  # the released size and LoRA need pretrained weights
