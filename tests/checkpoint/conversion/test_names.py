"""Every tensor of a π0.5 file finds its parameter, at the released size and in every layout."""

import pytest
import torch
from benchmarks.lerobot_pi05 import build_lerobot_pi05
from hypothesis import given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.checkpoint.conversion.names import canonical, find_parameters, is_unused
from lerobot_policy_pi05_geometry.model import GeometrySegmentConfig, NetworkConfig, PI05Pytorch
from lerobot_policy_pi05_geometry.model.variants import EXPERT_VARIANTS, PALIGEMMA_VARIANTS

from .sources import EMBEDDING, EXPERT_HEAD, VLM_HEAD, lerobot_policy

NAMES = sorted(name.removeprefix("model.") for name in lerobot_policy().state_dict())


@pytest.mark.parametrize("tied", [False, True])
@pytest.mark.parametrize("prefix", ["", "model."])
def test_the_released_checkpoint_maps_one_to_one(prefix, tied):
    """LeRobot's names and shapes at full size, on the meta device, in every layout, are the network's."""
    sizes = {"image_size": 224, "chunk_size": 50, "max_action_dim": 32}
    with torch.device("meta"):
        theirs = {
            k: tuple(v.shape) for k, v in build_lerobot_pi05("gemma_2b", "gemma_300m", **sizes).state_dict().items()
        }
        network = PI05Pytorch(
            NetworkConfig(
                PALIGEMMA_VARIANTS["gemma_2b"], EXPERT_VARIANTS["gemma_300m"], geometry=GeometrySegmentConfig(), **sizes
            )
        )
    ours = {name: tuple(t.shape) for name, t in network.state_dict().items() if "geometry" not in name}
    if tied:
        del theirs[EMBEDDING]
    file = {prefix + name: shape for name, shape in theirs.items()}
    found = find_parameters("file", file)
    assert {name: file[theirs_name] for name, theirs_name in found.items()} == ours
    assert set(file) - set(found.values()) == {prefix + name for name in (EXPERT_HEAD, VLM_HEAD)[: 1 if tied else 2]}


@given(st.sets(st.sampled_from(NAMES)), st.booleans(), st.booleans())
def test_any_mixture_of_layouts_is_the_same_checkpoint(prefixed, renamed, with_heads):
    names = []
    for name in NAMES:
        if not with_heads and name in (VLM_HEAD, EXPERT_HEAD):
            continue
        theirs = name.replace("time_mlp", "action_time_mlp") if renamed else name
        names.append(("model." if name in prefixed else "") + theirs)
    found = find_parameters("file", names)
    assert set(found) == set(NAMES) - {VLM_HEAD, EXPERT_HEAD}
    for parameter, name in found.items():
        assert canonical(name) == parameter
    assert set(names) - set(found.values()) == {name for name in names if is_unused(canonical(name))}


def test_the_embedding_holds_where_the_head_is_not_tied():
    assert find_parameters("file", NAMES)[EMBEDDING] == EMBEDDING


def test_what_a_pi0_left_behind_is_unused():
    left = ["state_proj.weight", "model.state_proj.bias", "paligemma_with_expert.gemma_expert.model.norm.weight",
            "model.paligemma_with_expert.gemma_expert.model.layers.2.input_layernorm.weight"]  # fmt: skip
    assert find_parameters("file", NAMES + left) == find_parameters("file", NAMES)


@pytest.mark.parametrize(
    "name", [EMBEDDING, "time_mlp_in.weight", "paligemma_with_expert.gemma_expert.model.norm.dense.bias"]
)
def test_nothing_that_is_read_is_on_the_list_of_unused(name):
    assert not is_unused(name)
    assert not any(map(is_unused, set(NAMES) - {VLM_HEAD, EXPERT_HEAD}))


@pytest.mark.parametrize("other", ["model.time_mlp_in.weight", "action_time_mlp_in.weight"])
def test_a_parameter_that_stands_there_twice_is_named(other):
    with pytest.raises(ValueError, match=r"file has time_mlp_in.weight twice, as .* and as "):
        find_parameters("file", [*NAMES, other])


def test_a_pi0_is_recognised():
    pi0 = [name.replace("norm.dense.", "norm.") for name in NAMES if not name.endswith("dense.bias")]
    pi0 = [name.replace("time_mlp", "action_time_mlp") for name in pi0] + ["state_proj.weight", "state_proj.bias"]
    with pytest.raises(ValueError, match=r"file is a π0, not a π0\.5"):
        find_parameters("file", pi0)
