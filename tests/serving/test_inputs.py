"""Requests in every spelling of keys, and what is refused."""

import numpy as np
import pytest
from lerobot.configs import RTCAttentionSchedule

from lerobot_policy_pi05_geometry.serving.inputs import Guidance, Inputs
from lerobot_policy_pi05_geometry.serving.limits import Limits, RequestError
from tests.entry_points import FRONT, FRONT_DEPTH, STATE, WRIST, WRIST_DEPTH, WRIST_POSE, make_config, without

from .running import make_request

FRONT_POSE = "observation.calibration.front.extrinsics"


def make_inputs(rename_map=None, **changes) -> Inputs:
    config = make_config(**changes)
    config.validate_features()
    return Inputs(config, Limits(), rename_map)


def flat(request: dict) -> dict:
    """The same request as LeRobot spells it."""
    return {
        FRONT: request["images"]["front"],
        WRIST: request["images"]["wrist"],
        FRONT_DEPTH: request["depth"]["front"],
        WRIST_DEPTH: request["depth"]["wrist"],
        WRIST_POSE: request["extrinsics"]["wrist"],
        STATE: request["state"],
        "task": request["prompt"],
    }


def slashed(request: dict) -> dict:
    """As openpi's examples for DROID and LIBERO spell it; depth among the images, channels first or last."""
    return {
        "observation/front": request["images"]["front"].transpose(2, 0, 1),
        "observation/wrist": request["images"]["wrist"],
        "images": {"front_depth": request["depth"]["front"][..., None], "wrist_depth": request["depth"]["wrist"][None]},
        "extrinsics": {"wrist": request["extrinsics"]["wrist"].astype(np.float64)},
        "observation/state": request["state"].astype(np.float64),
        "prompt": request["prompt"],
    }


@pytest.mark.parametrize("spelled", [flat, slashed])
def test_all_spellings_mean_the_same(spelled):
    inputs, request = make_inputs(), make_request()
    expected, found = inputs.read(request), inputs.read(spelled(request))
    assert found.task == expected.task == request["prompt"]
    assert set(found.observation) == set(expected.observation) == {FRONT, WRIST, *list(flat(request))[2:6]}
    for key, array in expected.observation.items():
        assert found.observation[key].dtype == array.dtype, key
        np.testing.assert_array_equal(found.observation[key], array, err_msg=key)


def test_names_of_the_data_that_the_preprocessor_renames():
    inputs, request = make_inputs({"observation.images.top": FRONT}), flat(make_request())
    request["observation.images.top"] = request.pop(FRONT)
    assert FRONT in inputs.read(request).observation


TOP = "observation.images.top"


@pytest.mark.parametrize("rename_map", [{FRONT: WRIST, WRIST: FRONT}, {TOP: FRONT, FRONT: WRIST}])
@pytest.mark.parametrize("spelled", [dict, flat, slashed])
def test_the_policys_names_mean_its_cameras_whatever_its_data_called_them(rename_map, spelled):
    request = make_request()
    found = make_inputs(rename_map).read(spelled(request)).observation
    for camera, key in (("front", FRONT), ("wrist", WRIST)):
        np.testing.assert_array_equal(found[key], request["images"][camera])


def change(request: dict, *path: str, value) -> dict:
    name, *rest = path
    return request | {name: change(request[name], *rest, value=value) if rest else value}


image, depth = np.zeros((30, 40, 3), np.uint8), np.zeros((18, 24), np.uint16)
state, nan_state = np.zeros(7, np.float32), np.full(7, np.nan, np.float32)
WRONG = {
    "no image": (lambda r: r | {"images": without(r["images"], "front")}, f"has no {FRONT}; expected"),
    "no state": (lambda r: without(r, "state"), f"has no {STATE}"),
    "no depth": (lambda r: r | {"depth": without(r["depth"], "front")}, f"has no {FRONT_DEPTH}; expected .* mm"),
    "no pose": (lambda r: without(r, "extrinsics"), f"has no {WRIST_POSE}"),
    "no task": (lambda r: without(r, "prompt"), "must say what to do"),
    "two tasks": (lambda r: r | {"task": "a"}, "must say what to do in one text"),
    "task of bytes": (lambda r: r | {"prompt": b"a"}, "must say what to do"),
    "task of a mile": (lambda r: r | {"prompt": "ä" * 2049}, "more than 4096 bytes"),
    "twice": (lambda r: r | {"observation.state": r["state"]}, f"{STATE} twice"),
    "unknown": (lambda r: r | {"images": r["images"] | {"left": image}}, "has images/left, which .* does not know; it takes"),
    "unknown and long": (lambda r: r | {"x" * 500: 1}, r"has x{77}\.\.\., which"),
    "unknown on two lines": (lambda r: r | {"left\n\x1b[2J": 1}, r"has left\?\?\[2J, which"),
    "bytes as key": (lambda r: r | {b"a": 1}, "must be text"),
    "bytes as inner key": (lambda r: r | {"images": {b"front": image}}, "keys in images must be text"),
    "image of floats": (lambda r: change(r, "images", "front", value=image.astype("f8")), "dtype <f8; expected .*u1 or <f4"),
    "image above 1": (lambda r: change(r, "images", "front", value=image.astype("f4") + 2), "outside 0 to 1"),
    "image of NaN": (lambda r: change(r, "images", "front", value=image.astype("f4") * np.nan), "not finite"),
    "image without channels": (lambda r: change(r, "images", "front", value=image[..., 0]), r"shape \(30, 40\)"),
    "image with 4 channels": (lambda r: change(r, "images", "front", value=np.zeros((30, 40, 4), "u1")), "shape"),
    "image of a batch": (lambda r: change(r, "images", "front", value=image[None]), r"shape \(1, 30, 40, 3\)"),
    "huge image": (lambda r: change(r, "images", "front", value=np.zeros((1000, 5000, 3), "u1")), "sides must be 8 to 4096"),
    "low image": (lambda r: change(r, "images", "front", value=np.zeros((3, 7, 40), "u1")), "has 7 x 40 pixels; sides must be"),
    "thin image": (lambda r: change(r, "images", "front", value=np.zeros((80, 9, 3), "f4")), "one at most 8 times the other"),
    "image of numbers": (lambda r: change(r, "images", "front", value=[1, 2]), "images/front is no array"),
    "8-bit depth": (lambda r: change(r, "depth", "front", value=depth.astype("u1")), "dtype |u1; expected .* mm"),
    "small depth": (lambda r: change(r, "depth", "front", value=depth[1:]), r"shape \(17, 24\); expected \(18, 24\)"),
    "short state": (lambda r: r | {"state": state[1:]}, r"shape \(6,\); expected \(7,\)"),
    "whole state": (lambda r: r | {"state": state.astype("i4")}, "dtype <i4"),
    "lost state": (lambda r: r | {"state": nan_state}, "state holds a number that is not finite"),
    "infinite state": (lambda r: r | {"state": np.full(7, 1e300)}, "not finite"),
    "half a pose": (lambda r: change(r, "extrinsics", "wrist", value=np.eye(3)), "expected .*base_T_camera"),
    "noise": (lambda r: r | {"noise": np.zeros((6, 5), np.float32)}, r"noise must be finite float32 of shape \(6, 8\)"),
    "half of RTC": (lambda r: r | {"inference_delay": 1}, "needs executed_steps"),
    "RTC by truth": (lambda r: r | {"inference_delay": True, "executed_steps": 1}, "needs inference_delay"),
    "RTC beyond the chunk": (lambda r: r | {"inference_delay": 1, "executed_steps": 7}, "from 0 to 6"),
    "no horizon": (lambda r: r | {"inference_delay": 1, "executed_steps": 1, "execution_horizon": 0}, "execution_horizon"),
    "weight of NaN": (
        lambda r: r | {"inference_delay": 1, "executed_steps": 1, "max_guidance_weight": float("nan")},
        "max_guidance_weight",
    ),
    "schedule": (
        lambda r: r | {"inference_delay": 1, "executed_steps": 1, "prefix_attention_schedule": "steep"},
        "one of zeros, ones, linear, exp",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
@pytest.mark.filterwarnings("ignore:overflow")
def test_what_is_wrong_is_named_in_one_sentence(name):
    spoil, sentence = WRONG[name]
    with pytest.raises(RequestError, match=sentence) as caught:
        make_inputs().read(spoil(make_request()))
    assert len(str(caught.value)) < 600
    assert "\n" not in str(caught.value)


def test_float_images_may_overshoot_as_far_as_the_local_policy_takes_them():
    """Cubic interpolation gives 1.005."""
    inputs, request = make_inputs(), make_request()
    front = request["images"]["front"].astype(np.float32) / 255
    for value, refused in ((1.005, False), (-0.005, False), (1.05, True), (-0.05, True)):
        front[0, 0, 0] = value
        changed = change(request, "images", "front", value=front)
        if refused:
            with pytest.raises(RequestError, match="outside 0 to 1"):
                inputs.read(changed)
        else:
            np.testing.assert_array_equal(inputs.read(changed).observation[FRONT], front)


def test_a_depth_camera_may_fail_once_it_has_been_seen():
    inputs, request = make_inputs(), without(make_request(), "depth", "extrinsics")
    request["depth"] = {"front": depth}
    found = inputs.read(request, seen={WRIST_DEPTH, WRIST_POSE})
    assert set(found.observation) == set(inputs.read(make_request()).observation)
    assert not found.observation[WRIST_DEPTH].any()  # nothing is measured
    blind = inputs.read(
        without(make_request(), "extrinsics"), seen={WRIST_POSE}
    )  # a pose is missing: depth has no place
    assert not blind.observation[WRIST_DEPTH].any()
    with pytest.raises(RequestError, match=f"has no {FRONT}"):
        inputs.read(without(request, "images"), seen={FRONT, WRIST, WRIST_DEPTH, WRIST_POSE})


def test_an_rgb_camera_that_may_be_absent():
    inputs = make_inputs(absent_cameras=[WRIST])
    request = make_request()
    assert WRIST not in inputs.read(request | {"images": without(request["images"], "wrist")}).observation


def test_a_pose_that_the_calibration_has_may_be_sent_too():
    request = make_request()
    found = make_inputs().read(request | {"extrinsics": request["extrinsics"] | {"front": np.eye(4)}})
    assert found.observation[FRONT_POSE].dtype == np.float32


def test_without_geometry_no_depth_is_expected():
    inputs = make_inputs(geometry_source="none")
    assert set(inputs.expected) == {FRONT, WRIST, STATE}
    with pytest.raises(RequestError, match="depth/front, which this policy does not know"):
        inputs.read(make_request())


def test_real_time_chunking():
    given = {"inference_delay": 2, "executed_steps": 3}
    assert make_inputs().read(make_request() | given).guidance == Guidance(2, 3)
    more = {"execution_horizon": 4, "max_guidance_weight": 5, "prefix_attention_schedule": "exp"}
    assert make_inputs().read(make_request() | given | more).guidance == Guidance(
        2, 3, 4, 5.0, RTCAttentionSchedule.EXP
    )
    assert make_inputs().read(make_request()).guidance is None


def test_an_optional_depth_camera_may_be_missing_from_the_start():
    """As it may where the policy runs locally."""
    request = make_request()
    request["depth"] = without(request["depth"], "front")
    found = make_inputs(optional_depth_cameras=["front"]).read(request)
    assert FRONT_DEPTH not in found.observation
    with pytest.raises(RequestError, match=f"has no {FRONT_DEPTH}"):
        make_inputs(optional_depth_cameras=["wrist"]).read(request)


def test_depth_of_an_optional_camera_needs_its_pose():
    inputs, request = make_inputs(optional_depth_cameras=["wrist"]), make_request()
    seen = inputs.read(request).observation
    lost = without(request, "extrinsics")
    with pytest.raises(RequestError, match=f"has {WRIST_DEPTH}, but not {WRIST_POSE}, which it needs"):
        inputs.read(lost)
    found = inputs.read(lost, seen).observation  # it has failed: the camera is masked, as one that is away
    assert WRIST_DEPTH not in found
    assert FRONT_DEPTH in found
    both = make_inputs(optional_depth_cameras=["wrist"], geometry_frame="camera")
    assert WRIST_DEPTH in both.read(lost).observation


def test_a_pose_may_come_as_datasets_store_it():
    request = make_request()
    expected = make_inputs().read(request).observation[WRIST_POSE]
    rows = {"wrist": request["extrinsics"]["wrist"].flatten()}
    np.testing.assert_array_equal(make_inputs().read(request | {"extrinsics": rows}).observation[WRIST_POSE], expected)


def test_a_camera_of_rays_whose_pose_is_lost_has_none():
    request = without(make_request(), "depth")
    inputs = make_inputs(geometry_source="rays")
    inputs.read(request)
    found = inputs.read(without(request, "extrinsics"), seen={WRIST_POSE})
    assert np.isnan(found.observation[WRIST_POSE]).all()
