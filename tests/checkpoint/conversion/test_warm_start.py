"""Invariant 9: a converted policy acts as the π0.5 it came from, and then learns."""

import pytest
import torch

from lerobot_policy_pi05_geometry.checkpoint.conversion import GeometryStart, convert
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from tests.entry_points import CHUNK, FRONT_DEPTH, STATE, WRIST, WRIST_DEPTH, chunk_of, make_batch, make_calibration

from .sources import DATASET_FEATURES, lerobot_chunk, lerobot_policy, load_on, write_openpi


@pytest.fixture(scope="module", params=[(3, "shared", "base"), (8, "own", "base"), (14, "shared", "camera")], ids=str)
def policy(request, lerobot_source, calibration, tmp_path_factory) -> PI05GeometryPolicy:
    grid, expert, frame = request.param
    output = tmp_path_factory.mktemp("warm") / "output"
    geometry = GeometryStart("rgbd", ("front", "wrist"), calibration, grid=grid, expert=expert, frame=frame)
    convert(lerobot_source, output, geometry)
    return load_on(output)


def distance(policy: PI05GeometryPolicy, batch) -> float:
    return (chunk_of(policy, batch) - lerobot_chunk(lerobot_policy(), batch)).abs().max().item()


@pytest.mark.parametrize("seed", range(4))
def test_actions_are_the_sources(policy, seed):
    """Within 1e-3 with geometry, of actions up to 4; an open gate shows that the geometry is there to be seen."""
    batch = make_batch(1 + seed % 3, seed)
    assert distance(policy, batch) < 1e-3
    gate = policy.model.paligemma_with_expert.geometry_gate.openness
    closed = gate.detach().clone()
    try:
        gate.data.fill_(1.0)
        assert distance(policy, batch) > 1e-2
    finally:
        gate.data.copy_(closed)


@pytest.mark.parametrize("seed", range(4))
def test_actions_with_geometry_masked_are_the_sources_exactly(policy, seed):
    batch = make_batch(1 + seed % 3, seed)
    holes = {key: torch.zeros_like(batch[key]) for key in (FRONT_DEPTH, WRIST_DEPTH)}
    gate = policy.model.paligemma_with_expert.geometry_gate.openness
    closed = gate.detach().clone()
    try:
        gate.data.fill_(1.0)  # it is the mask, not the gate
        assert distance(policy, batch | holes) < 1e-5
    finally:
        gate.data.copy_(closed)


@pytest.mark.parametrize("source", ["none", "random", "rgbd"])
def test_before_any_data_it_acts_as_its_source(source, lerobot_source, tmp_path, caplog):
    convert(lerobot_source, tmp_path / "output", GeometryStart(source=source))
    policy = PI05GeometryPolicy.from_pretrained(tmp_path / "output")
    assert distance(policy, make_batch(2)) < (1e-3 if source == "random" else 1e-5)
    said = "has not been trained on data with its geometry cameras yet"
    assert caplog.text.count(said) == (source == "rgbd")
    distance(policy, make_batch(2))
    assert caplog.text.count(said) == (source == "rgbd")
    assert "delivers no geometry" not in caplog.text  # no camera has failed
    if source == "rgbd":
        with pytest.raises(ValueError, match="learns its geometry cameras from a dataset"):
            policy.train().forward(make_batch(2))


def test_an_openpi_checkpoint_acts_the_same(tmp_path, two_cameras):
    convert(write_openpi(tmp_path / "source"), tmp_path / "output", two_cameras)
    batch = make_batch(2)
    policy = load_on(tmp_path / "output", input_features=dict(lerobot_policy().config.input_features),
                     output_features=dict(lerobot_policy().config.output_features), num_inference_steps=3)  # fmt: skip
    assert distance(policy, batch) < 1e-3


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_one_training_step_moves_the_gate_and_the_adapter(converted, dtype):
    policy = load_on(converted, dtype=dtype, geometry_dropout=0.0, image_dropout=0.0).train()
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    before = {name: p.detach().clone() for name, p in policy.new_parameters().items()}
    loss, _ = policy.forward(make_batch(4))
    loss.backward()
    optimizer.step()
    for name, parameter in policy.new_parameters().items():
        moved = (parameter.detach() - before[name]).abs()
        rate = policy.config.geometry_gate_lr if "gate" in name else policy.config.geometry_lr
        # Adam's first step is the rate wherever eps does not matter: a shut gate hides no gradient from it.
        assert moved.median() == pytest.approx(rate, rel=0.05), name


# --- the data names the cameras ---------------------------------------------------------------------------------------


def depth_of(*names: str) -> dict:
    return {f"observation.images.{n}_depth": DATASET_FEATURES[FRONT_DEPTH] for n in names} | {
        STATE: DATASET_FEATURES[STATE]
    }


def test_one_camera_is_whichever_the_data_has(lerobot_source, tmp_path):
    convert(lerobot_source, tmp_path / "output", GeometryStart(frame="camera"))
    policy = load_on(tmp_path / "output", depth_of("anything"), calibration={"anything": make_calibration()["front"]})
    assert policy.geometry.source.cameras == ("anything",)
    assert policy.config.geometry_pending == 0
    policy.save_pretrained(tmp_path / "trained")
    again = PI05GeometryPolicy.from_pretrained(tmp_path / "trained")
    assert again.geometry.source.cameras == ("anything",)
    assert again.config.geometry_features == policy.config.geometry_features


@pytest.mark.parametrize(
    ("cameras", "data", "said"),
    [
        (None, ("a", "b"), "from 1 camera(s), but the data has depth from 2: a,b; convert again with --geometry-cameras a,b"),
        (("a", "c"), ("a", "b"), "geometry_cameras names c, but the data has depth from a, b only"),
    ],
)  # fmt: skip
def test_cameras_that_do_not_match_are_named(cameras, data, said, lerobot_source, tmp_path):
    convert(lerobot_source, tmp_path / "output", GeometryStart(cameras=cameras))
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        load_on(tmp_path / "output", depth_of(*data))
    assert said in str(caught.value)


def test_data_without_depth_is_an_error(lerobot_source, tmp_path):
    """Silently training without geometry would be worse."""
    convert(lerobot_source, tmp_path / "output")
    config = load_on(tmp_path / "output", {}).config
    with pytest.raises(ValueError, match="geometry_source=rgbd needs depth"):
        PI05GeometryPolicy.from_pretrained(tmp_path / "output", config=config, dataset_meta=object())


def test_a_converted_checkpoint_keeps_its_features_or_takes_the_datas(lerobot_source, tmp_path):
    for name, from_data in (("kept", False), ("open", True)):
        convert(lerobot_source, tmp_path / name, features_from_data=from_data)
        policy = PI05GeometryPolicy.from_pretrained(tmp_path / name)
        assert (WRIST in policy.config.input_features) is not from_data


@pytest.mark.parametrize("reduction", ["mean", "none"])
def test_the_loss_is_the_sources_with_padding_too(reduction, lerobot_source, tmp_path, monkeypatch):
    """LeRobot's π0.5 supervises the steps after an episode's end, and so does what was converted from it."""
    convert(lerobot_source, tmp_path / "output", GeometryStart(source="none"))
    ours = PI05GeometryPolicy.from_pretrained(tmp_path / "output").train()
    theirs = lerobot_policy()
    batch = make_batch(3)
    batch["action_is_pad"] = torch.arange(CHUNK) >= torch.tensor([[CHUNK], [2], [1]])
    draw = ours._draw(batch, torch.Size((3, CHUNK, 8)))
    monkeypatch.setattr(theirs.model, "sample_noise", lambda *_: draw.noise)
    monkeypatch.setattr(theirs.model, "sample_time", lambda *_: draw.time)
    expected, told = theirs.forward(batch, reduction=reduction)
    found, info = ours.forward(batch, reduction=reduction)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)
    assert info["loss"] == pytest.approx(told["loss"], abs=1e-5)
    ours.config.padded_actions = "masked"
    assert not torch.allclose(ours.forward(batch, reduction=reduction)[0], expected, atol=1e-3)
