"""The policy in training and on disk: losses, noise, parameter groups, checkpoints, and what it refuses."""

import copy
import math

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies import make_policy as lerobot_make_policy

from lerobot_policy_pi05_geometry import MetaworldRgbdEnv
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from tests.entry_points import (
    ACTION_DIM,
    CHUNK,
    FRONT,
    GEOMETRY,
    STATE,
    WRIST,
    chunk_of,
    make_batch,
    make_calibration,
    make_config,
    make_features,
    make_observation,
    make_policy,
    make_processors,
    redraw,
    without,
)

# --- loss ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("flow_samples", [1, 3])
def test_the_loss_is_a_number_that_every_trainable_parameter_gets_a_gradient_of(flow_samples):
    policy = make_policy(flow_samples=flow_samples, geometry_dropout=0.0, image_dropout=0.0).train()
    loss, info = policy.forward(make_batch(3))
    assert loss.shape == ()
    assert info["loss"] == pytest.approx(loss.item())
    assert len(info["loss_per_dim"]) == ACTION_DIM
    assert sum(info["loss_per_dim"]) / ACTION_DIM == pytest.approx(loss.item(), rel=1e-5)
    loss.backward()
    for name, parameter in policy.named_parameters():
        assert (parameter.grad is not None) == parameter.requires_grad, name


@pytest.mark.parametrize("flow_samples", [1, 3])
@pytest.mark.parametrize("padded", [False, True])
def test_per_sample_losses_have_the_mean_loss_as_their_mean(padded, flow_samples):
    policy, batch = make_policy(flow_samples=flow_samples).train(), make_batch(3)
    valid = torch.tensor([6, 6, 6])
    if padded:
        valid = torch.tensor([6, 1, 4])
        batch["action_is_pad"] = torch.arange(CHUNK)[None] >= valid[:, None]
    mean, _ = policy.forward(batch)
    each, info = policy.forward(batch, reduction="none")
    assert each.shape == (3,)
    # Every valid step of the batch counts once.
    torch.testing.assert_close((each * valid).sum() / valid.sum(), mean)
    assert info["loss"] == pytest.approx(mean.item())
    each.mean().backward()


@pytest.mark.parametrize("micro_batch_size", [None, 2])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_an_action_that_is_no_number_stops_before_a_gradient(bad, micro_batch_size):
    """One NaN in one frame turned every weight NaN, and the run went on to its end."""
    policy, batch = make_policy(micro_batch_size=micro_batch_size).train(), make_batch(3)
    batch["index"] = torch.tensor([11, 507, 12])
    batch["action"][1, 4, 2] = bad
    told = rf"action\[2\] is {bad}, 4 frames after the frame with dataset index 507"
    for reduction in ("mean", "none"):
        with pytest.raises(ValueError, match=told):
            policy.forward(batch, reduction=reduction)
    assert all(p.grad is None for p in policy.parameters())
    del batch["index"]
    with pytest.raises(ValueError, match=r"4 frames after sample 1 of the batch"):
        policy.forward(batch)


@pytest.mark.parametrize("micro_batch_size", [None, 2])
def test_a_loss_that_is_no_number_stops_too(micro_batch_size):
    """Whatever it comes from: here an image, of which only the first of an episode is checked."""
    policy, batch = make_policy(micro_batch_size=micro_batch_size), make_batch(3)  # no dropout of this camera
    policy.forward(batch)
    batch[FRONT][2] = math.nan
    with pytest.raises(FloatingPointError, match=rf"dataset index {batch['index'][2]} is not finite \(1 of 3 samples"):
        policy.forward(batch)


def test_a_sample_of_padding_alone_has_no_loss():
    policy, batch = make_policy().train(), make_batch(3)
    batch["action_is_pad"] = torch.zeros(3, CHUNK, dtype=torch.bool)
    batch["action_is_pad"][1] = True
    each, info = policy.forward(batch, reduction="none")
    assert each[1] == 0
    assert each[[0, 2]].gt(0).all()
    assert math.isfinite(info["loss"])
    batch["action_is_pad"][:] = True
    mean, info = policy.forward(batch)
    assert mean == 0 == info["loss"]
    mean.backward()
    assert all(p.grad.isfinite().all() for p in policy.parameters() if p.grad is not None)


@pytest.mark.parametrize("reduction", ["mean", "none"])
def test_padded_steps_count_if_they_are_to_be_supervised(reduction):
    batch = make_batch(2)
    batch["action_is_pad"] = torch.arange(CHUNK) >= torch.tensor([[CHUNK], [2]])
    supervised, masked = (
        make_policy(padded_actions=choice).train().forward(batch, reduction=reduction)[0]
        for choice in ("supervised", "masked")
    )
    everything, _ = make_policy().train().forward(without(batch, "action_is_pad"), reduction=reduction)
    assert torch.equal(supervised, everything)
    assert not torch.isclose(supervised.mean(), masked.mean())


def test_an_unknown_reduction_is_refused():
    with pytest.raises(ValueError, match="reduction must be 'mean' or 'none', got 'sum'"):
        make_policy().forward(make_batch(), reduction="sum")


@pytest.mark.parametrize("flow_samples", [1, 3])
def test_padded_action_steps_are_left_out(flow_samples):
    policy, batch = make_policy(flow_samples=flow_samples).train(), make_batch(2)
    batch["action_is_pad"] = torch.zeros(2, CHUNK, dtype=torch.bool)
    full, _ = policy.forward(batch, reduction="none")
    without_flag, _ = policy.forward(without(batch, "action_is_pad"), reduction="none")
    assert torch.equal(full, without_flag)
    batch["action_is_pad"][1, 4:] = True
    cut, _ = policy.forward(batch, reduction="none")
    assert torch.equal(cut[0], full[0])
    assert not torch.isclose(cut[1], full[1])


def test_what_stands_in_padded_action_steps_does_not_change_their_own_loss():
    """The suffix attends to itself, so noised padding is seen; its own error must not count."""
    policy, batch = make_policy().train(), make_batch(2)
    batch["action_is_pad"] = torch.arange(CHUNK)[None].repeat(2, 1) >= 4
    losses = []
    policy.model.register_forward_hook(lambda _m, _i, output: losses.append(output))
    mean, _ = policy.forward(batch)
    assert mean.item() == pytest.approx(losses[0][:, :4, :ACTION_DIM].mean().item())


def test_losses_of_dimensions_that_are_only_padding_are_left_out():
    """max_action_dim is 8, the action has 5."""
    policy, batch = make_policy().train(), make_batch(2)
    losses = []
    policy.model.register_forward_hook(lambda _m, _i, output: losses.append(output))
    mean, _ = policy.forward(batch)
    assert losses[0].shape == (2, CHUNK, 8)
    assert mean.item() == pytest.approx(losses[0][..., :ACTION_DIM].mean().item())


# --- noise, flow time and dropout are keyed -----------------------------------------------------------------------


def shuffled(batch: dict, order: list[int]) -> dict:
    return {
        key: value[order] if isinstance(value, torch.Tensor) else [value[i] for i in order]
        for key, value in batch.items()
    }


@pytest.mark.parametrize("training", [True, False])
def test_permuting_a_batch_permutes_its_losses(training):
    policy, batch, order = make_policy(geometry_dropout=0.5).train(training), make_batch(4), [2, 0, 3, 1]
    losses, _ = policy.forward(batch, reduction="none")
    permuted, _ = policy.forward(shuffled(batch, order), reduction="none")
    torch.testing.assert_close(permuted, losses[order])
    assert losses.unique().numel() == 4
    rekeyed, _ = policy.forward(batch | {"index": batch["index"] + 1}, reduction="none")
    assert (rekeyed - losses).abs().min() > 1e-3


def test_the_loss_does_not_depend_on_the_rest_of_the_batch():
    policy, batch = make_policy().train(), make_batch(3)
    together, _ = policy.forward(batch, reduction="none")
    for row in range(3):
        alone, _ = policy.forward(shuffled(batch, [row]), reduction="none")
        torch.testing.assert_close(alone[0], together[row])


def test_noise_changes_with_the_step_in_training_and_not_in_evaluation():
    policy, batch = make_policy(), make_batch()
    for training in (True, False):
        policy.train(training)
        before, _ = policy.forward(batch)
        assert torch.equal(policy.forward(batch)[0], before)  # and not with the call
        policy.update()
        assert torch.equal(policy.forward(batch)[0], before) != training


def test_evaluation_draws_other_noise_than_any_training_step():
    policy, batch = make_policy(geometry_dropout=0.0, image_dropout=0.0), make_batch()
    evaluated = policy.forward(batch)[0].item()
    policy.train()
    for _ in range(3):
        assert abs(policy.forward(batch)[0].item() - evaluated) > 1e-4
        policy.update()


def test_noise_depends_on_the_seed_of_the_run():
    losses = []
    for seed in (2**63 + 1, 2**63 + 2, 2**63 + 1):
        torch.manual_seed(seed)
        policy = redraw(PI05GeometryPolicy(make_config())).train()
        losses.append(policy.forward(make_batch())[0].item())
    assert losses[0] == losses[2] != losses[1]


def test_geometry_dropout_masks_whole_samples_in_training_only():
    batch = make_batch(16)
    pads = []

    def forward(dropout: float, training: bool) -> torch.Tensor:
        policy = make_policy(geometry_dropout=dropout, image_dropout=0.0).train(training)
        policy.model.register_forward_hook(lambda _m, inputs, _o: pads.append(inputs[8]))
        return policy.forward(batch, reduction="none")[0]

    open_loss, half_loss, masked_loss = (forward(dropout, True) for dropout in (0.0, 0.5, 0.999999))
    assert pads[0].any(dim=1).all()
    assert not pads[2].any()
    masked = ~pads[1].any(dim=1)
    assert 2 <= masked.sum() <= 14
    assert torch.equal(pads[1][~masked], pads[0][~masked])
    torch.testing.assert_close(half_loss[masked], masked_loss[masked])
    torch.testing.assert_close(half_loss[~masked], open_loss[~masked])
    assert (open_loss - masked_loss).abs().min() > 1e-4
    assert torch.equal(forward(0.999999, False), forward(0.0, False))


def test_a_sample_without_geometry_is_a_sample_of_the_plain_policy():
    plain = make_policy(geometry_source="none").train()
    policy = make_policy(geometry_dropout=0.999999, image_dropout=0.0).train()
    policy.load_state_dict(plain.state_dict(), strict=False)
    torch.testing.assert_close(policy.forward(make_batch())[0], plain.forward(make_batch())[0])


# --- the optimiser ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes", [{}, {"train_expert_only": True}, {"freeze_vision_encoder": True}, {"geometry_expert": "own"}]
)
def test_parameter_groups_hold_every_trainable_parameter_once(changes):
    policy = make_policy(geometry_lr=3e-4, geometry_gate_lr=7e-3, geometry_eps=1e-11, **changes)
    groups = policy.get_optim_params()
    names = {id(parameter): name for name, parameter in policy.named_parameters()}
    grouped = [[names[id(p)] for p in group["params"]] for group in groups]
    assert sorted(name for group in grouped for name in group) == sorted(
        n for n, p in policy.named_parameters() if p.requires_grad
    )
    assert set(grouped[1]) == {name for name in names.values() if name.startswith("geometry.")}
    assert set(grouped[2]) == {name for name in names.values() if "geometry_gate" in name}
    for group, own in zip(groups[1:], ({"lr": 3e-4}, {"lr": 7e-3, "name": "geometry_gate"}), strict=True):
        assert {k: v for k, v in group.items() if k != "params"} == own | {"eps": 1e-11, "weight_decay": 0.0}
    assert set(groups[0]) == {"params"}
    optimizer = policy.config.get_optimizer_preset().build(groups)
    assert [group["lr"] for group in optimizer.param_groups] == [2.5e-5, 3e-4, 7e-3]


def test_a_policy_without_geometry_has_one_group():
    policy = make_policy(geometry_source="none")
    assert len(policy.get_optim_params()) == 1
    assert not policy.new_parameters()


def test_an_optimiser_step_is_counted_and_measured():
    policy, batch = make_policy().train(), make_batch()
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    infos = []
    for step in range(3):
        assert policy.training_step.item() == step
        loss, info = policy.forward(batch)
        infos.append(info)
        loss.backward()
        before = torch.cat([p.detach().flatten() for p in policy.new_parameters().values()])
        optimizer.step()
        optimizer.zero_grad()
        policy.update()
    after = torch.cat([p.detach().flatten() for p in policy.new_parameters().values()])
    _, info = policy.forward(batch)
    assert info["geometry_update_pct"] == pytest.approx(
        100 * ((after - before).norm() / before.norm()).item(), rel=1e-4
    )
    assert 0 < info["geometry_update_pct"] < 10
    gate = policy.model.paligemma_with_expert.geometry_gate
    assert info["gate_openness_pct"] == pytest.approx(100 * gate.openness.abs().mean().item())
    assert "geometry_update_pct" not in infos[0]
    assert "geometry_update_pct" in infos[2]


# --- saving -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"dtype": "bfloat16", "param_dtype": "bfloat16"},
        {"geometry_source": "none"},
        {"geometry_source": "random"},
        {"geometry_expert": "own", "geometry_positions": "parallel"},
        {"geometry_placement": "prefix", "geometry_frame": "camera"},
        {"geometry_cameras": ["wrist"]},
    ],
    ids=lambda changes: "-".join(map(str, changes.values())) or "default",
)
def test_a_saved_policy_acts_as_before_bit_for_bit(tmp_path, changes):
    policy, batch = make_policy(**changes), make_batch()
    policy.update()
    policy.save_pretrained(tmp_path)
    loaded = PI05GeometryPolicy.from_pretrained(tmp_path)
    assert not loaded.training
    assert loaded.training_step.item() == 1
    assert loaded.config == policy.config
    for (name, expected), (found_name, found) in zip(
        policy.state_dict().items(), loaded.state_dict().items(), strict=True
    ):
        assert name == found_name
        assert found.dtype == expected.dtype, name
        assert torch.equal(found, expected), name
    assert {n: p.requires_grad for n, p in loaded.named_parameters()} == {
        n: p.requires_grad for n, p in policy.named_parameters()
    }
    assert torch.equal(chunk_of(loaded, batch), chunk_of(policy, batch))
    loss, _ = loaded.train().forward(batch)  # and it can be trained on
    loss.backward()


@pytest.mark.parametrize("changes", [{}, {"dtype": "bfloat16", "param_dtype": "bfloat16"}], ids=["float32", "bfloat16"])
def test_a_policy_that_has_acted_is_saved_as_it_was_before(tmp_path, changes):
    """As lerobot-train does it: evaluate, then save, then train on. The runner joins weights in larger matrices."""
    policy, batch = make_policy(**changes), make_batch()
    policy.save_pretrained(tmp_path / "before")
    chunk = chunk_of(policy, batch)
    policy.save_pretrained(tmp_path / "after")
    policy.train()
    policy.save_pretrained(tmp_path / "trained")
    files = [(tmp_path / name / "model.safetensors").read_bytes() for name in ("before", "after", "trained")]
    assert files[0] == files[1] == files[2]
    assert torch.equal(chunk_of(PI05GeometryPolicy.from_pretrained(tmp_path / "after"), batch), chunk)


def test_what_must_stay_float32_does():
    policy = make_policy(dtype="bfloat16", param_dtype="bfloat16")
    dtypes = {name: parameter.dtype for name, parameter in policy.named_parameters()}
    for name in policy.new_parameters():
        assert dtypes[name] == torch.float32, name
    assert dtypes["model.action_out_proj.weight"] == torch.float32
    assert torch.bfloat16 in dtypes.values()


def test_the_calibration_travels_in_the_checkpoint(tmp_path):
    policy, batch = make_policy(), make_batch()
    calibration = make_calibration()
    calibration["front"].extrinsics[0][3] += 0.3
    moved = make_policy(calibration=calibration)
    moved.save_pretrained(tmp_path)
    loaded = PI05GeometryPolicy.from_pretrained(tmp_path)
    assert torch.equal(chunk_of(loaded, batch), chunk_of(moved, batch))
    assert not torch.allclose(chunk_of(loaded, batch), chunk_of(policy, batch))


def test_loading_leaves_the_given_configuration_on_its_device(tmp_path):
    make_policy().save_pretrained(tmp_path)
    config = make_config()
    config.device = "cpu:0"
    assert PI05GeometryPolicy.from_pretrained(tmp_path, config=config).config.device == "cpu:0"


# --- shapes -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("state_dim", [1, 7, 32, 40])
def test_any_state_width_goes_through_the_prompt(state_dim):
    inputs, outputs = make_features()
    inputs[STATE] = PolicyFeature(FeatureType.STATE, (state_dim,))
    config = make_config(input_features=inputs, output_features=outputs, normalization_mapping={})
    preprocessor, _ = make_processors(config)
    policy = redraw(PI05GeometryPolicy(config)).eval()
    batch = preprocessor(make_observation() | {STATE: torch.linspace(-1, 1, state_dim).repeat(2, 1)})
    assert f"State: {' '.join(['0'] * (state_dim == 1))}" in batch["task"][0]
    assert len(batch["task"][0].split("State: ")[1].split(";")[0].split()) == state_dim
    assert policy.predict_action_chunk(batch).shape == (2, CHUNK, ACTION_DIM)


@pytest.mark.parametrize(("action_dim", "max_action_dim"), [(1, 8), (5, 5), (5, 32)])
def test_any_action_width_up_to_the_largest(action_dim, max_action_dim):
    inputs, outputs = make_features()
    outputs["action"] = PolicyFeature(FeatureType.ACTION, (action_dim,))
    policy = make_policy(input_features=inputs, output_features=outputs, max_action_dim=max_action_dim)
    batch = make_batch() | {"action": torch.randn(2, CHUNK, action_dim)}
    policy.train().forward(batch)[0].backward()
    assert policy.predict_action_chunk(batch).shape == (2, CHUNK, action_dim)


# --- images -------------------------------------------------------------------------------------------------------


def test_uint8_and_channel_last_images_equal_float_channel_first():
    policy, batch = make_policy(), make_batch()
    batch[FRONT] = (255 * batch[FRONT]).round() / 255
    expected = chunk_of(policy, batch)
    as_bytes = (255 * batch[FRONT]).round().to(torch.uint8)
    for image in (as_bytes, batch[FRONT].permute(0, 2, 3, 1), as_bytes.permute(0, 2, 3, 1), batch[FRONT].double()):
        torch.testing.assert_close(chunk_of(policy, batch | {FRONT: image}), expected, atol=1e-5, rtol=1e-5)


def test_every_camera_matters():
    policy, batch = make_policy(), make_batch()
    for key in (FRONT, WRIST):
        assert (chunk_of(policy, batch | {key: 1 - batch[key]}) - chunk_of(policy, batch)).abs().max() > 1e-4, key


def test_a_missing_rgb_camera_is_refused():
    for policy in (make_policy(), make_policy(absent_cameras=[FRONT])):
        with pytest.raises(ValueError, match=rf"no image {WRIST}; connect the camera.*--policy.absent_cameras"):
            policy.predict_action_chunk(without(make_batch(), WRIST))
        with pytest.raises(ValueError, match=rf"no image {WRIST}"):
            policy.train().forward(without(make_batch(), WRIST))


def test_a_camera_that_may_be_absent_is_left_out_of_attention():
    policy, batch = make_policy(absent_cameras=[WRIST]), make_batch()
    absent = chunk_of(policy, without(batch, WRIST))
    policy.train().forward(without(batch, WRIST))[0].backward()
    assert (absent - chunk_of(policy, batch)).abs().max() > 1e-4
    black = chunk_of(policy, batch | {WRIST: torch.zeros_like(batch[WRIST])})
    assert (absent - black).abs().max() > 1e-4


def test_empty_cameras_change_nothing():
    """They stand for cameras that a checkpoint was made for and this robot has not."""
    expected = chunk_of(make_policy(), make_batch())
    with_empty = make_policy(empty_cameras=2)
    assert len(with_empty.config.image_features) == 4
    torch.testing.assert_close(chunk_of(with_empty, make_batch()), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("changes", [{}, {"empty_cameras": 1}, {"absent_cameras": [WRIST]}])
def test_lerobot_builds_policies_with_cameras_that_the_data_lacks(changes):
    """LeRobot compares the RGB cameras of a policy with those of the data, where depth is among them."""
    inputs, outputs = make_features()
    config = make_config(input_features=inputs, output_features=outputs, geometry_cameras=["front"], **changes)
    if "absent_cameras" not in changes:
        del config.input_features[WRIST]
    assert isinstance(lerobot_make_policy(config, env_cfg=MetaworldRgbdEnv()), PI05GeometryPolicy)


@pytest.mark.parametrize("shape", [(2, 1, 30, 40), (2, 4, 30, 40), (3, 30, 40), (2, 30, 40)])
def test_an_image_that_is_not_rgb_is_refused(shape):
    with pytest.raises(ValueError, match=rf"{FRONT} must be RGB images \(B, 3, H, W\), got shape"):
        make_policy().predict_action_chunk(make_batch() | {FRONT: torch.rand(shape)})


# --- sources ------------------------------------------------------------------------------------------------------


def test_without_geometry_depth_is_not_looked_at():
    policy, batch = make_policy(geometry_source="none"), make_batch()
    assert policy.geometry is None
    assert torch.equal(chunk_of(policy, without(batch, *GEOMETRY)), chunk_of(policy, batch))
    policy.train().forward(batch)[0].backward()


def test_random_tokens_take_as_much_room_and_look_at_nothing():
    policy, batch = make_policy(geometry_source="random"), make_batch()
    assert policy.geometry.source.num_tokens == make_policy().geometry.source.num_tokens
    assert torch.equal(chunk_of(policy, without(batch, *GEOMETRY)), chunk_of(policy, batch))
    plain = make_policy(geometry_source="none")
    plain.load_state_dict({k: v for k, v in policy.state_dict().items() if k in plain.state_dict()})
    assert (chunk_of(plain, batch) - chunk_of(policy, batch)).abs().max() > 1e-4
    policy.train().forward(batch)[0].backward()


@pytest.mark.parametrize("empty_cameras", [0, 1])
def test_a_blind_policy_trains_and_acts(empty_cameras):
    _, outputs = make_features()
    features = {"input_features": {STATE: PolicyFeature(FeatureType.STATE, (7,))}, "output_features": outputs}
    policy = make_policy(**features, geometry_source="none", empty_cameras=empty_cameras).train()
    batch = without(make_batch(), FRONT, WRIST, *GEOMETRY)
    policy.forward(batch)[0].backward()
    for name, parameter in policy.named_parameters():
        assert (parameter.grad is not None) == parameter.requires_grad, name
    assert chunk_of(policy, batch).shape == (2, CHUNK, ACTION_DIM)


def test_random_tokens_of_no_camera_are_refused():
    """They would be no tokens, and the gate would wait for a gradient that never comes."""
    _, outputs = make_features()
    inputs = {STATE: PolicyFeature(FeatureType.STATE, (7,))}
    with pytest.raises(ValueError, match="geometry_source=random"):
        make_policy(input_features=inputs, output_features=outputs, geometry_source="random")


def test_a_policy_may_see_by_depth_alone():
    inputs, outputs = make_features()
    inputs = {key: feature for key, feature in inputs.items() if key not in (FRONT, WRIST)}
    policy, batch = (
        make_policy(input_features=inputs, output_features=outputs).train(),
        without(make_batch(), FRONT, WRIST),
    )
    policy.forward(batch)[0].backward()
    for name, parameter in policy.named_parameters():
        assert (parameter.grad is not None) == parameter.requires_grad, name
    assert chunk_of(policy, batch).shape == (2, CHUNK, ACTION_DIM)


def test_depth_cameras_need_depth_in_the_data():
    inputs, outputs = make_features()
    inputs = {key: feature for key, feature in inputs.items() if key not in GEOMETRY}
    with pytest.raises(ValueError, match=r"geometry_source=rgbd needs depth.*geometry_source=none"):
        make_policy(input_features=inputs, output_features=outputs)


def test_depth_cameras_need_extrinsics_in_the_base_frame():
    calibration = make_calibration()
    calibration["front"].extrinsics = None
    with pytest.raises(
        ValueError, match=r"'front' has no extrinsics.*calibration.front.extrinsics.*geometry_frame=camera"
    ):
        make_policy(calibration=calibration)
    make_policy(calibration=calibration, geometry_frame="camera")


def test_depth_cameras_need_intrinsics():
    calibration = make_calibration()
    del calibration["wrist"]
    with pytest.raises(ValueError, match=r"Camera 'wrist' has no intrinsics \(the calibration has front\)"):
        make_policy(calibration=calibration)
    assert make_policy(calibration=calibration, geometry_cameras=["front"]).geometry.source.cameras == ("front",)
    calibration["wrist"] = copy.deepcopy(calibration["front"])
    calibration["wrist"].intrinsics[0] = 0.0
    with pytest.raises(ValueError, match=r"Intrinsics of camera 'wrist' are singular"):
        make_policy(calibration=calibration)


@pytest.mark.parametrize("runner", ["fast", "plain"])
def test_a_policy_that_is_loaded_in_inference_mode_acts_and_can_be_trained(runner, tmp_path):
    policy = make_policy()
    policy.save_pretrained(tmp_path)
    noise = torch.randn(1, CHUNK, 8)
    with torch.inference_mode():
        loaded = PI05GeometryPolicy.from_pretrained(tmp_path)
        chunk = loaded.predict_action_chunk(make_batch(1), noise=noise, runner=runner)
    torch.testing.assert_close(chunk, policy.predict_action_chunk(make_batch(1), noise=noise), atol=1e-5, rtol=1e-5)
    loaded.train()
    loaded(make_batch(1))[0].backward()


@pytest.mark.parametrize(
    "changed",
    [
        {"geometry_frame": "camera"},
        {"geometry_cameras": ["wrist", "front"]},
        {"geometry_source": "random"},
        {"geometry_positions": "parallel"},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_what_trained_geometry_means_stays(changed, tmp_path):
    """A new policy may still be given other geometry; a trained one would misread it."""
    policy = make_policy()
    policy.save_pretrained(tmp_path / "new")
    policy.training_step.fill_(5)
    policy.save_pretrained(tmp_path / "trained")

    def load(name: str) -> PI05GeometryPolicy:
        config = PreTrainedConfig.from_pretrained(tmp_path / name)
        for key, value in changed.items():
            setattr(config, key, value)
        return PI05GeometryPolicy.from_pretrained(tmp_path / name, config=config)

    load("new")
    name = next(iter(changed))
    with pytest.raises(ValueError, match=rf"was trained with {name}=.*pi05-geometry convert"):
        load("trained")
