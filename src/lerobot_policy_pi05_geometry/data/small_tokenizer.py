"""The tokenizer of the `small` and `tiny` sizes, built from a list of words in this file. It needs no hub."""

from functools import cache

from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors, trainers
from transformers import PreTrainedTokenizerFast

from .prompt import STATE_BINS

SMALL_TOKENIZER = "built-in"  # its name in `tokenizer_name`

# It is trained on the words of the prompt, on numbers, and on words of manipulation tasks.
_WORDS = """press push pull open close pick place put reach move grasp lift insert slide turn rotate lock unlock assemble
the a an from to on in into with of at side top down above left right front back near under over red green blue white
button door drawer window lever handle faucet peg hole puck ball basket box bin shelf plate coffee mug nut hammer dial
stick soccer goal wall block cube cup bowl object gripper robot arm hand table target it them and then"""


def build_small_tokenizer() -> PreTrainedTokenizerFast:
    """A byte-level BPE of at most 1,024 tokens. It encodes any text, and every call builds the same one."""
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
    """Ids of the numbers 0..255 in the built-in tokenizer, after a space, as in a prompt. Each number is one token."""
    tokenizer = build_small_tokenizer()
    return tuple(tokenizer.encode(f" {number}", add_special_tokens=False)[0] for number in range(STATE_BINS))
