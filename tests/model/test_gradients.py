"""Invariant 11: who gets a gradient; and gradient checkpointing, which must change nothing but memory."""

from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from lerobot_policy_pi05_geometry.model import GeometrySegmentConfig, PI05Pytorch
from lerobot_policy_pi05_geometry.model.gemma import GemmaLayer

from .helpers import EVERY_GEOMETRY, IN_PREFIX, OWN_EXPERT, SEGMENT, Batch, Case, build_network, name_of

TRAINABLE = {
    "all": {},
    "no vision": {"freeze_vision_encoder": True},
    "expert only": {"train_expert_only": True},
    "both": {"train_expert_only": True, "freeze_vision_encoder": True},
}
# Positions move no gradient to or from a parameter, so one rule is enough.
SETTINGS = [None, *(geometry for geometry in EVERY_GEOMETRY if geometry.positions == "parallel")]
every_geometry = pytest.mark.parametrize("geometry", SETTINGS, ids=name_of)
every_freeze = pytest.mark.parametrize("frozen", TRAINABLE.values(), ids=TRAINABLE.keys())

VISION_KEY_BIAS = "self_attn.k_proj.bias"


def trainable_network(geometry: GeometrySegmentConfig | None, frozen: dict[str, bool]) -> tuple[PI05Pytorch, Batch]:
    """A network in training mode, and a batch in which every kind of token occurs."""
    network = build_network(geometry)
    network.paligemma_with_expert.set_trainable(**frozen)
    batch = Case(seed=1, batch=2, cameras=2, grid=2).draw(network.geometry_width)
    batch = batch._replace(img_masks=[torch.ones_like(mask) for mask in batch.img_masks])
    return network.train(), batch.without_geometry if geometry is None else batch


def is_read(name: str) -> bool:
    """False for a bias of SigLIP's keys: it shifts all logits of a query alike, which softmax does not notice."""
    return not ("vision_tower" in name and name.endswith(VISION_KEY_BIAS))


@every_geometry
@every_freeze
def test_gradients_reach_what_is_trainable(geometry: GeometrySegmentConfig | None, frozen: dict[str, bool]) -> None:
    """Invariant 11: every trainable parameter gets a gradient, not zero; no frozen one gets any."""
    network, batch = trainable_network(geometry, frozen)
    network(*batch).mean().backward()
    parameters = dict(network.named_parameters())
    assert [n for n, p in parameters.items() if p.requires_grad and p.grad is None] == []
    assert [n for n, p in parameters.items() if not p.requires_grad and p.grad is not None] == []
    assert [n for n, p in parameters.items() if p.requires_grad and is_read(n) and not p.grad.any()] == []
    assert all(p.grad.isfinite().all() for p in parameters.values() if p.grad is not None)


@every_geometry
def test_only_the_unread_end_is_frozen(geometry: GeometrySegmentConfig | None) -> None:
    """What feeds nothing is frozen, and that alone: the last layer's query, output and MLP, and the final norm."""
    network = build_network(geometry)
    models = ["paligemma.model.language_model"]
    if geometry is not None and geometry.placement == "segment" and geometry.expert == "own":
        models.append("geometry_expert")
    unread = ("self_attn.q_proj", "self_attn.o_proj", "mlp", "post_attention_layernorm")
    prefixes = tuple(
        f"paligemma_with_expert.{model}.{part}."
        for model in models
        for part in ("norm", *(f"layers.2.{module}" for module in unread))
    )
    frozen = {name for name, p in network.named_parameters() if not p.requires_grad}
    assert frozen == {name for name, _ in network.named_parameters() if name.startswith(prefixes)}


def test_what_is_frozen_is_not_read() -> None:
    """Changing every frozen parameter changes nothing: freezing them costs nothing."""
    network, batch = trainable_network(OWN_EXPERT, {})
    before = network(*batch)
    with torch.no_grad():
        for parameter in network.parameters():
            if not parameter.requires_grad:
                parameter.fill_(1e3)
    assert torch.equal(network(*batch), before)


@pytest.mark.parametrize("geometry", [None, SEGMENT, OWN_EXPERT, IN_PREFIX], ids=name_of)
@pytest.mark.parametrize("frozen", [TRAINABLE["all"], TRAINABLE["expert only"]], ids=["all", "expert only"])
def test_every_entry_of_the_gate_and_of_geometry_gets_a_gradient(
    geometry: GeometrySegmentConfig | None, frozen: dict[str, bool]
) -> None:
    """Each layer's and head's gate, and each token of the adapter, also where the VLM is frozen."""
    network, batch = trainable_network(geometry, frozen)
    if geometry is None:
        assert network.paligemma_with_expert.geometry_gate is None
        return
    tokens = batch.geom_embs.requires_grad_()
    network(*batch).mean().backward()
    assert tokens.grad[batch.geom_pad].abs().amax(dim=-1).min() > 0
    gate = network.paligemma_with_expert.geometry_gate
    assert (gate is None) == (geometry.placement == "prefix")
    assert gate is None or gate.openness.grad.abs().min() > 0


# --- DDP --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def process_group(tmp_path: Path):
    dist.init_process_group("gloo", init_method=f"file://{tmp_path / 'rendezvous'}", rank=0, world_size=1)
    yield
    dist.destroy_process_group()


@pytest.mark.usefixtures("process_group")
@pytest.mark.parametrize(
    ("geometry", "frozen", "checkpointing"),
    [
        (None, {}, False),
        (SEGMENT, {}, False),
        (SEGMENT, TRAINABLE["expert only"], False),
        (SEGMENT, {}, True),
        (OWN_EXPERT, {}, False),
        (OWN_EXPERT, TRAINABLE["no vision"], True),
        (IN_PREFIX, {}, False),
        (IN_PREFIX, TRAINABLE["expert only"], False),
    ],
)
def test_ddp_without_unused_parameters(
    geometry: GeometrySegmentConfig | None, frozen: dict[str, bool], checkpointing: bool
) -> None:
    """Invariant 11: DDP raises in the second step if it waited in the first for a parameter without a gradient."""
    network, batch = trainable_network(geometry, frozen)
    if checkpointing:
        network.gradient_checkpointing_enable()
    wrapped = DistributedDataParallel(network, find_unused_parameters=False)
    optimizer = torch.optim.SGD([p for p in network.parameters() if p.requires_grad], lr=0.1)
    losses = []
    for _ in range(2):
        loss = wrapped(*batch).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[1] < losses[0]


# --- gradient checkpointing -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("geometry", [None, SEGMENT, OWN_EXPERT, IN_PREFIX], ids=name_of)
def test_checkpointing_changes_no_number(geometry: GeometrySegmentConfig | None) -> None:
    """The same loss and the same gradients, bit for bit."""
    results = []
    for checkpointing in (False, True):
        network, batch = trainable_network(geometry, {})
        if checkpointing:
            network.gradient_checkpointing_enable()
        loss = network(*batch)
        loss.mean().backward()
        results.append((loss, {name: p.grad for name, p in network.named_parameters() if p.grad is not None}))
    (loss, gradients), (again, recomputed) = results
    assert torch.equal(loss, again)
    assert gradients.keys() == recomputed.keys()
    assert all(torch.equal(gradients[name], recomputed[name]) for name in gradients)


@pytest.mark.parametrize("checkpointing", [False, True], ids=["plain", "checkpointing"])
@pytest.mark.parametrize("geometry", [None, SEGMENT, OWN_EXPERT], ids=name_of)
def test_a_layer_runs_twice_under_checkpointing(geometry: GeometrySegmentConfig | None, checkpointing: bool) -> None:
    """Each layer runs once per segment forward and once more backward (LeRobot's runs three times), SigLIP's too."""
    network, batch = trainable_network(geometry, {})
    if checkpointing:
        network.gradient_checkpointing_enable()
    inner = network.paligemma_with_expert
    vision_layers = list(inner.paligemma.model.vision_tower.vision_model.encoder.layers)
    runs: dict[nn.Module, int] = {}

    def count(module: nn.Module, args: tuple) -> None:
        runs[module] = runs.get(module, 0) + 1

    for module in network.modules():
        if isinstance(module, GemmaLayer) or module in vision_layers:
            module.register_forward_pre_hook(count)
    network(*batch).mean().backward()
    times = 2 if checkpointing else 1
    segments_of_the_expert = 2 if geometry == SEGMENT else 1
    expected = dict.fromkeys([*vision_layers, *inner.language_model.layers], times)
    expected |= dict.fromkeys(inner.expert.layers, times * segments_of_the_expert)
    if inner.geometry_expert is not None:
        expected |= dict.fromkeys(inner.geometry_expert.layers, times)
    assert runs == expected


def test_checkpointing_is_for_training() -> None:
    """In evaluation mode nothing is recomputed."""
    network, batch = trainable_network(SEGMENT, {})
    network.gradient_checkpointing_enable()
    network.eval()
    calls = []
    for layer in network.paligemma_with_expert.language_model.layers:
        layer.register_forward_pre_hook(lambda module, args: calls.append(module))
    network(*batch).mean().backward()
    assert len(calls) == 3
