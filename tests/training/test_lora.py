"""LoRA: what is adapted, what is trained in full, and that it is saved, resumed and folded in."""

import json
import re

import pytest
import torch

from lerobot_policy_pi05_geometry.checkpoint.load import load_policy
from lerobot_policy_pi05_geometry.checkpoint.merge import merge
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from lerobot_policy_pi05_geometry.training.lora import always_in_full, peft_targets
from tests.entry_points import chunk_of, make_batch, make_config, make_policy, make_processors

peft = pytest.importorskip("peft")


@pytest.fixture
def base(tmp_path):
    """A checkpoint to start from, with its processors."""
    policy = make_policy(lora_targets="expert+vlm")
    policy.save_pretrained(tmp_path / "base")
    return tmp_path / "base"


def wrapped(base, **overrides):
    """What lerobot-train makes of `--policy.path=base --peft.*`, in training mode."""
    config = make_config(**{"lora_targets": "expert+vlm", **overrides.pop("config", {})})
    config.pretrained_path = base
    policy = PI05GeometryPolicy.from_pretrained(base, config=config)
    return policy.wrap_with_peft(peft_cli_overrides={"r": 4, "method_type": "LORA", **overrides}).train()


def train(policy, steps: int) -> torch.optim.Optimizer:
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    for _ in range(steps):
        policy.forward(make_batch(3))[0].backward()
        optimizer.step()
        optimizer.zero_grad()
        policy.update()
    return optimizer


@pytest.mark.parametrize("targets", ["expert", "expert+vlm"])
@pytest.mark.parametrize("geometry_expert", ["shared", "own"])
def test_the_presets_adapt_every_matrix_of_a_transformer_that_is_read(targets, geometry_expert):
    """Those of the expert, or of the VLM too; not SigLIP's, and not what was frozen because nothing reads it."""
    policy = make_policy(lora_targets=targets, geometry_expert=geometry_expert)
    pattern = re.compile(peft_targets(policy.config)["target_modules"])
    found = {name for name, _ in policy.named_modules() if pattern.fullmatch(name)}
    models = ["gemma_expert.model", "geometry_expert"] + (["language_model"] if targets == "expert+vlm" else [])
    expected = {
        name
        for name, module in policy.named_modules()
        if name.endswith("_proj")
        and any(f"{model}.layers." in name for model in models)
        and all(p.requires_grad for p in module.parameters())
    }
    assert found == expected
    assert len({name.rsplit(".", 1)[1] for name in found}) == 7


def test_every_module_that_is_trained_in_full_is_there():
    for changes in ({}, {"geometry_source": "none"}, {"geometry_placement": "prefix"}, {"geometry_expert": "own"}):
        policy = make_policy(**changes)
        names = {name for name, _ in policy.named_modules()}
        assert set(peft_targets(policy.config)["modules_to_save"]) <= names
        new = {name for name in policy.new_parameters() if "geometry_expert" not in name}
        assert all(name.startswith(tuple(always_in_full(policy.config))) for name in new)


@pytest.mark.parametrize("given", [None, [], ["model.action_out_proj"]])
def test_adapter_and_gate_are_trained_whatever_is_asked_for(base, given):
    policy = wrapped(base, full_training_modules=given)
    trainable = {name for name, p in policy.named_parameters() if p.requires_grad}
    for part in ("geometry.adapter", "geometry_gate", "language_model", "gemma_expert"):
        assert any(part in name for name in trainable), part
    assert any("action_out_proj" in name for name in trainable) == (given != [])
    assert not any("vision_tower" in name for name in trainable)
    policy.forward(make_batch(3))[0].backward()
    assert {name for name, p in policy.named_parameters() if p.grad is not None} == trainable
    groups = policy.get_optim_params()
    assert [len(group["params"]) > 0 for group in groups] == [True, True, True]
    assert sum(len(group["params"]) for group in groups) == len(trainable)


def test_at_the_start_it_acts_as_its_base(base):
    policy = wrapped(base).eval()
    expected = PI05GeometryPolicy.from_pretrained(base, config=make_config())
    torch.testing.assert_close(chunk_of(policy, make_batch()), chunk_of(expected, make_batch()), atol=1e-6, rtol=1e-6)


def test_saved_reloaded_and_merged_it_acts_the_same(base, tmp_path):
    policy = wrapped(base, config={"optimizer_lr": 1e-3})
    train(policy, 3)
    saved, merged = tmp_path / "saved", tmp_path / "merged"
    policy.save_pretrained(saved)
    policy.config.save_pretrained(saved)
    for processor in make_processors(make_config()):
        processor.save_pretrained(saved)
    size = sum(file.stat().st_size for file in saved.glob("*.safetensors"))
    assert size < 0.7 * (base / "model.safetensors").stat().st_size

    batch = make_batch()
    actions = chunk_of(policy.eval(), batch)
    assert (actions - chunk_of(PI05GeometryPolicy.from_pretrained(base), batch)).abs().max() > 1e-3
    loaded = load_policy(saved).policy
    torch.testing.assert_close(chunk_of(loaded, batch), actions, atol=1e-5, rtol=1e-5)

    merge(saved, merged)
    again = load_policy(merged).policy
    assert not again.config.use_peft
    settings = json.loads((merged / "config.json").read_text())
    assert settings["device"] is None  # whoever loads it takes the best one there is
    assert settings["pretrained_path"] is None
    assert again.training_step == 3
    assert torch.equal(chunk_of(again, batch), chunk_of(loaded, batch))
    with pytest.raises(FileNotFoundError, match="was not trained with LoRA"):
        merge(merged, tmp_path / "twice")
    with pytest.raises(FileExistsError):
        merge(saved, merged)


def test_micro_batches_and_checkpointing_change_no_gradient(base):
    gradients = []
    for changes in ({}, {"micro_batch_size": 1, "gradient_checkpointing": True}):
        torch.manual_seed(0)
        policy = wrapped(base, config=changes)
        with torch.no_grad():
            for name, p in policy.named_parameters():
                if "lora_" in name:
                    p.copy_(0.1 * torch.randn(p.shape, generator=torch.Generator().manual_seed(len(name))))
        policy.forward(make_batch(3))[0].backward()
        gradients.append({name: p.grad for name, p in policy.named_parameters() if p.requires_grad})
    whole, parts = gradients
    for name, gradient in whole.items():
        torch.testing.assert_close(parts[name], gradient, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("reduction", ["mean", "none"])
def test_dropout_of_lora_is_drawn_once_however_often_a_layer_runs(base, reduction):
    """Checkpointing runs a layer again in the backward pass, and a loss per sample whole micro-batches."""
    gradients = []
    for again in (False, True):
        config = make_config(gradient_checkpointing=again, geometry_dropout=0.0, image_dropout=0.0)
        config.pretrained_path = base
        torch.manual_seed(5)  # of the adapters, and of the noise
        policy = PI05GeometryPolicy.from_pretrained(base, config=config)
        lora = peft.LoraConfig(
            r=4, lora_alpha=8, lora_dropout=0.2, init_lora_weights=False, **policy._get_default_peft_targets()
        )
        policy = policy.wrap_with_peft(peft_config=lora).train()
        torch.manual_seed(7)
        policy.forward(make_batch(2), reduction=reduction)[0].sum().backward()
        gradients.append({name: p.grad for name, p in policy.named_parameters() if p.grad is not None})
    whole, again = gradients
    for name, gradient in whole.items():
        torch.testing.assert_close(again[name], gradient, atol=1e-6, rtol=1e-4)


def test_micro_batches_of_a_loss_per_sample_draw_dropout_once(base):
    """The gradient is that of the losses that were returned: along it, they change as it says."""
    config = make_config(micro_batch_size=1, geometry_dropout=0.0, image_dropout=0.0)
    config.pretrained_path = base
    policy = PI05GeometryPolicy.from_pretrained(base, config=config)
    torch.manual_seed(5)
    lora = peft.LoraConfig(
        r=4, lora_alpha=8, lora_dropout=0.3, init_lora_weights=False, **policy._get_default_peft_targets()
    )
    policy = policy.wrap_with_peft(peft_config=lora).train()
    parameters = [p for name, p in policy.named_parameters() if p.requires_grad and "lora_" in name]

    def losses() -> torch.Tensor:
        torch.manual_seed(7)
        return policy.forward(make_batch(2), reduction="none")[0].double().sum()

    before = losses()
    gradients = torch.autograd.grad(before, parameters)
    square = sum(g.double().square().sum() for g in gradients)
    step = 1e-4 / square.sqrt()
    with torch.no_grad():
        for p, g in zip(parameters, gradients, strict=True):
            p -= step * g
    assert float((before - losses()) / (step * square)) == pytest.approx(1.0, abs=0.05)


def test_lora_from_scratch_is_refused():
    with pytest.raises(ValueError, match="from scratch"):
        make_policy().wrap_with_peft(peft_cli_overrides={"r": 4})
