"""The processors: the way of an observation to the policy, and of an action back; where geometry must not go."""

import math

import pytest
import torch
from lerobot.processor import PolicyProcessorPipeline

from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from lerobot_policy_pi05_geometry.processor_pi05_geometry import make_pi05_geometry_pre_post_processors
from tests.entry_points import (
    ACTION_DIM,
    CHUNK,
    FRONT,
    FRONT_DEPTH,
    GEOMETRY,
    STATE,
    WRIST,
    WRIST_POSE,
    chunk_of,
    make_config,
    make_observation,
    make_processors,
    make_stats,
    redraw,
    without,
)

# --- nothing leaks ------------------------------------------------------------------------------------------------


def other_geometry(batch: dict) -> dict:
    """The same batch with other depth and another pose."""
    return batch | {key: make_observation(seed=7)[key] for key in GEOMETRY}


def test_geometry_reaches_neither_the_prompt_nor_siglip_nor_the_normaliser():
    config = make_config()
    preprocessor, _ = make_processors(config)
    policy = redraw(PI05GeometryPolicy(config)).eval()
    seen = []
    tower = policy.model.paligemma_with_expert.paligemma.model.vision_tower
    tower.register_forward_hook(
        lambda _m, args, kwargs, _o: seen.append(args[0] if args else kwargs["pixel_values"]), with_kwargs=True
    )
    raw = make_observation()
    outputs = []
    for observation in (raw, other_geometry(raw)):
        processed = preprocessor(dict(observation))
        for key in GEOMETRY:
            assert torch.equal(processed[key], observation[key]), key
        policy.predict_action_chunk(processed)
        outputs.append(processed)
    for key, value in without(outputs[0], *GEOMETRY).items():
        other = outputs[1][key]
        assert torch.equal(value, other) if isinstance(value, torch.Tensor) else value == other, key
    assert len(seen) == 2
    assert torch.equal(seen[0], seen[1])
    assert seen[0].shape == (4, 3, 28, 28)  # two RGB cameras, a batch of two


def test_the_normaliser_does_not_know_geometry():
    """Statistics of depth and poses are in every dataset; they must not be applied."""
    config = make_config()
    preprocessor, _ = make_processors(config)
    (normaliser,) = (step for step in preprocessor.steps if hasattr(step, "norm_map"))
    assert set(normaliser.features) == {FRONT, WRIST, STATE, "action"}


def test_processors_may_be_made_before_the_policy():
    """Whatever is made first, depth and poses come through untouched."""
    spread = {"q01": -torch.ones(4, 4), "q99": 3 * torch.ones(4, 4)}
    preprocessor, _ = make_pi05_geometry_pre_post_processors(make_config(), make_stats() | {WRIST_POSE: spread})
    observation = make_observation()
    assert torch.equal(preprocessor(dict(observation))[WRIST_POSE], observation[WRIST_POSE])


# --- processors ---------------------------------------------------------------------------------------------------


def test_actions_survive_normalising_and_back():
    preprocessor, postprocessor = make_processors(make_config())
    action = torch.randn(2, CHUNK, ACTION_DIM)
    processed = preprocessor(make_observation() | {"action": action})
    assert not torch.allclose(processed["action"], action)
    torch.testing.assert_close(postprocessor(processed["action"]), action)


@pytest.mark.parametrize("excluded", [[], ["gripper"]])
def test_relative_actions_survive_the_way_there_and_back(excluded):
    names = ["x", "y", "z", "turn", "gripper"]
    config = make_config(use_relative_actions=True, relative_exclude_joints=excluded, action_feature_names=names)
    preprocessor, postprocessor = make_processors(config)
    absolute = make_processors(make_config())[0]
    observation, action = make_observation(), torch.randn(2, CHUNK, ACTION_DIM)
    state = observation[STATE]
    processed = preprocessor(observation | {"action": action})
    offset = state[:, None, :ACTION_DIM].clone()
    offset[..., ACTION_DIM - len(excluded) :] = 0.0
    expected = absolute(observation | {"action": action - offset})["action"]
    torch.testing.assert_close(processed["action"], expected)
    torch.testing.assert_close(postprocessor(processed["action"]), action)


def test_keys_can_be_renamed_depth_included(tmp_path):
    config = make_config()
    preprocessor, _ = make_processors(config)
    preprocessor.save_pretrained(tmp_path)
    names = {FRONT: "observation.images.top", FRONT_DEPTH: "observation.images.top_depth"}
    renamed = PolicyProcessorPipeline.from_pretrained(
        tmp_path,
        config_filename="policy_preprocessor.json",
        overrides={"rename_observations_processor": {"rename_map": {new: old for old, new in names.items()}}},
    )
    policy = redraw(PI05GeometryPolicy(config)).eval()
    observation = make_observation()
    incoming = {names.get(key, key): value for key, value in observation.items()}
    assert torch.equal(chunk_of(policy, renamed(incoming)), chunk_of(policy, preprocessor(observation)))
    policy = redraw(PI05GeometryPolicy(make_config())).eval()
    with pytest.raises(ValueError, match=r"no image observation.images.front.*--rename_map"):
        policy.predict_action_chunk(preprocessor(incoming))
    with pytest.raises(ValueError, match=r"no depth from camera\(s\) front.*--rename_map"):
        policy.predict_action_chunk(preprocessor(incoming | {FRONT: observation[FRONT]}))


def test_an_observation_without_a_batch_gets_one():
    config = make_config()
    preprocessor, _ = make_processors(config)
    policy = redraw(PI05GeometryPolicy(config)).eval()
    batch = make_observation(1)
    single = {key: value[0] for key, value in batch.items()}
    assert torch.equal(chunk_of(policy, preprocessor(single)), chunk_of(policy, preprocessor(batch)))


def test_a_state_that_is_no_number_is_refused():
    preprocessor, _ = make_processors(make_config())
    observation = make_observation()
    observation[STATE][1, 2] = math.nan
    with pytest.raises(ValueError, match=r"observation.state\[2\] is nan in sample 1"):
        preprocessor(observation)
