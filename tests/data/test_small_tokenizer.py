"""The built-in tokenizer of the small sizes."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from transformers import PreTrainedTokenizerFast

from lerobot_policy_pi05_geometry.data.prompt import STATE_BINS, make_prompt
from lerobot_policy_pi05_geometry.data.small_tokenizer import build_small_tokenizer, small_number_ids
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from tests.entry_points import make_config


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
