"""Real-time chunking in the network: guidance by LeRobot's definition, and hard prefixes in training and sampling."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.rtc.modeling_rtc import RTCProcessor

from lerobot_policy_pi05_geometry.model.real_time_chunking import make_guidance
from tests.model.helpers import (
    EVERY_GEOMETRY,
    SEGMENT,
    Case,
    build_network,
    distance,
    name_of,
    recorded_outputs,
    sample,
    shared_network,
)

CONFIGURATIONS = [None, *EVERY_GEOMETRY]


@given(
    seed=st.integers(0, 999),
    time=st.floats(0.01, 1.0),
    delay=st.integers(0, 7),
    horizon=st.integers(1, 9),
    left=st.integers(1, 6),
    maximum=st.floats(0.1, 20.0),
)
@settings(max_examples=60, deadline=None)
def test_guidance_is_lerobots(seed: int, time: float, delay: int, horizon: int, left: int, maximum: float) -> None:
    """One step, for any velocity, time, delay, horizon and left-over chunk."""
    generator = torch.Generator().manual_seed(seed)
    x_t, velocity = (torch.randn(2, 6, 4, generator=generator) for _ in range(2))
    left_over = torch.randn(2, left, 3, generator=generator)
    processor = RTCProcessor(RTCConfig(max_guidance_weight=maximum, execution_horizon=4))
    expected = processor.denoise_step(x_t, left_over, delay, time, lambda x: velocity, horizon)
    found = make_guidance(processor, left_over, delay, horizon, x_t).correct(velocity, x_t, time, maximum)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5 * maximum)


@pytest.mark.parametrize("geometry", CONFIGURATIONS, ids=name_of)
def test_without_a_delay_the_loss_is_that_of_ordinary_training(geometry) -> None:
    network = shared_network(geometry)
    batch = Case(seed=1, batch=3).draw(network.geometry_width)
    if geometry is None:
        batch = batch.without_geometry
    assert distance(network(*batch, delay=torch.zeros(3, dtype=torch.int64)), network(*batch)) < 1e-5


def test_a_hard_prefix_is_clean_and_at_flow_time_0() -> None:
    """The embedded actions and conditions, step by step, as LeRobot's main branch has them."""
    network, delay = shared_network(SEGMENT), torch.tensor([0, 2, 4])
    batch = Case(seed=2, batch=3).draw(network.geometry_width)
    given: list = []
    handle = network.action_in_proj.register_forward_pre_hook(lambda module, args: given.append(args[0]))
    norm = network.paligemma_with_expert.expert.norm
    conditions = norm.dense.register_forward_pre_hook(lambda module, args: given.append(args[0]))
    network(*batch, delay=delay)
    handle.remove()
    conditions.remove()
    x_t, cond = given
    for row, steps in enumerate(delay.tolist()):
        noisy = batch.time[row] * batch.noise[row] + (1 - batch.time[row]) * batch.actions[row]
        assert torch.equal(x_t[row, :steps], batch.actions[row, :steps])
        torch.testing.assert_close(x_t[row, steps:], noisy[steps:])
        times = torch.cat([torch.zeros(steps), batch.time[row].expand(5 - steps)])
        torch.testing.assert_close(cond[row], network.embed_time(times), rtol=0, atol=1e-6)


@pytest.mark.parametrize("geometry", CONFIGURATIONS, ids=name_of)
def test_flow_samples_have_the_prefix_of_their_observation(geometry) -> None:
    """K samples at once equal K passes."""
    network = shared_network(geometry)
    batch, delay = Case(seed=3, batch=2).draw(network.geometry_width), torch.tensor([1, 3])
    if geometry is None:
        batch = batch.without_geometry
    noise, time = torch.randn(2, 3, 5, 6), torch.rand(2, 3)
    together = network(*batch._replace(noise=noise, time=time), delay=delay)
    for k in range(3):
        alone = network(*batch._replace(noise=noise[:, k], time=time[:, k]), delay=delay)
        torch.testing.assert_close(together[:, k], alone, atol=1e-5, rtol=1e-6)  # squared errors reach 30


def test_sampling_gives_the_network_what_training_gave_it() -> None:
    """At every step: the clean prefix, flow time 0 for it, and the flow time for the others."""
    network = build_network(SEGMENT, seed=4, rtc_training_max_delay=3).eval()
    network.rtc_processor, network.rtc_mode = RTCProcessor(RTCConfig()), "trained"
    batch, left_over = Case(seed=4, batch=2).draw(network.geometry_width), torch.randn(2, 4, 3)
    with recorded_outputs([network.action_out_proj]) as velocities:
        actions = sample(network, batch, prev_chunk_left_over=left_over, inference_delay=2)
    assert torch.equal(actions[:, :2, :3], left_over[:, :2])
    assert not actions[:, :2, 3:].any()  # dimensions beyond the action's are padded with zeros, as in training
    x_t = batch.noise
    for step, velocity in enumerate(velocities):
        time = torch.full((2,), 1 - step / 3)
        # x_t = t noise + (1 - t) actions, so with these actions, and noise that gives x_t at t, training sees the same.
        clean = torch.cat([actions[:, :2], torch.zeros(2, 3, 6)], dim=1)
        seen = batch._replace(actions=clean, noise=x_t / time[:, None, None], time=time)
        with recorded_outputs([network.action_out_proj]) as trained:
            network(*seen, delay=torch.tensor([2, 2]))
        assert distance(trained[0][:, 2:], velocity[:, 2:]) < 1e-4
        x_t = x_t - velocity / 3


def test_a_wrong_prefix_would_be_found() -> None:
    """The comparisons above can fail: a hard prefix changes the loss of the steps behind it."""
    network = shared_network(SEGMENT)
    batch = Case(seed=5, batch=1).draw(network.geometry_width)
    one, two = (network(*batch, delay=torch.tensor([steps])) for steps in (1, 2))
    assert distance(one[:, 2:], two[:, 2:]) > 1e-3
