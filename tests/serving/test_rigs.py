"""Checkpoints trained on several rigs: a robot says which it is, on every protocol."""

import numpy as np
import pytest
import torch
from lerobot.policies.factory import get_policy_class

from lerobot_policy_pi05_geometry import PI05GeometryRemoteConfig
from lerobot_policy_pi05_geometry.geometry.keys import RIG
from lerobot_policy_pi05_geometry.serving.client import PolicyClient, RefusedError
from lerobot_policy_pi05_geometry.serving.engine import PolicyEngine, make_job
from lerobot_policy_pi05_geometry.serving.inputs import Inputs
from lerobot_policy_pi05_geometry.serving.limits import Limits, RequestError
from lerobot_policy_pi05_geometry.serving.rigs import Rigs
from lerobot_policy_pi05_geometry.serving.service import make_service, make_websocket_server
from lerobot_policy_pi05_geometry.serving.session import Session
from tests.entry_points import CHUNK, WRIST_POSE, make_config, without

from .running import load, make_request, make_rigs, observation_of, serving
from .test_remote import exact

NOISE = torch.randn(2, CHUNK, 8, generator=torch.Generator().manual_seed(1))


def load_several():
    """The same policy every time: a server warms its own while a test uses another."""
    return load(calibration={}, rigs=make_rigs(None))


@pytest.fixture(scope="module")
def loaded():
    return load_several()


@pytest.fixture(scope="module")
def url():
    with serving(make_websocket_server(make_service(load_several(), (1,)))) as running:
        yield running.url


@pytest.mark.parametrize("source", ["rgbd", "rays", "none"])
def test_every_source_with_poses_has_rigs(source) -> None:
    config = make_config(calibration={}, rigs=make_rigs(None), geometry_source=source)
    rigs = Rigs(config)
    assert rigs.ids == ([] if source == "none" else [2, 5])
    assert Rigs(config, only=5 if rigs.ids else None).default == (5 if rigs.ids else None)


def local(loaded, rigs: list[int | None], requests: list[dict], noise: torch.Tensor) -> np.ndarray:
    loaded.policy.reset()
    batch = observation_of(*requests)
    if rigs[0] is not None:
        batch[RIG] = torch.tensor(rigs)
    with torch.no_grad():
        chunk = loaded.policy.predict_action_chunk(loaded.preprocess(batch), noise=noise)
        return loaded.postprocess(chunk).numpy()


def asked(seed: int = 0, **more) -> dict:
    return make_request(seed) | {"noise": NOISE[0].numpy()} | more


def test_a_robot_is_answered_by_its_own_rigs_calibration(loaded, url):
    expected = {rig: local(loaded, [rig], [make_request()], NOISE[:1])[0] for rig in (2, 5)}
    assert np.abs(expected[2] - expected[5]).max() > 1e-3
    client = PolicyClient(url)
    assert (client.metadata["rigs"], client.metadata["default_rig"]) == ([2, 5], None)
    with pytest.raises(RefusedError, match=r"several rigs; say as rig which of them this robot is: 2, 5"):
        client.infer(asked())
    np.testing.assert_array_equal(client.infer(asked(rig=5))["actions"], expected[5])
    np.testing.assert_array_equal(client.infer(asked())["actions"], expected[5])  # the session has said it
    client.reset()
    np.testing.assert_array_equal(client.infer(asked())["actions"], expected[5])
    client.infer({"endpoint": "reset", RIG: np.array([2])})
    np.testing.assert_array_equal(client.infer(asked())["actions"], expected[2])
    client.close()


@pytest.mark.parametrize("rig", [3, -2, 2.5, True, "2", None, [2], float("nan"), 2**60, np.array([2, 5])])
def test_another_rig_is_refused_wherever_it_is_named(url, rig):
    client = PolicyClient(url)
    for message in (asked(rig=rig), {"endpoint": "reset", "rig": rig}, {"endpoint": "reset", RIG: rig}):
        with pytest.raises(RefusedError, match=r"rig must be the number of one rig of this policy: 2, 5\.$"):
            client.infer(message)
    with pytest.raises(RefusedError, match="must be the number of one rig"):
        client.infer(asked(rig=2) | {RIG: 5})
    client.close()


def test_robots_of_two_rigs_share_a_batch(loaded):
    engine, inputs = PolicyEngine(loaded), Inputs(loaded.policy.config, Limits())
    requests = [make_request(seed) | {"noise": NOISE[seed].numpy(), "rig": (5, 2)[seed]} for seed in range(2)]
    jobs = [make_job(Session(), inputs.read(request), 0, (CHUNK, 8)) for request in requests]
    assert jobs[0].group == jobs[1].group
    for row, answer in enumerate(engine.run(jobs, 2)):
        expected = local(loaded, [(5, 2)[row]], [make_request(row)], NOISE[row : row + 1])[0]
        np.testing.assert_allclose(answer.actions, expected, atol=1e-5)


def test_a_pose_that_one_rig_lacks_comes_with_every_request(url):
    client = PolicyClient(url)
    assert client.metadata["inputs"][WRIST_POSE]["required"] is True
    for rig in (2, 5):
        with pytest.raises(RefusedError, match=f"has no {WRIST_POSE}"):
            client.infer(without(asked(rig=rig), "extrinsics"))
    client.close()


def test_a_server_of_one_rig_needs_no_name_and_takes_no_other(loaded):
    with serving(make_websocket_server(make_service(load_several(), (1,), rig=5))) as running:
        client = PolicyClient(running.url)
        assert (client.metadata["rigs"], client.metadata["default_rig"]) == ([5], 5)
        for more in ({}, {"rig": 5}):
            expected = local(loaded, [5], [make_request()], NOISE[:1])[0]
            np.testing.assert_array_equal(client.infer(asked(**more))["actions"], expected)
        with pytest.raises(RefusedError, match="must be the number of one rig of this policy: 5"):
            client.infer(asked(rig=2))
        client.close()


def test_what_a_checkpoint_does_not_have_is_told():
    def rigs(only: int | None, **changes) -> Rigs:
        return Rigs(make_config(**changes), only)

    several = {"calibration": {}, "rigs": make_rigs(None)}
    with pytest.raises(ValueError, match=r"--rig 3 is not in the checkpoint, which has the rigs 2, 5"):
        rigs(3, **several)
    with pytest.raises(ValueError, match=r"--rig 3 is not .* one robot's calibration, without rigs"):
        rigs(3)
    chosen = rigs(None, rig=5, **several)  # the checkpoint acts on one
    assert (chosen.ids, chosen.default) == ([5], 5)
    with pytest.raises(ValueError, match="has the rigs 5"):
        rigs(2, rig=5, **several)
    with pytest.raises(RequestError, match="trained on one robot; leave it out"):
        rigs(None).take({"rig": 0})


def test_the_remote_policy_says_its_rig(loaded, url):
    def remote(**settings):
        config = PI05GeometryRemoteConfig(server=url, noise="client", **settings)
        return get_policy_class("pi05_geometry_remote")(config)

    observation = exact(2)
    expected = local_of(loaded, observation | {RIG: torch.tensor([5, 5])})
    np.testing.assert_allclose(remote(rig=5).predict_action_chunk(observation, noise=NOISE), expected, atol=1e-5)
    rows = observation | {RIG: torch.tensor([[2], [5]])}
    found = remote().predict_action_chunk(rows, noise=NOISE)  # robots of a batch differ
    np.testing.assert_allclose(found, local_of(loaded, rows), atol=1e-5)
    with pytest.raises(RefusedError, match="trained on several rigs; say as rig"):
        remote().predict_action_chunk(observation, noise=NOISE)
    with pytest.raises(ValueError, match=r"has the rigs 2, 5, but --policy.rig is 3"):
        remote(rig=3)


def local_of(loaded, observation: dict) -> np.ndarray:
    loaded.policy.reset()
    with torch.no_grad():
        chunk = loaded.policy.predict_action_chunk(loaded.preprocess(observation), noise=NOISE)
        return loaded.postprocess(chunk).numpy()
