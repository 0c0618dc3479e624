"""Low-rank adapters, counted."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_policy_pi05_geometry.planner.lora import LoraPlan, lora_layers, lora_parameters
from lerobot_policy_pi05_geometry.planner.workload import FakePolicy, Load
from tests.doors import make_config

LOAD = Load(4, prompt_tokens=5)
NEW = ("geometry.", "geometry_gate")


def trained(planned: FakePolicy) -> dict[str, int]:
    return {name: p.numel() for name, p in planned.policy.named_parameters() if p.requires_grad}


@given(st.integers(1, 12), st.sampled_from(["expert", "all"]), st.sampled_from(["shared", "own"]))
def test_the_count_is_that_of_the_adapters_laid(rank, target, expert):
    plan = LoraPlan(rank, target)
    planned, plain = (FakePolicy(make_config(geometry_expert=expert), lora) for lora in (plan, None))
    adapters = {name: count for name, count in trained(planned).items() if "lora_" in name}
    assert sum(adapters.values()) == lora_parameters(plain.policy, plan)
    others = set(trained(planned)) - set(adapters)
    assert others
    assert all(any(part in name for part in NEW) for name in others)
    assert planned.weights() - plain.weights() == 4 * sum(adapters.values())
    assert planned.resident(LOAD).gradients < plain.resident(LOAD).gradients


def test_which_layers():
    policy = FakePolicy(make_config()).policy
    expert, everything = (lora_layers(policy, target) for target in ("expert", "all"))
    depth = 3
    assert len(expert) == 7 * depth
    assert len(everything) == 2 * 7 * depth
    assert not any("vision" in name or "lora" in name for name in everything)


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_all_remembers_more_than_the_expert(dtype):
    expert, everything = (
        FakePolicy(make_config(dtype=dtype), LoraPlan(4, target)).training(LOAD) for target in ("expert", "all")
    )
    assert 0 < expert.optimiser < everything.optimiser
    assert expert.activations < everything.activations
