"""Training for trained real-time chunking: a hard prefix of random length is given clean, and is no target."""

import pytest
import torch

from tests.entry_points import ACTION_DIM, CHUNK, make_batch, make_policy

MAX_DELAY = 4


def policy_with_prefixes(**changes):
    return make_policy(rtc_training_max_delay=MAX_DELAY, geometry_dropout=0.0, image_dropout=0.0, **changes).train()


def prefixed(policy, batch) -> torch.Tensor:
    """Delays of the batch's samples, as the policy draws them."""
    return policy._draw(batch, torch.Size((len(batch["action"]), CHUNK, 8))).delay


@pytest.mark.parametrize("flow_samples", [1, 3])
@pytest.mark.parametrize("micro_batch_size", [None, 3])
def test_the_loss_is_that_of_the_steps_behind_the_prefix(flow_samples, micro_batch_size, monkeypatch):
    """And the network is told the prefix, whatever the batch is split into."""
    policy, batch = policy_with_prefixes(flow_samples=flow_samples), make_batch(8)
    policy.config.micro_batch_size = micro_batch_size
    seen = []
    policy.model.register_forward_hook(
        lambda module, args, kwargs, output: seen.append((kwargs["delay"], output)), with_kwargs=True
    )
    with torch.no_grad():
        each, _ = policy.forward(batch, reduction="none")
        mean, info = policy.forward(batch)
    delay, losses = (torch.cat(parts) for parts in zip(*seen[: len(seen) // 2], strict=True))
    assert torch.equal(delay, prefixed(policy, batch))
    assert len(delay.unique()) > 2
    losses = losses[..., :ACTION_DIM]
    losses = losses.mean(dim=1) if flow_samples > 1 else losses
    for row, steps in enumerate(delay.tolist()):
        assert each[row].item() == pytest.approx(losses[row, steps:].mean().item(), rel=1e-5)
    targets = torch.arange(CHUNK) >= delay[:, None]
    assert mean.item() == pytest.approx(losses[targets].mean().item(), rel=1e-5) == info["loss"]


def test_one_valid_step_remains_a_target():
    """At the end of an episode, whatever was drawn."""
    policy, batch = policy_with_prefixes(), make_batch(8)
    batch["action_is_pad"] = torch.arange(CHUNK)[None].expand(8, -1) >= 2
    each, _ = policy.forward(batch, reduction="none")
    assert each.isfinite().all()
    assert (each > 0).all()


def test_without_it_no_prefix_is_given():
    policy, batch = make_policy().train(), make_batch(2)
    seen = []
    policy.model.register_forward_pre_hook(lambda module, args, kwargs: seen.append(kwargs["delay"]), with_kwargs=True)
    policy.forward(batch)
    assert seen == [None]
