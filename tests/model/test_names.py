"""Parameter names and shapes are LeRobot's, so that a π0.5 checkpoint loads key for key."""

import pytest
import torch
from benchmarks.lerobot_pi05 import LM_HEADS, build_lerobot_pi05
from torch import nn

from lerobot_policy_pi05_geometry.model import GeometrySegmentConfig, NetworkConfig, PI05Pytorch
from lerobot_policy_pi05_geometry.model.variants import EXPERT_VARIANTS, PALIGEMMA_VARIANTS

from .helpers import IN_PREFIX, OWN_EXPERT, SEGMENT, name_of

SIZES = {"image_size": 224, "chunk_size": 50, "max_action_dim": 32}
GATE = "paligemma_with_expert.geometry_gate.openness"
EXPERT, OWN = "paligemma_with_expert.gemma_expert.model.", "paligemma_with_expert.geometry_expert."

Shapes = dict[str, tuple[int, ...]]


def shapes(module: nn.Module) -> Shapes:
    return {name: tuple(tensor.shape) for name, tensor in module.state_dict().items()}


@pytest.fixture(
    scope="module", params=[("gemma_2b", "gemma_300m"), ("small", "small"), ("tiny", "tiny")], ids=lambda p: p[0]
)
def variants(request: pytest.FixtureRequest) -> tuple[str, str]:
    return request.param


@pytest.fixture(scope="module")
def theirs(variants: tuple[str, str]) -> Shapes:
    """Names and shapes of LeRobot's network, without its two lm_heads; nothing is allocated."""
    with torch.device("meta"):
        found = shapes(build_lerobot_pi05(*variants, **SIZES))
    vocabulary = PALIGEMMA_VARIANTS[variants[0]].vocab_size
    assert [found.pop(name)[0] for name in LM_HEADS] == [vocabulary, vocabulary]
    return found


def ours(variants: tuple[str, str], geometry: GeometrySegmentConfig | None) -> Shapes:
    paligemma, expert = variants
    with torch.device("meta"):
        return shapes(
            PI05Pytorch(
                NetworkConfig(PALIGEMMA_VARIANTS[paligemma], EXPERT_VARIANTS[expert], geometry=geometry, **SIZES)
            )
        )


@pytest.mark.parametrize("geometry", [None, IN_PREFIX], ids=name_of)
def test_no_new_names(variants: tuple[str, str], theirs: Shapes, geometry: GeometrySegmentConfig | None) -> None:
    """Plain π0.5, and geometry in the VLM's prefix, have LeRobot's parameters and no other."""
    assert ours(variants, geometry) == theirs


def test_the_segment_adds_a_gate(variants: tuple[str, str], theirs: Shapes) -> None:
    """One openness per layer and head."""
    found = ours(variants, SEGMENT)
    expert = EXPERT_VARIANTS[variants[1]]
    assert found.pop(GATE) == (expert.depth, expert.num_heads)
    assert found == theirs


def test_an_own_expert_mirrors_the_action_expert(variants: tuple[str, str], theirs: Shapes) -> None:
    """`geometry_expert` has the action expert's names and shapes."""
    found = ours(variants, OWN_EXPERT)
    del found[GATE]
    own = {name.removeprefix(OWN): found.pop(name) for name in list(found) if name.startswith(OWN)}
    assert own == {name.removeprefix(EXPERT): shape for name, shape in theirs.items() if name.startswith(EXPERT)}
    assert found == theirs


def test_the_released_size() -> None:
    """Names of the released checkpoint that would be easy to get wrong."""
    found = ours(("gemma_2b", "gemma_300m"), None)
    inner = "paligemma_with_expert."
    language = inner + "paligemma.model.language_model."
    assert found[language + "layers.0.self_attn.q_proj.weight"] == (2048, 2048)
    assert found[language + "layers.17.self_attn.k_proj.weight"] == (256, 2048)
    assert found[language + "embed_tokens.weight"] == (257_152, 2048)
    assert found[inner + "gemma_expert.model.layers.17.input_layernorm.dense.weight"] == (3072, 1024)
    assert found[inner + "gemma_expert.model.norm.dense.bias"] == (3072,)
    assert found[inner + "paligemma.model.multi_modal_projector.linear.weight"] == (2048, 1152)
    assert found["action_in_proj.weight"] == (1024, 32)
    assert found["time_mlp_out.bias"] == (1024,)
    assert not any("lm_head" in name for name in found)
