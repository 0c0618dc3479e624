"""The share of the actions' attention that geometry gets, as training logs it, against attention written out."""

import pytest
import torch

from lerobot_policy_pi05_geometry.model.attention import attention_weights

from ..entry_points import make_batch, make_policy


def reference(policy, batch) -> float:
    """From what every layer's attention is given in a forward pass of its own."""
    policy.config.micro_batch_size = None
    network, shares = policy.model.paligemma_with_expert, {}
    tokens = policy.geometry.source.num_tokens

    def hook(index):
        def look(_, inputs):
            q, k, _v, mask, bias = inputs
            if bias is not None:
                weights = attention_weights(q, k, mask, bias)  # (B, H, Q, K)
                start = k.shape[2] - q.shape[2] - tokens
                with_geometry = mask[..., start : start + tokens].flatten(1).any(dim=1)
                shares[index] = weights[with_geometry][..., start : start + tokens].sum(dim=-1).mean()

        return look

    layers = network.expert.layers
    handles = [layer.self_attn.attention.register_forward_pre_hook(hook(i)) for i, layer in enumerate(layers)]
    with torch.no_grad():
        policy.forward(batch)
    for handle in handles:
        handle.remove()
    measured = {0, len(layers) // 2, len(layers) - 1}
    return 100 * torch.stack([shares[i] for i in measured]).mean().item()


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"micro_batch_size": 1},
        {"flow_samples": 3},
        {"gradient_checkpointing": True},
        {"geometry_expert": "own", "geometry_positions": "parallel"},
    ],
    ids=str,
)
def test_share_is_what_attention_gives(changes) -> None:
    policy, batch = make_policy(geometry_dropout=0.3, **changes).train(), make_batch(3)
    loss, info = policy.forward(batch)
    loss.backward()
    assert info["geometry_attention_pct"] == pytest.approx(reference(policy, batch), rel=1e-3)
    assert not any(module._forward_pre_hooks for module in policy.modules())


def test_it_follows_the_gate() -> None:
    policy, batch = make_policy(geometry_dropout=0.0).train(), make_batch(2)
    gate = policy.model.paligemma_with_expert.geometry_gate.openness
    found = []
    for openness in (1e-7, 0.1, 10.0):
        gate.data.fill_(openness)
        found.append(policy.forward(batch)[1]["geometry_attention_pct"])
    assert 0 < found[0] < 1e-3 < found[1] < found[2] < 100


def test_it_is_measured_now_and_then_and_changes_nothing() -> None:
    """The steps between repeat the last number; the loss is what it is without a look."""
    policy, batch = make_policy().train(), make_batch(2)
    loss, info = policy.forward(batch)
    policy.update()
    policy.model.paligemma_with_expert.geometry_gate.openness.data.fill_(5.0)
    assert policy.forward(batch)[1]["geometry_attention_pct"] == info["geometry_attention_pct"]
    other = make_policy().train()
    other.geometry_log._tokens = 0
    assert torch.equal(other.forward(batch)[0], loss)


@pytest.mark.parametrize("changes", [{"geometry_source": "none"}, {"geometry_placement": "prefix"}])
def test_without_a_gate_there_is_none(changes) -> None:
    _, info = make_policy(**changes).train().forward(make_batch(2))
    assert not {"geometry_attention_pct", "gate_openness_pct"} & set(info)
