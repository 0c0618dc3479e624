"""The tokenizer step: prompts that fit, and a tokenizer that is saved with the checkpoint."""

import re
import shutil
import socket
from pathlib import Path

import pytest
import torch
from lerobot.processor import PolicyProcessorPipeline
from tokenizers import AddedToken, Tokenizer, models, pre_tokenizers
from transformers import PreTrainedTokenizerFast

from lerobot_policy_pi05_geometry.data.small_tokenizer import SMALL_TOKENIZER
from lerobot_policy_pi05_geometry.data.tokenizer import (
    PortableTokenizerProcessorStep,
    check_vocabulary,
    read_tokenizer_files,
)
from tests.entry_points import STATE, STATE_DIM, TOKEN_MASK, TOKENS, make_config, make_observation, make_processors

PREPROCESSOR = "policy_preprocessor.json"


def run(pipeline: PolicyProcessorPipeline, task: str | list[str] | None = None, size: int = 2) -> dict:
    """What a preprocessor makes of an observation; its own tasks unless others are given."""
    observation = make_observation(size)
    return pipeline(observation if task is None else observation | {"task": task})


def test_prompts_are_padded_to_the_longest_of_the_batch():
    preprocessor, _ = make_processors(make_config())
    both = run(preprocessor)
    lengths = both[TOKEN_MASK].sum(dim=1)
    assert lengths[0] != lengths[1]
    assert both[TOKENS].shape == (2, lengths.max())
    assert both[TOKEN_MASK].dtype == torch.bool
    for row, length in enumerate(lengths.tolist()):
        assert both[TOKEN_MASK][row].tolist() == [True] * length + [False] * (lengths.max() - length)


def prompts_of(preprocessor: PolicyProcessorPipeline, batch: dict) -> list[str]:
    """The prompts that a batch's tokens spell."""
    (step,) = (step for step in preprocessor.steps if isinstance(step, PortableTokenizerProcessorStep))
    rows = zip(batch[TOKENS], batch[TOKEN_MASK], strict=True)
    return [step.loaded().decode(row[mask], skip_special_tokens=True) for row, mask in rows]


@pytest.mark.parametrize("task", ["press the red button " * 40, "x" * 700, "推按钮" * 200])
def test_a_long_task_is_shortened_and_the_state_stays(task, caplog):
    """With the prompt full, opposite states gave the same tokens."""
    preprocessor, _ = make_processors(make_config(tokenizer_max_length=60))
    observation = make_observation() | {"task": task}
    observation[STATE] = torch.tensor([[-1.0], [1.0]]).expand(2, STATE_DIM)
    first = preprocessor(dict(observation))
    prompts = prompts_of(preprocessor, first)
    for prompt, number in zip(prompts, (0, 255), strict=True):
        assert prompt.endswith(f", State: {' '.join([str(number)] * STATE_DIM)};\nAction: ")
        start = prompt.split(", State:")[0]
        assert f"Task: {task}".startswith(start)
        assert len(start) > len("Task: ")
    assert 50 < first[TOKENS].shape[1] <= 60
    assert torch.equal(preprocessor(dict(observation))[TOKENS], first[TOKENS])
    (record,) = caplog.records  # said once for each task
    assert "tokenizer_max_length (60 tokens)" in record.getMessage()


def test_a_task_is_cut_between_its_words():
    preprocessor, _ = make_processors(make_config(tokenizer_max_length=40))
    batch = run(preprocessor, "open the door and then close it " * 5)
    words = prompts_of(preprocessor, batch)[0].split(", State:")[0].removeprefix("Task: ").split(" ")
    assert words == ("open the door and then close it " * 5).split(" ")[: len(words)]


def test_a_prompt_that_just_fits_is_left_as_it_is(caplog):
    preprocessor, _ = make_processors(make_config())
    length = run(preprocessor)[TOKENS].shape[1]
    exact, _ = make_processors(make_config(tokenizer_max_length=length))
    assert torch.equal(run(exact)[TOKENS], run(preprocessor)[TOKENS])
    assert not caplog.records


def test_a_state_that_fills_the_prompt_is_refused():
    preprocessor, _ = make_processors(make_config(tokenizer_max_length=12))
    with pytest.raises(ValueError, match=r"state alone fills a prompt of tokenizer_max_length \(12 tokens\)"):
        run(preprocessor)


def make_other_tokenizer(size: int = 300, kind: str = "words") -> PreTrainedTokenizerFast:
    """A tokenizer with `size` ids that splits otherwise than the built-in one. kind: how its vocabulary is kept."""
    letters = [chr(i) for i in range(32, 127)]
    words = ["<pad>", "<unk>", *letters, *(f"word{i}" for i in range(size))][:size]
    if kind == "unigram":
        tokenizer = Tokenizer(models.Unigram([(word, -1.0) for word in words], unk_id=1))
    else:
        inside = words[: size // 2] if kind == "added" else words
        tokenizer = Tokenizer(models.WordLevel({word: i for i, word in enumerate(inside)}, unk_token="<unk>"))
        tokenizer.add_tokens([AddedToken(word) for word in words[len(inside) :]])
    if kind == "special":
        tokenizer.add_special_tokens([AddedToken("<image>", special=True)])
    tokenizer.pre_tokenizer = pre_tokenizers.Split("", "isolated")
    return PreTrainedTokenizerFast(tokenizer_object=tokenizer, pad_token="<pad>", unk_token="<unk>")


@pytest.fixture
def no_network(monkeypatch):
    """Any attempt to reach a hub fails."""

    def refuse(*_):
        raise AssertionError("tried to connect")

    monkeypatch.setattr(socket.socket, "connect", refuse)


def saved_elsewhere(pipeline: PolicyProcessorPipeline, tmp_path: Path) -> PolicyProcessorPipeline:
    """Save a preprocessor, move its folder, and load it from there."""
    pipeline.save_pretrained(tmp_path / "saved")
    shutil.move(tmp_path / "saved", tmp_path / "moved")
    return PolicyProcessorPipeline.from_pretrained(tmp_path / "moved", config_filename=PREPROCESSOR)


@pytest.mark.usefixtures("no_network")
def test_a_saved_pipeline_needs_no_hub_and_may_move(tmp_path):
    preprocessor, _ = make_processors(make_config())
    expected = run(preprocessor)
    found = run(saved_elsewhere(preprocessor, tmp_path))
    assert torch.equal(found[TOKENS], expected[TOKENS])
    assert torch.equal(found[TOKEN_MASK], expected[TOKEN_MASK])


@pytest.mark.usefixtures("no_network")
def test_a_tokenizer_folder_is_not_needed_once_it_was_saved(tmp_path):
    make_other_tokenizer().save_pretrained(tmp_path / "tokenizer")
    preprocessor, _ = make_processors(make_config(tokenizer_path=str(tmp_path / "tokenizer")))
    expected = run(preprocessor)
    assert not torch.equal(expected[TOKENS], run(make_processors(make_config())[0])[TOKENS])
    preprocessor.save_pretrained(tmp_path / "saved")
    shutil.rmtree(tmp_path / "tokenizer")
    loaded = PolicyProcessorPipeline.from_pretrained(tmp_path / "saved", config_filename=PREPROCESSOR)
    assert torch.equal(run(loaded)[TOKENS], expected[TOKENS])
    again = saved_elsewhere(loaded, tmp_path / "again")  # and once more, from what was loaded
    assert torch.equal(run(again)[TOKENS], expected[TOKENS])


def test_the_tokenizer_is_kept_even_if_it_was_never_used(tmp_path):
    step = PortableTokenizerProcessorStep(tokenizer_name=SMALL_TOKENIZER)
    state = step.state_dict()
    assert set(state) == {"tokenizer.json", "tokenizer_config.json"}
    reloaded = PortableTokenizerProcessorStep(tokenizer_name=str(tmp_path / "gone"))
    reloaded.load_state_dict(state)
    assert reloaded.loaded()("push")["input_ids"] == step.loaded()("push")["input_ids"]


def test_a_saved_tokenizer_with_a_file_missing_is_refused():
    step = PortableTokenizerProcessorStep(tokenizer_name=SMALL_TOKENIZER)
    state = step.state_dict()
    del state["tokenizer.json"]
    with pytest.raises(ValueError, match=r"has the files tokenizer.json, tokenizer_config.json, this one has"):
        step.load_state_dict(state)


@pytest.mark.parametrize("name", ["nowhere", "./nowhere", "/nowhere/at/all", "~/nowhere-at-all", "a/b/c"])
def test_a_tokenizer_folder_that_is_not_there_is_one_sentence(name):
    with pytest.raises(FileNotFoundError) as caught:
        make_processors(make_config(tokenizer_path=name))
    expected = f"Tokenizer folder {name} is not there; set --policy.tokenizer_path to an existing one."
    assert str(caught.value) == expected


def test_a_tokenizer_folder_without_a_tokenizer_is_one_sentence(tmp_path):
    with pytest.raises(OSError, match=rf"Tokenizer {re.escape(str(tmp_path))} could not be loaded") as caught:
        read_tokenizer_files(str(tmp_path))
    assert "\n" not in str(caught.value)


def test_a_hub_tokenizer_that_cannot_be_had_is_one_sentence(monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(OSError, match=r"Tokenizer nobody/none could not be loaded.*hf auth login") as caught:
        read_tokenizer_files("nobody/none")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["words", "added", "unigram"])
def test_a_tokenizer_too_large_for_the_vocabulary_is_refused(tmp_path, kind):
    make_other_tokenizer(1025, kind).save_pretrained(tmp_path / "large")
    with pytest.raises(ValueError, match=r"has token ids up to 1024, but the network embeds 1024"):
        make_processors(make_config(tokenizer_path=str(tmp_path / "large")))


@pytest.mark.parametrize("kind", ["words", "added", "unigram", "special"])
def test_a_tokenizer_that_just_fits_is_taken(tmp_path, kind):
    """Special: PaliGemma's own has <image> at 257,152, one past its embeddings; no prompt contains it."""
    make_other_tokenizer(1024, kind).save_pretrained(tmp_path / "fits")
    step = PortableTokenizerProcessorStep(tokenizer_name=str(tmp_path / "fits"))
    check_vocabulary(step, 1024)
