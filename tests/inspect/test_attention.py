"""What is drawn is what the network did."""

import numpy as np
import pytest
import torch

from lerobot_policy_pi05_geometry.inspect.attention import attention_layout, suffix_attention
from lerobot_policy_pi05_geometry.inspect.pictures import depth_figure, layout_figure, segment_share_figure
from tests.entry_points import CHUNK, FRONT_DEPTH, make_batch, make_calibration, make_policy


@pytest.fixture
def policy():
    return make_policy()


def test_attention_is_a_distribution_that_leaves_out_holes(policy):
    batch = make_batch(2)
    attention = suffix_attention(policy, batch)
    assert torch.allclose(attention.weights.sum(dim=1), torch.ones(2), atol=1e-5)
    prefix, geometry, suffix = attention.lengths
    assert (geometry, suffix) == (policy.geometry.source.num_tokens, CHUNK)
    _, pad = policy.geometry(batch)
    assert (attention.weights[:, prefix : prefix + geometry][~pad] == 0).all()
    assert (attention.weights[:, prefix : prefix + geometry][pad] > 0).all()


def test_a_shut_gate_takes_the_attention_from_geometry(policy):
    policy.model.paligemma_with_expert.geometry_gate.openness.data.fill_(0.0)
    attention = suffix_attention(policy, make_batch(2))
    prefix, geometry, _ = attention.lengths
    assert attention.weights[:, prefix : prefix + geometry].sum() < 1e-4


def test_looking_changes_nothing_and_leaves_no_hook(policy):
    batch, noise = make_batch(2), torch.randn(2, CHUNK, 8)
    before = policy.predict_action_chunk(batch, noise=noise)
    suffix_attention(policy, batch)
    attention_layout(policy, batch)
    assert torch.equal(policy.predict_action_chunk(batch, noise=noise), before)
    assert not any(module._forward_pre_hooks for module in policy.modules())


def test_the_layout_is_block_triangular(policy):
    mask, (prefix, geometry, suffix) = attention_layout(policy, make_batch(2))
    assert mask.shape == (prefix + geometry + suffix,) * 2
    assert not mask[:prefix, prefix:].any()
    assert not mask[: prefix + geometry, prefix + geometry :].any()
    assert mask[-1, -suffix:].all()


@pytest.mark.parametrize("source", ["rgbd", "none"])
def test_figures_are_drawn(source):
    policy, batch = make_policy(geometry_source=source), make_batch(1)
    figures = [layout_figure(policy, batch), segment_share_figure(policy, batch)]
    if source == "rgbd":
        figures.append(depth_figure(policy, batch))
    assert all(figure.axes for figure in figures)


def test_depth_is_shown_as_the_policy_reads_it():
    """A D405 counts tenths of millimetres, and a codec that takes its counts for millimetres ends at 5 m here."""
    calibration = make_calibration()
    calibration["front"].depth_scale = 1e-4
    policy = make_policy(calibration=calibration, geometry_cameras=["front"], depth_bounds={"front": [0.01, 5.0]})
    batch = make_batch(1)
    batch[FRONT_DEPTH] = torch.full((1, 1, 18, 24), 3000.0)
    batch[FRONT_DEPTH][..., 12:] = 10000.0
    shown = np.ma.filled(depth_figure(policy, batch).axes[1].images[0].get_array(), np.nan)
    np.testing.assert_allclose(shown[:, :12], 0.3, atol=1e-6)
    assert np.isnan(shown[:, 12:]).all()
