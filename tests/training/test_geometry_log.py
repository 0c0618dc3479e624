"""The losses of samples without geometry and without images, as training logs them."""

import math

import pytest
import torch

from lerobot_policy_pi05_geometry.training.geometry_log import MEMORY, WITHOUT, GeometryLog

from ..entry_points import make_batch, make_policy

RATES = {"geometry_dropout": 0.4, "image_dropout": 0.4}


@pytest.mark.parametrize(
    "changes", [{}, {"micro_batch_size": 3}, {"flow_samples": 2, "padded_actions": "masked"}], ids=str
)
def test_they_are_the_means_of_those_samples(changes) -> None:
    """Which samples went without is decided by the draw: geometry below its rate, images above 1 minus theirs."""
    policy, batch = make_policy(**RATES, **changes).train(), make_batch(16)
    u = policy._draw(batch, torch.Size((16, batch["action"].shape[1], policy.config.max_action_dim))).dropout
    _, info = policy.forward(batch)
    losses, _ = policy.forward(batch, reduction="none")
    groups = u < 0.4, u >= 0.6
    assert all(4 <= group.sum() <= 10 for group in groups)
    for name, group in zip(WITHOUT, groups, strict=True):
        assert info[name] == pytest.approx(losses[group].mean().item(), rel=1e-5)


def test_they_are_running_means_over_the_batches_that_have_such_samples() -> None:
    log = GeometryLog(make_policy().model.paligemma_with_expert, 0)
    neither, geometry = torch.tensor([[False, False]] * 2), torch.tensor([[True, False], [False, False]])
    log.went_without(torch.tensor([1.0, 2.0]), neither)
    assert not set(WITHOUT) & set(log.numbers())
    log.went_without(torch.tensor([1.0, 2.0]), geometry)
    log.went_without(torch.tensor([5.0, 7.0]), neither)
    log.went_without(torch.tensor([3.0, math.inf]), torch.tensor([[True, False], [True, False]]) & geometry)
    found = log.numbers()
    assert found[WITHOUT[0]] == pytest.approx(MEMORY * 1.0 + (1 - MEMORY) * 3.0)
    assert WITHOUT[1] not in found


def test_a_policy_may_be_moved_between_two_steps() -> None:
    """The running means follow: here to a device without values."""
    log = GeometryLog(make_policy().model.paligemma_with_expert, 0)
    of_geometry = torch.tensor([[True, False]])
    log.went_without(torch.tensor([1.0]), of_geometry)
    log.went_without(torch.tensor([1.0], device="meta"), of_geometry.to("meta"))
    assert log._without.device.type == "meta"


@pytest.mark.parametrize("changes", [{"geometry_source": "none"}, {"geometry_dropout": 0.0, "image_dropout": 0.0}])
def test_without_such_samples_there_are_none(changes) -> None:
    policy, batch = make_policy(**changes), make_batch(4)
    assert not set(WITHOUT) & set(policy.train().forward(batch)[1])


def test_evaluation_takes_nothing_from_a_sample() -> None:
    policy, batch = make_policy(**RATES), make_batch(16)
    assert not set(WITHOUT) & set(policy.eval().forward(batch)[1])
