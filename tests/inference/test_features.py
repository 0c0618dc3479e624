"""Network and runner have the same features: a feature that one of them gets and the other does not fails a test here.

A setting of the network needs an entry in `OTHER_VALUES`, an argument of `sample_actions` is an argument of the runner or in
`PLAIN_ONLY` with a reason, and a layer with a parameter that the runner does not know is refused. test_sampler.py compares the
effect of every parameter.
"""

import inspect
from dataclasses import fields, replace
from pathlib import Path
from typing import get_args

import pytest
import torch
from lerobot.configs import RTCAttentionSchedule
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.rtc.modeling_rtc import RTCProcessor

import lerobot_policy_pi05_geometry
from lerobot_policy_pi05_geometry.inference.sampler import PLAIN_ONLY, RUNNER_ARGUMENTS, ChunkSampler
from lerobot_policy_pi05_geometry.model import GeometrySegmentConfig, NetworkConfig, PI05Pytorch
from lerobot_policy_pi05_geometry.model.config import RtcMode
from lerobot_policy_pi05_geometry.model.norms import RMSNorm
from lerobot_policy_pi05_geometry.model.variants import EXPERT_VARIANTS, PALIGEMMA_VARIANTS
from tests.inference.chunks import draw, fast
from tests.model.helpers import Case, build_network, sample

TINY, TINY_EXPERT = PALIGEMMA_VARIANTS["tiny"], EXPERT_VARIANTS["tiny"]
# For every setting, a value that is not that of the other tests.
OTHER_VALUES = {
    "paligemma": replace(TINY, gemma=replace(TINY.gemma, mlp_dim=40)),
    "expert": replace(TINY_EXPERT, width=16, mlp_dim=40),
    "image_size": 42,
    "chunk_size": 7,
    "max_action_dim": 9,
    "num_inference_steps": 4,
    "min_period": 1e-2,
    "max_period": 2.0,
    "dtype": torch.bfloat16,
    "param_dtype": torch.bfloat16,
    "rtc_training_max_delay": 2,
}
OTHER_GEOMETRY = {
    "time": "denoise",
    "positions": "parallel",
    "placement": "prefix",
    "expert": "own",
    "openness": 0.3,
}


def assert_same(network: PI05Pytorch, **settings) -> None:
    """The runner serves, and its actions are the plain path's."""
    sampler = ChunkSampler(network.eval())
    assert sampler.prepare() is None
    batch = draw(network, Case(seed=3, batch=2, chunk=network.config.chunk_size))
    if network.config.image_size != 28:
        batch = batch._replace(images=[torch.randn(2, 3, *2 * (network.config.image_size,)) for _ in batch.images])
    if network.config.max_action_dim != batch.noise.shape[-1]:
        batch = batch._replace(noise=torch.randn(2, network.config.chunk_size, network.config.max_action_dim))
    given = {"num_steps": None} | settings
    expected, found = sample(network, batch, **given), fast(sampler, batch, **given)
    tolerance = 1e-6 if network.config.dtype == torch.float32 else 3e-2
    assert (expected - found).abs().max() <= tolerance * max(1.0, expected.abs().max())


@pytest.mark.parametrize("name", [field.name for field in fields(NetworkConfig) if field.name != "geometry"])
def test_every_setting_of_the_network(name: str) -> None:
    changes = {name: OTHER_VALUES[name]}
    if name == "param_dtype":
        changes["dtype"] = torch.bfloat16
    assert_same(build_network(seed=11, **changes))


@pytest.mark.parametrize("name", [field.name for field in fields(GeometrySegmentConfig)])
def test_every_setting_of_geometry(name: str) -> None:
    assert_same(build_network(GeometrySegmentConfig(**{name: OTHER_GEOMETRY[name]}), seed=12))


@pytest.mark.parametrize("schedule", list(RTCAttentionSchedule))
@pytest.mark.parametrize("mode", get_args(RtcMode))
def test_every_way_of_real_time_chunking(mode: RtcMode, schedule: RTCAttentionSchedule) -> None:
    network = build_network(seed=13, rtc_training_max_delay=3)
    network.rtc_processor, network.rtc_mode = RTCProcessor(RTCConfig(prefix_attention_schedule=schedule)), mode
    left_over = torch.randn(2, 4, 3)
    assert_same(network, inference_delay=2, prev_chunk_left_over=left_over, execution_horizon=3)


def test_every_argument() -> None:
    plain = set(inspect.signature(PI05Pytorch.sample_actions).parameters) - {"self"}
    assert plain | {"geometry"} == RUNNER_ARGUMENTS | set(PLAIN_ONLY)
    assert not RUNNER_ARGUMENTS & set(PLAIN_ONLY)


def test_a_layer_with_a_parameter_that_the_runner_does_not_know_is_refused() -> None:
    network = build_network(seed=14).eval()
    network.paligemma_with_expert.expert.layers[1].self_attn.q_norm = RMSNorm(8)
    assert ChunkSampler(network).prepare() == (
        "a layer has the parameter self_attn.q_norm.weight, which the runner does not know"
    )


def test_the_documentation_names_what_the_plain_path_serves() -> None:
    docs = Path(lerobot_policy_pi05_geometry.__file__).parents[2] / "docs" / "architecture.md"
    if not docs.exists():
        pytest.skip("installed without its documentation")
    text = docs.read_text()
    assert all(f"`{name}" in text for name in PLAIN_ONLY)
