"""A tokenizer step that keeps its tokenizer inside the checkpoint."""

import logging
import tempfile
from bisect import bisect_left
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from lerobot.processor import ProcessorStepRegistry, TokenizerProcessorStep
from torch import Tensor
from transformers import AutoTokenizer

from .prompt import NO_TASK, split_prompt
from .small_tokenizer import SMALL_TOKENIZER, build_small_tokenizer

logger = logging.getLogger(__name__)

PALIGEMMA_TOKENIZER = "google/paligemma-3b-pt-224"
_FILES = ("tokenizer.json", "tokenizer_config.json")
_REPORTED_TASKS = 100  # a server meets tasks without end


@ProcessorStepRegistry.register(name="pi05_geometry_tokenizer")
@dataclass
class PortableTokenizerProcessorStep(TokenizerProcessorStep):
    """LeRobot's tokenizer step with the tokenizer inside its own saved state.

    LeRobot saves only a name, and looks it up again in the working directory or on the hub. Here `tokenizer.json` and
    `tokenizer_config.json` are part of the step's state (safetensors), so a checkpoint can be moved and used offline.
    Prompts are padded to the longest of the batch, not to `max_length`. A prompt above `max_length` gets a shorter task:
    the state and "Action:", which end a prompt, always stay.

    tokenizer_name: a local folder, a hub id, or "built-in" for the tokenizer of the small sizes.
    """

    padding: str = "longest"
    _files: dict[str, bytes] = field(default_factory=dict, init=False, repr=False)
    _built: Any = field(default=None, init=False, repr=False)
    _shortened: set[str] = field(default_factory=set, init=False, repr=False)  # tasks that were reported

    def __post_init__(self) -> None:
        """Load nothing yet: a step that is read from a checkpoint gets its files from its state."""

    def _tokenize_text(self, text: str | list[str]) -> dict[str, Tensor]:
        """Tokenise one prompt or several. Raises ValueError if a prompt does not fit, however short its task."""
        self.input_tokenizer = self.loaded()
        prompts = [text] if isinstance(text, str) else text
        lengths = [len(ids) for ids in self.input_tokenizer(prompts)["input_ids"]]
        fitting = [
            prompt if length <= self.max_length else self._shorten(prompt)
            for prompt, length in zip(prompts, lengths, strict=True)
        ]
        return super()._tokenize_text(fitting)

    def _shorten(self, prompt: str) -> str:
        """The prompt with as much of its task as fits into `max_length` tokens, cut between words if it has several."""
        task, end = split_prompt(prompt)

        def too_long(kept: int) -> bool:
            return len(self.input_tokenizer(task[:kept] + end)["input_ids"]) > self.max_length

        kept = bisect_left(range(len(task)), True, key=too_long)
        while kept and too_long(kept):  # one character less may be one token more, so the search can be off by a few
            kept -= 1
        if kept < len(NO_TASK):
            raise ValueError(
                f"The state alone fills a prompt of tokenizer_max_length ({self.max_length} tokens), and none of the task "
                f"fits: {prompt!r}; train or convert with a larger --policy.tokenizer_max_length."
            )
        short = task[:kept].rpartition(" ")[0] if " " in task[len(NO_TASK) : kept] else task[:kept]
        if task not in self._shortened and len(self._shortened) < _REPORTED_TASKS:
            self._shortened.add(task)
            logger.warning(
                "A prompt exceeds tokenizer_max_length (%d tokens), so its task is cut to %r; the state stays. Use a shorter "
                "task, or train or convert with a larger --policy.tokenizer_max_length.", self.max_length, short,
            )  # fmt: skip
        return short + end

    def loaded(self) -> Any:
        """The tokenizer. Raises FileNotFoundError or OSError if it cannot be loaded."""
        if self._built is None:
            if not self._files:
                self._files = read_tokenizer_files(str(self.tokenizer_name))
            with tempfile.TemporaryDirectory() as folder:
                for name, content in self._files.items():
                    (Path(folder) / name).write_bytes(content)
                self._built = AutoTokenizer.from_pretrained(folder, trust_remote_code=False)
        return self._built

    @property
    def files(self) -> dict[str, bytes]:
        """The tokenizer's files by name, those that a checkpoint carries."""
        return dict(self._files)

    def get_config(self) -> dict[str, Any]:
        return {**super().get_config(), "tokenizer_name": self.tokenizer_name}

    def state_dict(self) -> dict[str, Tensor]:
        self.loaded()
        return {name: torch.frombuffer(bytearray(content), dtype=torch.uint8) for name, content in self._files.items()}

    def save_artifacts(self, save_directory: Path) -> dict[str, str]:
        """No files beside the step's state, which holds the tokenizer. LeRobot 0.6.2 asks; 0.6.1 does not."""
        return {}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        if set(state) != set(_FILES):
            raise ValueError(
                f"A saved tokenizer has the files {', '.join(_FILES)}, this one has {', '.join(sorted(state))}."
            )
        self._files = {name: tensor.cpu().numpy().tobytes() for name, tensor in state.items()}
        self._built = None


def read_tokenizer_files(name: str) -> dict[str, bytes]:
    """`tokenizer.json` and `tokenizer_config.json` of a local folder, a hub id, or the built-in tokenizer."""
    if name == SMALL_TOKENIZER:
        tokenizer: Any = build_small_tokenizer()
    else:
        local = Path(name).expanduser()
        looks_local = name.startswith((".", "/", "~")) or name.count("/") != 1
        if looks_local and not local.is_dir():
            raise FileNotFoundError(
                f"Tokenizer folder {name} is not there; set --policy.tokenizer_path to an existing one."
            )
        try:
            tokenizer = AutoTokenizer.from_pretrained(local if local.is_dir() else name, trust_remote_code=False)
        except (OSError, ValueError) as error:
            raise OSError(
                f"Tokenizer {name} could not be loaded, neither as a folder nor from the hub; PaliGemma's is gated, so "
                "accept its licence and log in with `hf auth login`, or give a folder with --policy.tokenizer_path."
            ) from error
    with tempfile.TemporaryDirectory() as folder:
        tokenizer.save_pretrained(folder)
        files = {name: (Path(folder) / name).read_bytes() for name in _FILES if (Path(folder) / name).is_file()}
    if set(files) != set(_FILES):
        raise OSError(f"Tokenizer {name} has no tokenizer.json; only fast tokenizers can be carried in a checkpoint.")
    return files


def check_vocabulary(step: PortableTokenizerProcessorStep, vocab_size: int) -> None:
    """Raise ValueError if the tokenizer has ids that the network has no embedding for."""
    tokenizer = step.loaded()
    # PaliGemma's <image> has an id one past its embeddings; special added tokens never stand in a prompt.
    special = {index for index, token in tokenizer.added_tokens_decoder.items() if token.special}
    largest = max((index for index in tokenizer.get_vocab().values() if index not in special), default=0)
    if largest >= vocab_size:
        raise ValueError(
            f"Tokenizer {step.tokenizer_name} has token ids up to {largest}, but the network embeds {vocab_size}; choose "
            "the tokenizer that belongs to --policy.paligemma_variant."
        )
