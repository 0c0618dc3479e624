"""Settings that fit a GPU, best first: as close to full fine-tuning as it goes, then as many samples at once as it goes.

What the user has fixed stays fixed. Of the rest a recipe says what is trained and how; for each the largest (micro-)batch that
fits is looked for, a power of two below the wanted batch. Gradient checkpointing is given up where the wanted batch fits without.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from ..configuration_pi05_geometry import PI05GeometryConfig
from .counting import MemorySplit
from .gpus import GIB, needed
from .lora import LoraPlan
from .workload import FakePolicy, Load


@dataclass(frozen=True)
class Recipe:
    """What is trained, and how. settings: of the policy's configuration, in addition to the defaults of `_PLAIN`."""

    name: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    optimizer: str = "adamw"
    lora: LoraPlan | None = None

    def all_settings(self) -> dict[str, Any]:
        return {**_PLAIN, **self.settings}


# float32 weights, bfloat16 products. Weights that LoRA leaves frozen lose nothing in bfloat16, which is what they are used in.
_PLAIN = {"dtype": "bfloat16", "param_dtype": "float32", "train_expert_only": False, "freeze_vision_encoder": False}
_NO_VISION, _EXPERT = {"freeze_vision_encoder": True}, {"train_expert_only": True}
_FROZEN_BF16 = {"param_dtype": "bfloat16"}

# Best first.
RECIPES = (
    Recipe("full fine-tuning"),
    Recipe("full fine-tuning, 8-bit AdamW", optimizer="adamw8bit"),
    Recipe("all but the vision tower", _NO_VISION),
    Recipe("all but the vision tower, 8-bit AdamW", _NO_VISION, "adamw8bit"),
    Recipe("LoRA on VLM and expert", _FROZEN_BF16, lora=LoraPlan(target="all")),
    Recipe("action expert only", _EXPERT),
    Recipe("action expert only, 8-bit AdamW", _EXPERT, "adamw8bit"),
    Recipe("LoRA on the expert", _FROZEN_BF16, lora=LoraPlan(target="expert")),
)


@dataclass(frozen=True)
class Fixed:
    """What the user has fixed: settings of the policy by name, the optimiser, the adapters; None where it is open."""

    settings: Mapping[str, Any] = field(default_factory=dict)
    optimizer: str | None = None
    lora: LoraPlan | None = None

    def allows(self, recipe: Recipe) -> bool:
        if any(
            self.settings.get(name, value) != value for name, value in recipe.all_settings().items() if name != "dtype"
        ):
            return False
        if self.lora is not None and (recipe.lora is None or recipe.lora.target != self.lora.target):
            return False
        return self.optimizer in (None, recipe.optimizer)


@dataclass(frozen=True)
class Proposal:
    """A recipe that fits, with what it needs."""

    recipe: Recipe
    checkpointing: bool
    load: Load
    split: MemorySplit

    def options(self) -> list[str]:
        """What to give to lerobot-train for it; adapters have options of their own."""
        said = {name: value for name, value in self.recipe.all_settings().items() if value not in (False, "float32")}
        said["gradient_checkpointing"] = self.checkpointing
        if self.load.rows < self.load.batch_size:
            said["micro_batch_size"] = self.load.rows
        if self.recipe.optimizer != "adamw":
            said["optimizer"] = self.recipe.optimizer
        written = [f"--policy.{name}={str(value).lower()}" for name, value in said.items()]
        return [*written, f"--batch_size={self.load.batch_size}"]


@dataclass(frozen=True)
class Rejection:
    """A recipe that does not fit, and why, as a sentence."""

    recipe: Recipe
    why: str


def propose(
    make_config: Callable[[Mapping[str, Any]], PI05GeometryConfig],
    load: Load,
    budget: int,
    fixed: Fixed = Fixed(),
    da3: Any = None,
) -> Iterator[Proposal | Rejection]:
    """Every recipe in turn, best first, as a proposal or a rejection.

    make_config: settings -> a complete configuration. load: the wanted batch. budget: bytes of the GPU.
    """
    built: dict[Any, FakePolicy] = {}
    at_ease: set[Any] = set()  # what fits with the whole batch at once
    for recipe in RECIPES:
        if not fixed.allows(recipe):
            continue
        if recipe.lora is not None and fixed.lora is not None:
            recipe = replace(recipe, lora=fixed.lora)

        def predict(rows: int, checkpointing: bool, recipe: Recipe = recipe) -> tuple[Load, MemorySplit]:
            settings = recipe.all_settings() | {"gradient_checkpointing": checkpointing}
            key = (tuple(sorted(settings.items())), recipe.lora)
            if key not in built:
                built[key] = FakePolicy(make_config(settings | dict(fixed.settings)), recipe.lora, da3)
            policy = built[key]
            asked = replace(load, micro_batch_size=rows, optimizer=recipe.optimizer, lora=recipe.lora)
            floor = policy.resident(asked)  # seconds are spared where this alone is too much
            return asked, floor if needed(floor) > budget else policy.training(asked)

        same = (tuple(sorted(recipe.all_settings().items())), recipe.lora)
        if same in at_ease:
            continue  # 8 bits would gain nothing
        outcome = _largest(recipe, predict, load.batch_size, budget, fixed.settings.get("gradient_checkpointing"))
        if isinstance(outcome, Proposal) and outcome.load.rows == load.batch_size:
            at_ease.add(same)
        yield outcome


def _largest(
    recipe: Recipe,
    predict: Callable[[int, bool], tuple[Load, MemorySplit]],
    wanted: int,
    budget: int,
    checkpointing: bool | None,
) -> Proposal | Rejection:
    """The recipe with the largest micro-batch that fits; see the module's text for what is tried."""
    rows = wanted
    while rows:
        asked, split = predict(rows, checkpointing is not False)
        if needed(split) <= budget:
            if checkpointing is None and rows == wanted:
                plain = predict(rows, False)
                if needed(plain[1]) <= budget:
                    return Proposal(recipe, False, *plain)
            return Proposal(recipe, checkpointing is not False, asked, split)
        # Activations grow with the batch in a straight line, and not from zero: this guess is rarely too small.
        spare = budget - needed(replace(split, activations=0))
        if split.activations == 0 or (spare <= 0 and rows == 1):
            break
        guess = max(1, int(rows * max(spare, 0) / (needed(split) - needed(replace(split, activations=0)))))
        rows = min(rows - 1, guess)
        rows = 1 << (rows.bit_length() - 1) if rows else 0
    what = "weights, gradients and optimiser alone" if split.activations == 0 else "a single sample at once"
    return Rejection(recipe, f"{what} need {needed(split) / GIB:.1f} GiB")
