"""Settings that fit a GPU, best first: as close to full fine-tuning as possible, then as many samples at once as possible.

The settings that the user gave stay as they are. A recipe says what is trained, and how. For each recipe the largest
(micro-)batch that fits is searched: the requested batch, or a power of two below it. Gradient checkpointing is off where the
requested batch fits without it.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from ..configuration_pi05_geometry import PI05GeometryConfig
from .adapters import unsupported_reason
from .counting import MemorySplit
from .gpus import GIB, needed
from .workload import FakePolicy, Load

RANK = 16  # of LoRA, unless the user gives one; lerobot-train's default


@dataclass(frozen=True)
class Recipe:
    """What is trained, and how. settings: of the policy's configuration, in addition to the defaults of `_PLAIN`."""

    name: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    lora: bool = False

    def all_settings(self) -> dict[str, Any]:
        return {**_PLAIN, **self.settings}

    def without_optimizer(self) -> tuple[Any, ...]:
        """The settings that the forward and backward pass depend on."""
        return (*sorted((k, v) for k, v in self.all_settings().items() if k != "optimizer"), self.lora)


# float32 weights, bfloat16 products. The weights that LoRA freezes lose nothing in bfloat16, since products use them in it.
_PLAIN = {
    "dtype": "bfloat16", "param_dtype": "float32", "train_expert_only": False, "freeze_vision_encoder": False,
    "optimizer": "adamw",
}  # fmt: skip
_NO_VISION, _EXPERT = {"freeze_vision_encoder": True}, {"train_expert_only": True}
_FROZEN_BF16 = {"param_dtype": "bfloat16"}
_8_BIT = {"optimizer": "adamw8bit"}

# Best first.
RECIPES = (
    Recipe("full fine-tuning"),
    Recipe("full fine-tuning, 8-bit AdamW", _8_BIT),
    Recipe("all but the vision tower", _NO_VISION),
    Recipe("all but the vision tower, 8-bit AdamW", _NO_VISION | _8_BIT),
    Recipe("LoRA on VLM and expert", _FROZEN_BF16 | {"lora_targets": "expert+vlm"}, lora=True),
    Recipe("action expert only", _EXPERT),
    Recipe("action expert only, 8-bit AdamW", _EXPERT | _8_BIT),
    Recipe("LoRA on the expert", _FROZEN_BF16 | {"lora_targets": "expert"}, lora=True),
)


@dataclass(frozen=True)
class Fixed:
    """What the user gave: settings of the policy by name, and the rank of LoRA, None if LoRA was not asked for."""

    settings: Mapping[str, Any] = field(default_factory=dict)
    lora_rank: int | None = None

    def allows(self, recipe: Recipe) -> bool:
        wanted = {name: value for name, value in recipe.all_settings().items() if name != "dtype"}
        if any(self.settings.get(name, value) != value for name, value in wanted.items()):
            return False
        return recipe.lora or self.lora_rank is None


@dataclass(frozen=True)
class Proposal:
    """A recipe that fits, and the memory it needs. fixed: what the user gave. defaults: the settings without any option."""

    recipe: Recipe
    checkpointing: bool
    load: Load
    split: MemorySplit
    fixed: Fixed = Fixed()
    defaults: Mapping[str, Any] = field(default_factory=dict)

    def options(self) -> list[str]:
        """The options of lerobot-train for it: those given by the user, and those that differ from checkpoint or defaults."""
        rows, whole, given = self.load.rows, self.load.batch_size, self.fixed.settings
        wanted = self.recipe.all_settings() | {"gradient_checkpointing": self.checkpointing} | dict(given)
        wanted["micro_batch_size"] = rows if rows < whole else 0
        said = {name: value for name, value in wanted.items() if name in given or value != self.defaults.get(name)}
        written = [f"--policy.{name}={str(value).lower()}" for name, value in said.items()]
        peft = [f"--peft.r={self.fixed.lora_rank or RANK}"] if self.recipe.lora else []
        return [*written, *peft, f"--batch_size={whole}"]


@dataclass(frozen=True)
class Rejection:
    """A recipe that is not proposed, and why, as the rest of a sentence. unavailable: on any GPU."""

    recipe: Recipe
    why: str
    unavailable: bool = False


def propose(
    make_config: Callable[[Mapping[str, Any]], PI05GeometryConfig],
    load: Load,
    budget: int,
    fixed: Fixed = Fixed(),
    da3: Any = None,
) -> Iterator[Proposal | Rejection]:
    """Every recipe in turn, best first, as a proposal or a rejection.

    make_config: settings -> a complete configuration. load: the requested batch. budget: bytes of the GPU.
    """
    built: dict[Any, FakePolicy] = {}
    plain = make_config({})
    defaults = vars(plain) | {"micro_batch_size": plain.micro_batch_size or 0}
    fit_whole: set[Any] = set()  # recipes that fit with the whole batch at once
    for recipe in RECIPES:
        if not fixed.allows(recipe) or recipe.without_optimizer() in fit_whole:  # then 8 bits would gain nothing
            continue
        reason = unsupported_reason() if recipe.lora else None
        if reason is not None:
            yield Rejection(recipe, reason, unavailable=True)
            continue

        def predict(rows: int, checkpointing: bool, recipe: Recipe = recipe) -> tuple[Load, MemorySplit]:
            key = (recipe.without_optimizer(), checkpointing)
            if key not in built:
                settings = recipe.all_settings() | {"gradient_checkpointing": checkpointing}
                rank = (fixed.lora_rank or RANK) if recipe.lora else None
                built[key] = FakePolicy(make_config(settings | dict(fixed.settings)), rank, da3)
            policy = built[key]
            asked = replace(load, micro_batch_size=rows, optimizer=recipe.all_settings()["optimizer"])
            floor = policy.resident(asked)  # saves seconds where this alone is too much
            return asked, floor if needed(floor) > budget else policy.training(asked)

        outcome = _largest(recipe, predict, load, budget, fixed)
        if isinstance(outcome, Proposal) and outcome.load.rows == load.batch_size:
            fit_whole.add(recipe.without_optimizer())
        yield replace(outcome, defaults=defaults) if isinstance(outcome, Proposal) else outcome


def _largest(
    recipe: Recipe,
    predict: Callable[[int, bool], tuple[Load, MemorySplit]],
    wanted: Load,
    budget: int,
    fixed: Fixed,
) -> Proposal | Rejection:
    """The recipe with the largest micro-batch that fits; see the module's docstring for the order."""
    checkpointing = fixed.settings.get("gradient_checkpointing")
    rows = wanted.rows
    while rows:
        asked, split = predict(rows, checkpointing is not False)
        if needed(split) <= budget:
            if checkpointing is None and rows == wanted.rows:
                plain = predict(rows, False)
                if needed(plain[1]) <= budget:
                    return Proposal(recipe, False, *plain, fixed)
            return Proposal(recipe, checkpointing is not False, asked, split, fixed)
        # Activations grow linearly with the batch, from an offset, so this guess is rarely too small.
        spare = budget - needed(replace(split, activations=0))
        if split.activations == 0 or (spare <= 0 and rows == 1) or "micro_batch_size" in fixed.settings:
            break
        guess = max(1, int(rows * max(spare, 0) / (needed(split) - needed(replace(split, activations=0)))))
        rows = min(rows - 1, guess)
        rows = 1 << (rows.bit_length() - 1) if rows else 0
    what = "weights, gradients and optimiser alone" if split.activations == 0 else f"{rows or 1} at once"
    return Rejection(recipe, f"{what} need {needed(split) / GIB:.1f} GiB")
