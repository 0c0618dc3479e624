"""The configuration: what moves out of LeRobot's features, what is saved, and what is refused."""

import dataclasses
import json

import draccus
import pytest
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.utils.feature_utils import dataset_to_policy_features

from lerobot_policy_pi05_geometry import PI05GeometryConfig
from lerobot_policy_pi05_geometry.geometry.keys import is_geometry_key
from lerobot_policy_pi05_geometry.model.ablations import AblationSettings
from lerobot_policy_pi05_geometry.model.variants import EXPERT_VARIANTS, PALIGEMMA_VARIANTS
from tests.entry_points import FRONT, FRONT_DEPTH, STATE, WRIST, WRIST_DEPTH, WRIST_POSE, make_calibration, make_config

VISUAL = FeatureType.VISUAL


def one_sentence(error: BaseException) -> str:
    message = str(error)
    assert "\n" not in message
    assert message.endswith(".")
    return message


# --- features -----------------------------------------------------------------------------------------------------


def test_depth_and_calibration_leave_the_input_features():
    config = make_config()
    config.validate_features()
    assert set(config.input_features) == {FRONT, WRIST, STATE}
    assert set(config.image_features) == {FRONT, WRIST}
    assert config.robot_state_feature.shape == (7,)
    assert set(config.geometry_features) == {FRONT_DEPTH, WRIST_DEPTH, WRIST_POSE}


def test_validating_twice_changes_nothing():
    config = make_config(empty_cameras=2)
    config.validate_features()
    before = draccus.encode(config)
    config.validate_features()
    assert draccus.encode(config) == before


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        (FRONT_DEPTH, True),
        (WRIST_POSE, True),
        ("observation.calibration.front.intrinsics", True),
        (FRONT, False),
        (STATE, False),
        ("observation.images.depth_of_field", False),
        ("observation.state_depth", False),
        ("action", False),
    ],
)
def test_which_keys_are_geometry(key, expected):
    assert is_geometry_key(key) == expected


def test_missing_features_are_completed():
    config = make_config(input_features={}, output_features={}, empty_cameras=1)
    config.validate_features()
    assert config.input_features[STATE].shape == (32,)
    assert config.action_feature.shape == (8,)
    assert config.image_features["observation.images.empty_camera_0"].shape == (3, 28, 28)
    assert config.may_be_absent("observation.images.empty_camera_0")


def test_features_may_be_none():
    config = make_config(input_features=None, output_features=None)
    config.validate_features()
    assert set(config.input_features) == {STATE}


def test_only_named_cameras_may_be_absent():
    config = make_config(absent_cameras=[WRIST])
    assert config.may_be_absent(WRIST)
    assert not config.may_be_absent(FRONT)


def test_more_action_dimensions_than_the_network_has_are_refused():
    config = make_config(output_features={"action": PolicyFeature(FeatureType.ACTION, (9,))})
    with pytest.raises(ValueError, match=r"9 action dimensions, but max_action_dim is 8") as caught:
        config.validate_features()
    one_sentence(caught.value)


# --- depth cameras ------------------------------------------------------------------------------------------------


def test_depth_cameras_are_sorted_unless_they_are_named():
    config = make_config()
    config.validate_features()
    assert list(config.depth_cameras().items()) == [("front", (18, 24)), ("wrist", (12, 12))]
    config.geometry_cameras = ["wrist", "front"]
    assert list(config.depth_cameras()) == ["wrist", "front"]
    config.geometry_cameras = ["wrist"]
    assert config.depth_cameras() == {"wrist": (12, 12)}


def test_an_unknown_depth_camera_is_refused():
    config = make_config(geometry_cameras=["wrist", "back"])
    config.validate_features()
    with pytest.raises(ValueError, match=r"geometry_cameras names back, but the data has depth from front, wrist"):
        config.depth_cameras()
    config = make_config(geometry_cameras=["front"], input_features={})
    config.validate_features()
    with pytest.raises(ValueError, match=r"depth from no camera only"):
        config.depth_cameras()


# --- what a dataset says ------------------------------------------------------------------------------------------


def depth_feature(flag: str) -> dict:
    return {"dtype": "image", "shape": (8, 8, 1), "names": ["height", "width", "channels"], "info": {flag: True}}


def rgb_feature() -> dict:
    return {"dtype": "image", "shape": (8, 8, 3), "names": ["height", "width", "channels"], "info": None}


def found_in(features: dict, **changes) -> PI05GeometryConfig:
    """A fresh configuration after LeRobot's `make_policy` has told it a dataset's features."""
    config = make_config(input_features=dataset_to_policy_features(features), **changes)
    config.set_dataset_feature_metadata(features)
    config.validate_features()
    return config


@pytest.mark.parametrize("flag", ["is_depth_map", "video.is_depth_map"])
@pytest.mark.parametrize(
    ("key", "camera"),
    [
        ("observation.images.depth.front", "front"),
        ("observation.depth_front", "front"),
        ("observation.images.front.depth", "front"),
        ("observation.front_depth", "front"),
        ("observation.images.front_range", "front_range"),
        ("observation.depth", "depth"),
        (FRONT_DEPTH, "front"),
        ("observation.images.my_depth_cam_depth", "my_depth_cam"),
    ],
)
def test_a_depth_map_is_found_by_its_flag_whatever_its_name(flag, key, camera):
    config = found_in({key: depth_feature(flag), FRONT: rgb_feature()})
    assert config.depth_cameras() == {camera: (8, 8)}
    assert set(config.image_features) == {FRONT}
    assert set(config.geometry_features) == {key}


def test_a_given_key_needs_no_flag_and_names_the_camera():
    unflagged = depth_feature("is_depth_map") | {"info": None}
    config = found_in({"observation.range_2": unflagged}, depth_keys={"wrist": "observation.range_2"})
    assert config.depth_cameras() == {"wrist": (8, 8)}


def test_two_depth_maps_of_one_camera_are_refused():
    flagged = depth_feature("is_depth_map")
    for other in (FRONT_DEPTH, "observation.images.depth.front"):
        with pytest.raises(ValueError, match=r"would both belong to camera 'front'; name their cameras") as caught:
            found_in({other: flagged, "observation.depth_front": flagged})
        one_sentence(caught.value)
    keys = {"front": FRONT_DEPTH, "second": "observation.depth_front"}
    assert set(found_in(dict.fromkeys(keys.values(), flagged), depth_keys=keys).depth_cameras()) == set(keys)


def test_a_policy_that_has_its_cameras_keeps_them():
    config = make_config()
    config.validate_features()
    config.set_dataset_feature_metadata({"observation.depth_front": depth_feature("is_depth_map")})
    assert config.depth_keys == {}


def test_a_converted_checkpoint_takes_no_colourised_depth_for_depth():
    """It learns its depth cameras from the data."""
    features = {
        "observation.images.front_depth": {
            "dtype": "video",
            "shape": (28, 28, 3),
            "names": ["height", "width", "channels"],
        },
        "observation.images.wrist_depth": {
            "dtype": "image",
            "shape": (28, 28, 1),
            "names": ["height", "width", "channels"],
        },
    }
    config = make_config(input_features={}, geometry_pending=1)
    config.set_dataset_feature_metadata(features)
    assert list(config.geometry_features) == ["observation.images.wrist_depth"]


def test_a_colourised_depth_video_stays_an_rgb_camera():
    config = found_in({FRONT_DEPTH: rgb_feature(), WRIST_DEPTH: depth_feature("is_depth_map")})
    assert set(config.image_features) == {FRONT_DEPTH}
    assert set(config.depth_cameras()) == {"wrist"}


# --- saving -------------------------------------------------------------------------------------------------------


def test_everything_is_saved_and_read_back(tmp_path):
    config = make_config(
        geometry_cameras=["wrist", "front"],
        absent_cameras=[WRIST],
        empty_cameras=1,
        geometry_gate_openness=3e-4,
        rtc_config=RTCConfig(execution_horizon=3),
        relative_exclude_joints=["gripper", "wrist"],
        normalization_mapping={"STATE": NormalizationMode.MEAN_STD, "ACTION": NormalizationMode.MIN_MAX},
    )
    config.validate_features()
    config.save_pretrained(tmp_path)
    assert json.loads((tmp_path / "config.json").read_text())["type"] == "pi05_geometry"
    loaded = PreTrainedConfig.from_pretrained(tmp_path)
    assert isinstance(loaded, PI05GeometryConfig)
    for field in dataclasses.fields(config):
        found, expected = getattr(loaded, field.name), getattr(config, field.name)
        assert found == expected, field.name
    assert loaded.calibration == make_calibration()
    assert loaded.geometry_features == {k: f for k, f in make_config().input_features.items() if is_geometry_key(k)}
    loaded.validate_features()
    assert draccus.encode(loaded) == draccus.encode(config)


def test_the_command_line_overrides_what_was_saved(tmp_path):
    make_config().save_pretrained(tmp_path)
    overrides = ["--geometry_grid=5", "--n_action_steps=2", f'--absent_cameras=["{WRIST}"]', "--device=cpu"]
    loaded = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=overrides)
    assert (loaded.geometry_grid, loaded.n_action_steps, loaded.absent_cameras) == (5, 2, [WRIST])


# --- bad values ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "known"),
    [
        ("paligemma_variant", "gemma_3b", "gemma_2b, small, tiny"),
        ("action_expert_variant", "gemma_2b", "gemma_300m, small, tiny"),
        ("dtype", "float16", "float32, bfloat16"),
        ("param_dtype", "bf16", "float32, bfloat16"),
        ("depth_unit", "cm", "m, mm"),
        ("geometry_source", "lidar", "none, rgbd, random"),
        ("geometry_frame", "world", "base, camera"),
        ("geometry_time", "noisy", "clean, denoise"),
        ("geometry_positions", "none", "sequential, parallel"),
        ("geometry_placement", "suffix", "segment, prefix"),
        ("geometry_expert", "none", "shared, own"),
    ],
)
def test_an_unknown_choice_is_refused_with_those_there_are(name, value, known):
    with pytest.raises(ValueError, match=rf"--policy.{name} must be one of") as caught:
        make_config(**{name: value})
    message = one_sentence(caught.value)
    assert repr(value) in message
    assert set(known.split(", ")) <= set(message.removesuffix(".").replace(",", "").split())


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"n_action_steps": 7}, r"n_action_steps \(7\) must not exceed chunk_size \(6\)"),
        ({"n_action_steps": 0}, "n_action_steps"),
        ({"chunk_size": 0, "n_action_steps": 0}, "chunk_size"),
        ({"num_inference_steps": 0}, "num_inference_steps"),
        ({"geometry_grid": 0}, "geometry_grid must be at least 1, got 0"),
        ({"geometry_dropout": 1.0}, r"geometry_dropout must be in \[0, 1\), got 1.0"),
        ({"geometry_dropout": -0.1}, "geometry_dropout"),
        ({"geometry_dropout": float("nan")}, "geometry_dropout"),
        ({"image_dropout": 1.0}, r"image_dropout must be in \[0, 1\), got 1.0"),
        ({"camera_dropout": -0.1}, "camera_dropout"),
        ({"geometry_dropout": 0.5, "image_dropout": 0.4, "camera_dropout": 0.2}, "must not exceed 1 together"),
        ({"geometry_gate_openness": -0.1}, "geometry_gate_openness must be 0 or more, got -0.1"),
        ({"geometry_gate_openness": float("nan")}, "geometry_gate_openness"),
        ({"max_depth": 0.02}, "max_depth must be above 0.02 m, got 0.02"),
        ({"max_depth": float("nan")}, "max_depth"),
        ({"flow_samples": 0}, "flow_samples must be at least 1"),
        ({"n_obs_steps": 2}, "n_obs_steps must be 1, got 2"),
        ({"geometry_cameras": []}, "geometry_cameras is empty"),
        ({"geometry_placement": "prefix", "geometry_time": "denoise"}, "geometry_time has no meaning"),
        ({"geometry_placement": "prefix", "geometry_expert": "own"}, "geometry_expert has no meaning"),
        ({"geometry_placement": "prefix", "geometry_gate_openness": 3e-4}, "geometry_gate_openness has no meaning"),
        ({"param_dtype": "bfloat16"}, "param_dtype=bfloat16 needs dtype=bfloat16"),
        ({"image_resolution": (28, 42)}, r"image_resolution must be square, got \(28, 42\)"),
        ({"image_resolution": (30, 30)}, "image_resolution must be a multiple of the vision tower's patch size 14"),
    ],
)
def test_bad_numbers_are_refused_in_one_sentence(changes, said):
    with pytest.raises(ValueError, match=said) as caught:
        make_config(**changes)
    one_sentence(caught.value)


def test_options_of_experiments_stand_apart_and_keep_their_names(tmp_path):
    """They are declared in another class than a user's settings, under the flags and the JSON names that they always had."""
    apart = {field.name for field in dataclasses.fields(AblationSettings)}
    assert {"geometry_time", "geometry_placement", "geometry_expert"} <= apart
    assert not apart & set(PI05GeometryConfig.__annotations__)
    make_config().save_pretrained(tmp_path)
    saved = json.loads((tmp_path / "config.json").read_text())
    saved |= {"geometry_expert": "own"}
    (tmp_path / "config.json").write_text(json.dumps(saved))
    loaded = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=["--geometry_time=denoise"])
    assert (loaded.network().geometry.time, loaded.network().geometry.expert) == ("denoise", "own")


@pytest.mark.parametrize("vlm", PALIGEMMA_VARIANTS)
@pytest.mark.parametrize("expert", EXPERT_VARIANTS)
def test_variants_of_two_families_do_not_go_together(vlm, expert):
    family = {"gemma_2b": "gemma_300m"}.get(vlm, vlm)
    if family == expert:
        assert make_config(paligemma_variant=vlm, action_expert_variant=expert).network()
    else:
        with pytest.raises(ValueError, match=r"share one attention.*gemma_2b with gemma_300m"):
            make_config(paligemma_variant=vlm, action_expert_variant=expert)


def test_an_absent_camera_that_the_data_does_not_know_is_named():
    config = make_config(absent_cameras=["wrist"])
    with pytest.raises(ValueError, match=rf"absent_cameras names wrist, but the data has .*{WRIST}; give a whole key"):
        config.validate_features()
    config = make_config(absent_cameras=[WRIST])
    config.validate_features()
    config.validate_features()  # LeRobot does so several times
