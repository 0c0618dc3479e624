"""The processors: the way of an observation to the policy, and of an action back; where geometry must not go."""

import math

import pytest
import torch
from lerobot.configs import NormalizationMode
from lerobot.processor import PolicyProcessorPipeline

from lerobot_policy_pi05_geometry.data.normaliser_scale import NormaliserScaleStep
from lerobot_policy_pi05_geometry.data.relative_actions import ACTION_ANCHOR
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from lerobot_policy_pi05_geometry.processor_pi05_geometry import make_pi05_geometry_pre_post_processors
from tests.entry_points import (
    ACTION_DIM,
    CHUNK,
    FRONT,
    FRONT_DEPTH,
    GEOMETRY,
    STATE,
    STATE_DIM,
    TOKENS,
    WRIST,
    WRIST_POSE,
    chunk_of,
    make_batch,
    make_config,
    make_observation,
    make_policy,
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
    tower.vision_model.embeddings.register_forward_hook(
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
def test_relative_actions_are_relative_to_the_policy_and_absolute_to_the_robot(excluded):
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
    predicted = processed["action"] + processed[ACTION_ANCHOR][:, None]  # as the policy hands out a chunk
    torch.testing.assert_close(postprocessor(predicted), action)


@pytest.mark.parametrize("arriving", [0.25, 0.251, -3.0, 1e6])
def test_a_state_dimension_without_width_is_written_as_its_constant(arriving):
    """0.001 beside the constant turned the prompt's number from 0 to 255."""
    config = make_config()
    config.validate_features()
    stats = make_stats()
    for name in ("q01", "q99", "min", "max"):
        stats[STATE][name] = (
            stats[STATE].get(name, stats[STATE][name.replace("min", "q01").replace("max", "q99")]).clone()
        )
        stats[STATE][name][3] = 0.25
    preprocessor, _ = make_pi05_geometry_pre_post_processors(config, stats)
    observation = make_observation()
    constant = observation[STATE].clone()
    constant[:, 3] = 0.25
    expected = preprocessor(observation | {STATE: constant})
    other = constant.clone()
    other[:, 3] = arriving
    found = preprocessor(observation | {STATE: other})
    assert torch.equal(found[TOKENS], expected[TOKENS])
    assert found["task"][0].split("State: ")[1].split(" ")[3] == "0"  # as LeRobot's pi05 writes it in training
    other[:, 2] = -other[:, 2]
    assert not torch.equal(preprocessor(observation | {STATE: other})[TOKENS], expected[TOKENS])


@pytest.mark.parametrize("arriving", [0.7, 0.71, -3.0])
def test_under_mean_and_deviation_a_constant_is_0_as_for_lerobot(arriving):
    mapping = {"VISUAL": NormalizationMode.IDENTITY, "STATE": NormalizationMode.MEAN_STD}
    config = make_config(normalization_mapping=mapping | {"ACTION": NormalizationMode.MEAN_STD})
    config.validate_features()
    stats = {
        key: {"mean": torch.zeros(size), "std": torch.ones(size)}
        for key, size in ((STATE, STATE_DIM), ("action", ACTION_DIM))
    }
    stats[STATE]["mean"][3], stats[STATE]["std"][3] = 0.7, 0.0
    preprocessor, _ = make_pi05_geometry_pre_post_processors(config, stats)
    observation = make_observation()
    observation[STATE][:, 3] = arriving
    written = preprocessor(observation)["task"][0].split("State: ")[1].split(" ")[3]
    assert written == "128"  # the bin of 0 in 256 bins from -1 to 1
    ours = [step for step in preprocessor.steps if isinstance(step, NormaliserScaleStep)]
    assert ours[0].get_config() == {"constant": 0.0}


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_a_state_with_width_is_normalised_to_the_bit_as_without_the_probe(scale):
    config = make_config()
    config.validate_features()
    stats = make_stats()
    stats[STATE] = {name: value * scale for name, value in stats[STATE].items()}
    preprocessor, _ = make_pi05_geometry_pre_post_processors(config, stats)
    (normaliser,) = (step for step in preprocessor.steps if hasattr(step, "norm_map"))
    observation = make_observation()
    observation[STATE] = observation[STATE] * scale
    expected = PolicyProcessorPipeline([normaliser])({STATE: observation[STATE]})[STATE]
    assert torch.equal(preprocessor(observation)[STATE], expected)


# --- another robot ------------------------------------------------------------------------------------------------


def test_a_robot_with_other_joints_is_refused_in_one_sentence(tmp_path):
    preprocessor, _ = make_processors(make_config())
    action = torch.zeros(2, CHUNK, ACTION_DIM)
    preprocessor(make_observation() | {"action": action})  # training
    preprocessor.save_pretrained(tmp_path)
    loaded = PolicyProcessorPipeline.from_pretrained(tmp_path, config_filename="policy_preprocessor.json")
    observation = make_observation()
    assert torch.equal(loaded(dict(observation))[STATE], preprocessor(dict(observation))[STATE])
    observation[STATE] = torch.zeros(2, 9)
    with pytest.raises(ValueError, match=r"^observation.state has 9 dimensions, but this policy was trained with 7"):
        loaded(observation)


def test_another_robots_actions_are_refused_in_training():
    policy = make_policy().train()
    batch = make_batch()
    batch["action"] = batch["action"][..., :4]
    with pytest.raises(ValueError, match="batch has 4 action dimensions, but the policy has 5"):
        policy.forward(batch)


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
