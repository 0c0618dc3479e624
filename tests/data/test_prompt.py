"""The prompt and the tokenizer that travels inside the checkpoint."""

import re
import shutil
import socket
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from lerobot.lerobot_types import TransitionKey
from lerobot.policies.pi05.processor_pi05 import Pi05PrepareStateTokenizerProcessorStep
from lerobot.processor import PolicyProcessorPipeline
from tokenizers import AddedToken, Tokenizer, models, pre_tokenizers
from transformers import PreTrainedTokenizerFast

from lerobot_policy_pi05_geometry.data.prompt import (
    SMALL_TOKENIZER,
    STATE_BINS,
    PortableTokenizerProcessorStep,
    PromptProcessorStep,
    build_small_tokenizer,
    check_vocabulary,
    discretise_state,
    make_prompt,
    read_tokenizer_files,
    small_number_ids,
)
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from tests.entry_points import STATE, TOKEN_MASK, TOKENS, make_config, make_observation, make_processors

PREPROCESSOR = "policy_preprocessor.json"


# --- state --------------------------------------------------------------------------------------------------------


def openpi_bins(state: torch.Tensor) -> np.ndarray:
    return np.digitize(state.numpy(), bins=np.linspace(-1, 1, 256 + 1)[:-1]) - 1


@settings(max_examples=50)
@example(values=[-1e-20, 1e-20])
@given(values=st.lists(st.floats(-1, 1, width=32), min_size=1, max_size=9))
def test_bins_are_openpis_inside_the_range(values):
    state = torch.tensor([values])
    assert discretise_state(state).tolist() == openpi_bins(state).tolist()


@pytest.mark.parametrize("step", [-1e-6, 0.0, 1e-6])
def test_bins_are_openpis_at_every_edge(step):
    edges = torch.linspace(-1, 1, 257, dtype=torch.float64)
    state = (edges + step).clamp(-1, 1)[None]
    assert discretise_state(state).tolist() == openpi_bins(state).tolist()
    assert discretise_state(edges[None])[0, [0, 128, 256]].tolist() == [0, 128, 255]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_a_state_out_of_range_is_clipped(dtype):
    state = torch.tensor([[-1.0001, -7.0, -1e30, 1.0001, 7.0, 1e30]], dtype=dtype)
    assert discretise_state(state).tolist() == [[0, 0, 0, 255, 255, 255]]


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), float("-inf")])
def test_a_state_that_is_no_number_is_refused(bad):
    state = torch.zeros(3, 5)
    state[1, 4] = bad
    with pytest.raises(ValueError, match=rf"observation.state\[4\] is {bad} in sample 1 of the batch"):
        discretise_state(state)


# --- prompt -------------------------------------------------------------------------------------------------------


def transition(state: torch.Tensor | None, task: str | list[str] | None) -> dict:
    data = {} if task is None else {"task": task}
    observation = {} if state is None else {STATE: state}
    return {TransitionKey.OBSERVATION: observation, TransitionKey.COMPLEMENTARY_DATA: data}


@given(
    state=st.lists(st.floats(-1, 1, width=16), min_size=1, max_size=40),
    task=st.text("abc _\n.,XY12", max_size=20),
)
def test_the_prompt_is_lerobots_for_a_state_in_range(state, task):
    tasks, states = [task, "push_the\ncube "], torch.tensor([state, state[::-1]])
    ours = PromptProcessorStep()(transition(states, list(tasks)))
    theirs = Pi05PrepareStateTokenizerProcessorStep()(transition(states, list(tasks)))
    data = TransitionKey.COMPLEMENTARY_DATA
    assert ours[data]["task"] == theirs[data]["task"]


def test_the_prompt_below_the_range_has_bins_and_not_minus_one():
    out = PromptProcessorStep()(transition(torch.tensor([[-1.5, 1.5]]), "push"))
    assert out[TransitionKey.COMPLEMENTARY_DATA]["task"] == ["Task: push, State: 0 255;\nAction: "]
    assert make_prompt(" open_the\ndoor ", [3]) == "Task: open the door, State: 3;\nAction: "


def test_the_transition_that_came_in_is_left_alone():
    given_transition = transition(torch.zeros(1, 2), ["push"])
    PromptProcessorStep()(given_transition)
    assert given_transition[TransitionKey.COMPLEMENTARY_DATA]["task"] == ["push"]


def test_a_missing_state_or_task_is_said():
    with pytest.raises(ValueError, match=r"no observation.state"):
        PromptProcessorStep()(transition(None, "push"))
    with pytest.raises(ValueError, match=r"no task"):
        PromptProcessorStep()(transition(torch.zeros(1, 2), None))


# --- the built-in tokenizer ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def built_in() -> PreTrainedTokenizerFast:
    return build_small_tokenizer()


def test_the_built_in_tokenizer_is_always_the_same(built_in):
    for _ in range(3):
        assert build_small_tokenizer().backend_tokenizer.to_str() == built_in.backend_tokenizer.to_str()


@settings(max_examples=50)
@given(text=st.text(st.characters(exclude_categories=["Cs"]), max_size=40))
def test_the_built_in_tokenizer_encodes_any_text(built_in, text):
    ids = built_in(text)["input_ids"]
    assert ids[0] == built_in.bos_token_id
    assert all(0 <= i < 1024 for i in ids)
    assert built_in.decode(ids[1:], clean_up_tokenization_spaces=False) == text


def test_the_built_in_tokenizer_is_short_on_its_own_prompts(built_in):
    prompt = make_prompt("press the button", list(range(40, 240, 25)))
    assert len(built_in(prompt)["input_ids"]) < len(prompt) / 2


# --- the step -----------------------------------------------------------------------------------------------------


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


def test_prompts_are_cut_at_the_longest_allowed():
    preprocessor, _ = make_processors(make_config(tokenizer_max_length=12))
    assert run(preprocessor)[TOKENS].shape == (2, 12)


def test_a_prompt_that_may_have_lost_its_state_is_said_once(caplog):
    preprocessor, _ = make_processors(make_config(tokenizer_max_length=12))
    run(preprocessor)
    run(preprocessor)
    assert [
        record.getMessage() for record in caplog.records if "tokenizer_max_length (12 tokens)" in record.getMessage()
    ]
    assert len(caplog.records) == 1


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


def test_numbers_start_in_order_for_a_vocabulary_that_nobody_trained():
    """Neighbouring numbers are alike, distant ones are not, and every number is as long as other tokens are on average."""
    ids = small_number_ids()
    tokenizer = build_small_tokenizer()
    assert [tokenizer.decode([i]).strip() for i in ids] == [str(n) for n in range(STATE_BINS)]
    policy = PI05GeometryPolicy(make_config(paligemma_variant="small", action_expert_variant="small"))
    table = policy.model.paligemma_with_expert.language_model.embed_tokens.weight.detach()
    numbers = table[torch.tensor(ids)]
    alike = numbers @ numbers.T
    assert torch.allclose(alike.diagonal(), torch.ones(STATE_BINS), atol=1e-5)
    assert alike.diagonal(offset=1).min() > 0.9
    assert alike.diagonal(offset=100).max() < 0.6
    others = torch.ones(len(table), dtype=torch.bool).index_fill(0, torch.tensor(ids), False)
    assert 0.9 < table[others].norm(dim=1).mean() < 1.1
