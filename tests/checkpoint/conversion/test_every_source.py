"""Invariant 9 with every geometry source, from LeRobot's and openpi's layout, with processors and statistics."""

import json
from pathlib import Path

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME

from lerobot_policy_pi05_geometry.checkpoint.conversion import GeometryStart, convert
from lerobot_policy_pi05_geometry.checkpoint.conversion.settings import make_config
from lerobot_policy_pi05_geometry.checkpoint.conversion.start import inherited_shapes, meta_policy, start_values
from lerobot_policy_pi05_geometry.geometry.da3.weights import backbone_hash
from lerobot_policy_pi05_geometry.geometry.source import GeometryFeatures
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from tests.entry_points import chunk_of, make_batch, make_observation
from tests.geometry.da3.tiny import write_tiny

from .sources import (
    lerobot_chunk,
    lerobot_pipelines,
    lerobot_policy,
    load_on,
    noise_of,
    write_openpi,
)

SOURCES = ("none", "rgbd", "da3", "features", "random")


@pytest.fixture(scope="session")
def encoder(tmp_path_factory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("encoders") / "DA3-TINY" / "model.safetensors").parent


def start_with(source: str, encoder: Path, calibration: Path, **changes) -> GeometryStart:
    settings = {
        "rgbd": {"cameras": ("front", "wrist"), "calibration": calibration},
        "random": {"cameras": ("front", "wrist")},
        "none": {},
    }.get(source, {"encoder": str(encoder)})
    grid = {} if source == "none" else {"grid": 3}
    return GeometryStart(source, **{**grid, **settings, **changes})


def lerobot_features() -> dict:
    """Inputs and outputs of a dataset, for a checkpoint that has none."""
    config = lerobot_policy().config
    return {
        "input_features": dict(config.input_features),
        "output_features": dict(config.output_features),
        "num_inference_steps": 3,
    }


def open_gate(policy: PI05GeometryPolicy) -> None:
    gate = policy.model.paligemma_with_expert.geometry_gate
    if gate is not None:
        gate.openness.data.fill_(1.0)


def mask_geometry(policy: PI05GeometryPolicy) -> None:
    """As if no camera measured anything."""
    if policy.geometry is None:
        return
    measure = policy.geometry.source.forward

    def nothing(batch, check=True):
        found = measure(batch, check)
        return GeometryFeatures(found.features, torch.zeros_like(found.valid))

    policy.geometry.source.forward = nothing


@pytest.mark.parametrize("layout", ["lerobot", "openpi"])
@pytest.mark.parametrize("source", SOURCES)
def test_a_converted_policy_acts_as_its_source(source, layout, lerobot_source, encoder, calibration, tmp_path) -> None:
    """Within 1e-3, and within 1e-5 with geometry masked; an open gate shows that geometry is there to be seen."""
    openpi = layout == "openpi"
    pi05 = write_openpi(tmp_path / "source") if openpi else lerobot_source
    start = start_with(
        source, encoder, calibration, cameras=("front", "wrist") if openpi and source != "none" else None
    )
    if not openpi:
        start = start_with(source, encoder, calibration)
    convert(pi05, tmp_path / "output", start)
    policy = load_on(tmp_path / "output", **lerobot_features() if openpi else {})
    assert policy.config.geometry_source == source
    if source in ("da3", "features"):
        assert policy.config.da3_hash == backbone_hash(encoder / "model.safetensors")
        assert policy.geometry.source.cameras == ("front", "wrist")
    batch = make_batch(2, seed=1)
    expected = lerobot_chunk(lerobot_policy(), batch)
    assert (chunk_of(policy, batch) - expected).abs().max() < 1e-3
    open_gate(policy)
    if source != "none":
        assert (chunk_of(policy, batch) - expected).abs().max() > 1e-2
    mask_geometry(policy)
    assert (chunk_of(policy, batch) - expected).abs().max() < 1e-5


@pytest.mark.parametrize("source", SOURCES)
def test_from_raw_observation_to_action_with_both_processors(
    source, lerobot_source, encoder, calibration, tmp_path
) -> None:
    """Prompt, tokens, statistics of state and action: what a robot gets is what LeRobot's π0.5 gives it."""
    output = tmp_path / "output"
    convert(lerobot_source, output, start_with(source, encoder, calibration))
    theirs, ours = lerobot_policy(), load_on(output)
    before, after = lerobot_pipelines(theirs, tmp_path / "tokenizer")
    pipelines = make_pre_post_processors(
        policy_cfg=ours.config,
        pretrained_path=str(output),
        preprocessor_overrides={"device_processor": {"device": "cpu"}},
    )
    raw = make_observation(2, seed=5)
    their_batch = before(dict(raw))
    expected = after(lerobot_chunk(theirs, their_batch))
    our_batch = pipelines[0](dict(raw))
    actions = pipelines[1](ours.predict_action_chunk(our_batch, noise=noise_of(our_batch)))
    assert actions.shape == expected.shape
    assert (actions - expected).abs().max() < 1e-3 * max(1.0, expected.abs().max().item())
    assert {path.name for path in output.glob("*normalizer*.safetensors")}
    for name in (POLICY_PREPROCESSOR_DEFAULT_NAME, POLICY_POSTPROCESSOR_DEFAULT_NAME):
        assert (output / f"{name}.json").is_file()


@pytest.mark.parametrize("source", ["da3", "features"])
def test_the_data_names_the_cameras_that_depth_anything_looks_through(
    source, lerobot_source, encoder, tmp_path
) -> None:
    """With --features-from-data, and as an openpi checkpoint: until then it acts without geometry."""
    start = GeometryStart(source, cameras=("wrist", "front"), encoder=str(encoder), grid=3)
    convert(lerobot_source, tmp_path / "output", start, features_from_data=True)
    config = PreTrainedConfig.from_pretrained(tmp_path / "output")
    assert (config.geometry_pending, config.input_features) == (2, {})
    waiting = load_on(tmp_path / "output", features={})
    assert waiting.geometry.source.num_tokens == 18
    policy = load_on(tmp_path / "output", **lerobot_features())
    assert policy.geometry.source.cameras == ("wrist", "front")
    assert policy.config.geometry_pending == 0
    convert(lerobot_source, tmp_path / "one", GeometryStart(source, encoder=str(encoder)), features_from_data=True)
    with pytest.raises(ValueError, match=r"from 1 camera\(s\), but the data has RGB images from 2: front,wrist"):
        load_on(tmp_path / "one", **lerobot_features())


@pytest.mark.parametrize(
    ("start", "said"),
    [
        (GeometryStart("depth"), "--geometry-source must be one of none, rgbd, da3, features, random"),
        (GeometryStart("rgbd", encoder="somewhere"), "--da3-encoder belongs to --geometry-source=da3 or features"),
        (GeometryStart("da3", encoder="/nowhere"), "The Depth Anything 3 encoder is not found"),
        (GeometryStart("random", calibration=Path("x")), "--calibration has no meaning"),
        (GeometryStart("none", grid=4, openness=1.0), "--geometry-grid, --geometry-gate-openness has no meaning"),
        (GeometryStart("none", cameras=("front",)), "--geometry-cameras has no meaning"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_options_that_do_not_fit_are_named(start, said, lerobot_source, tmp_path) -> None:
    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        convert(lerobot_source, tmp_path / "output", start)
    assert said in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_camera_that_the_source_does_not_have_is_named(lerobot_source, encoder, tmp_path) -> None:
    with pytest.raises(ValueError, match="geometry_cameras names top, but the data has RGB images from front, wrist"):
        convert(lerobot_source, tmp_path / "output", GeometryStart("da3", cameras=("top",), encoder=str(encoder)))


@pytest.mark.parametrize("source", SOURCES)
def test_names_and_shapes_at_the_released_size(source, encoder) -> None:
    """On the meta device: what is new is complete, and what is π0.5's is the same whatever the source."""
    images = {
        f"observation.images.{name}": {"type": "VISUAL", "shape": [3, 224, 224]} for name in ("base", "left", "right")
    }
    start = GeometryStart(source, encoder=str(encoder) if source in ("da3", "features") else None)
    carried = {"paligemma_variant": "gemma_2b", "action_expert_variant": "gemma_300m", "input_features": images}
    policy = meta_policy(make_config(carried | start.settings(has_images=True), "the source"))
    inherited = inherited_shapes(policy)
    assert len(inherited) == 811  # LeRobot's, without its two lm_heads (tests/model/test_names.py)
    new = start_values(policy, {}, seed=0)
    found = {name: tuple(tensor.shape) for name, tensor in policy.state_dict().items()}
    assert found == inherited | {name: tuple(tensor.shape) for name, tensor in new.items()}
    if source != "none":
        views = {"rgbd": 1, "random": 1}.get(source, 3)
        assert found["geometry.adapter.view"] == (views, 1024)
        assert found["geometry.adapter.row"] == (8, 1024)


# --- how weights are stored -------------------------------------------------------------------------------------------


def in_bf16(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: tensor.bfloat16() for name, tensor in tensors.items()}


@pytest.mark.parametrize(("dtype", "stays"), [("bfloat16", True), ("float32", False)])
def test_weights_in_bfloat16_stay_so_in_memory(dtype, stays, tmp_path, caplog) -> None:
    """Where the source computes in it; else LeRobot widens them too, and it is said that memory doubles."""
    from .sources import write_lerobot

    convert(write_lerobot(tmp_path / "source", in_bf16, dtype=dtype), tmp_path / "output", GeometryStart("none"))
    config = json.loads((tmp_path / "output" / "config.json").read_text())
    assert (config["dtype"], config["param_dtype"]) == (dtype, dtype)
    policy = load_on(tmp_path / "output")
    matrix = policy.model.paligemma_with_expert.expert.layers[0].mlp.up_proj.weight
    assert matrix.dtype == (torch.bfloat16 if stays else torch.float32)
    assert ("take twice the memory once loaded" in caplog.text) is not stays


def test_openpi_in_bfloat16_stays_so(tmp_path) -> None:
    convert(write_openpi(tmp_path / "source", in_bf16), tmp_path / "output", GeometryStart("none"))
    config = json.loads((tmp_path / "output" / "config.json").read_text())
    assert (config["dtype"], config["param_dtype"]) == ("bfloat16", "bfloat16")


def test_float32_weights_are_float32(converted) -> None:
    config = json.loads((converted / "config.json").read_text())
    assert (config["dtype"], config["param_dtype"]) == ("float32", "float32")
