"""The prompt: task text and discretised state, and a tokenizer that travels inside the checkpoint."""

import logging
import tempfile
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry, TokenizerProcessorStep
from lerobot.utils.constants import OBS_STATE
from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors, trainers
from torch import Tensor
from transformers import AutoTokenizer, PreTrainedTokenizerFast

logger = logging.getLogger(__name__)

STATE_BINS = 256
PALIGEMMA_TOKENIZER = "google/paligemma-3b-pt-224"
SMALL_TOKENIZER = "built-in"
_FILES = ("tokenizer.json", "tokenizer_config.json")


@ProcessorStepRegistry.register(name="pi05_geometry_prompt")
@dataclass
class PromptProcessorStep(ProcessorStep):
    """Writes "Task: ..., State: 12 200 ...;\\nAction: " into the task, from the normalised state.

    The state is clipped to [-1, 1] and put into bins 0..255, as openpi does; without the clip, LeRobot writes "-1" for
    what lies below the range.
    """

    task_key: str = "task"

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        transition = transition.copy()
        state = (transition.get(TransitionKey.OBSERVATION) or {}).get(OBS_STATE)
        data = dict(transition.get(TransitionKey.COMPLEMENTARY_DATA) or {})
        tasks = data.get(self.task_key)
        if state is None:
            raise ValueError(f"The observation has no {OBS_STATE}, which the prompt is made from.")
        if tasks is None:
            raise ValueError("The observation has no task; say what the robot should do (LeRobot's `task`).")
        bins = discretise_state(state)
        tasks = [tasks] if isinstance(tasks, str) else list(tasks)
        data[self.task_key] = [make_prompt(task, row) for task, row in zip(tasks, bins.tolist(), strict=True)]
        transition[TransitionKey.COMPLEMENTARY_DATA] = data
        return transition

    def get_config(self) -> dict[str, Any]:
        return {"task_key": self.task_key}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


def discretise_state(state: Tensor) -> Tensor:
    """Normalised state (B, D) -> bins 0..255, (B, D) int64. Raises ValueError for NaN or inf."""
    if not state.isfinite().all():
        row, dim = (~state.isfinite()).nonzero()[0].tolist()
        raise ValueError(
            f"{OBS_STATE}[{dim}] is {state[row, dim].item()} in sample {row} of the batch; a sensor that fails must not "
            "steer the robot, so fix the source or drop the frame."
        )
    edges = torch.linspace(-1.0, 1.0, STATE_BINS + 1, dtype=torch.float64)[:-1]
    return torch.bucketize(state.cpu().double().clamp(-1.0, 1.0), edges, right=True) - 1


def make_prompt(task: str, bins: list[int]) -> str:
    """π0.5's prompt for one observation."""
    text = task.strip().replace("_", " ").replace("\n", " ")
    return f"Task: {text}, State: {' '.join(map(str, bins))};\nAction: "


@ProcessorStepRegistry.register(name="pi05_geometry_tokenizer")
@dataclass
class PortableTokenizerProcessorStep(TokenizerProcessorStep):
    """LeRobot's tokenizer step with the tokenizer inside its own saved state.

    LeRobot keeps only a name, which is looked up again from the working directory or the hub. Here `tokenizer.json` and
    `tokenizer_config.json` are part of the step's state (safetensors), so a checkpoint needs neither, after its folder
    has moved too. Prompts are padded to the batch's longest, not always to `max_length`.

    tokenizer_name: a local folder, a hub id, or "built-in" for the small sizes' own.
    """

    padding: str = "longest"
    _files: dict[str, bytes] = field(default_factory=dict, init=False, repr=False)
    _built: Any = field(default=None, init=False, repr=False)
    _warned: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        """Nothing is loaded before it is needed; a step that is being reloaded gets its files from its state."""

    def _tokenize_text(self, text: str | list[str]) -> dict[str, Tensor]:
        self.input_tokenizer = self.loaded()
        tokens = super()._tokenize_text(text)
        if tokens["input_ids"].shape[1] >= self.max_length and not self._warned:
            self._warned = True
            logger.warning(
                "A prompt fills tokenizer_max_length (%d tokens), so its end, the state, may be cut off; raise it.",
                self.max_length,
            )
        return tokens

    def loaded(self) -> Any:
        """The tokenizer. Raises FileNotFoundError or OSError with one sentence if it cannot be had."""
        if self._built is None:
            if not self._files:
                self._files = read_tokenizer_files(str(self.tokenizer_name))
            with tempfile.TemporaryDirectory() as folder:
                for name, content in self._files.items():
                    (Path(folder) / name).write_bytes(content)
                self._built = AutoTokenizer.from_pretrained(folder)
        return self._built

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
            tokenizer = AutoTokenizer.from_pretrained(local if local.is_dir() else name)
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


# What the built-in tokenizer is made from: the prompt's own words, numbers, and words of manipulation tasks.
_WORDS = """press push pull open close pick place put reach move grasp lift insert slide turn rotate lock unlock assemble
the a an from to on in into with of at side top down above left right front back near under over red green blue white
button door drawer window lever handle faucet peg hole puck ball basket box bin shelf plate coffee mug nut hammer dial
stick soccer goal wall block cube cup bowl object gripper robot arm hand table target it them and then"""


def build_small_tokenizer() -> PreTrainedTokenizerFast:
    """A byte-level BPE of at most 1,024 tokens for the `small` and `tiny` sizes: any text, no hub, always the same."""
    tokenizer = Tokenizer(models.BPE())
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    corpus = [
        f"Task: {word} {word}, State: {n % 256} {n % 256};\nAction: " for n, word in enumerate(_WORDS.split() * 8)
    ]
    corpus += [" ".join(str(n) for n in range(STATE_BINS))] * 8
    trainer = trainers.BpeTrainer(
        vocab_size=1024,
        special_tokens=["<pad>", "<eos>", "<bos>"],
        initial_alphabet=pre_tokenizers.ByteLevel.alphabet(),
        show_progress=False,
    )
    tokenizer.train_from_iterator(corpus, trainer)
    tokenizer.post_processor = processors.TemplateProcessing(single="<bos> $A", special_tokens=[("<bos>", 2)])
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="<pad>", eos_token="<eos>", bos_token="<bos>", padding_side="right"
    )


@cache
def small_number_ids() -> tuple[int, ...]:
    """Ids of the numbers 0..255 in the built-in tokenizer, as they stand in a prompt: each is one token."""
    tokenizer = build_small_tokenizer()
    return tuple(tokenizer.encode(f" {number}", add_special_tokens=False)[0] for number in range(STATE_BINS))


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
