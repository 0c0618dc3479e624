"""Dataset statistics: what they must have, what they are of, and how they are computed."""

import json
import logging
import shutil
from types import SimpleNamespace

import numpy as np
import pyarrow
import pytest
import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.datasets.dataset_tools import recompute_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
from pyarrow import parquet

from lerobot_policy_pi05_geometry.data.quantiles import action_kind, write_frame_quantiles
from lerobot_policy_pi05_geometry.data.statistics import check_stats, require_matching_kind
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from lerobot_policy_pi05_geometry.processor_pi05_geometry import make_pi05_geometry_pre_post_processors
from tests.datasets import REPO_ID, write_dataset
from tests.entry_points import FRONT, STATE, make_batch, make_config, make_features, make_observation, make_stats


def stats_with(key: str, **changes) -> dict:
    """Good statistics, one of them changed; None removes it."""
    stats = {name: dict(values) for name, values in make_stats().items()}
    for name, value in changes.items():
        stats[key].pop(name, None)
        if value is not None:
            stats[key][name] = torch.tensor(value)
    return stats


def check(stats: dict, **changes) -> None:
    config = make_config(**changes)
    config.validate_features()
    check_stats(config, stats)


def test_good_statistics_pass_without_a_word(caplog):
    check(make_stats())
    assert not caplog.records


@pytest.mark.parametrize("name", ["q01", "q99"])
@pytest.mark.parametrize(
    ("key", "changes", "command"),
    [
        (STATE, {}, r"`pi05-geometry quantiles --dataset.root=...`"),
        ("action", {}, r"`pi05-geometry quantiles --actions --dataset.root=...`"),
        ("action", {"use_relative_actions": True}, r"recompute_stats --operation.relative_action true`"),
    ],
)
def test_missing_quantiles_are_named_and_how_to_get_them(key, changes, command, name):
    with pytest.raises(ValueError, match=rf"no q01/q99 statistics for {key}.*{command}"):
        check(stats_with(key, **{name: None}), **changes)


def test_an_action_without_any_statistics_is_named():
    """Without a state in the data, the policy fills one in."""
    with pytest.raises(ValueError, match="no q01/q99 statistics for action"):
        check({STATE: make_stats()[STATE]})
    check({"action": make_stats()["action"]})


def test_the_quantiles_of_the_chosen_mode_are_asked_for():
    mapping = {"STATE": NormalizationMode.QUANTILE10}
    with pytest.raises(ValueError, match=rf"no q10/q90 statistics for {STATE}, which QUANTILE10 normalisation needs"):
        check(make_stats(), normalization_mapping=mapping)
    check(stats_with(STATE, q10=[-1.0] * 7, q90=[1.0] * 7), normalization_mapping=mapping)


@pytest.mark.parametrize("high", [0.25, 0.2])
def test_a_dimension_without_width_that_is_not_constant_is_named(high):
    """LeRobot divides by an epsilon there, and one outlier becomes millions."""
    low, top = [0.0, 0.0, 0.25, 0.0, 0.0], [1.0, 1.0, high, 1.0, 1.0]
    stats = stats_with("action", q01=low, q99=top, min=[0.0] * 5, max=[1.0] * 5)
    with pytest.raises(ValueError, match=r"action\[2\] has q01 .*no width.*quantiles --full-range action:2"):
        check(stats)


def reaching(reach: float) -> dict:
    """Statistics of an action whose dimension 3 is `reach` in normalised units at its maximum."""
    low, top = [-1.0] * 5, [1.0, 1.0, 1.0, 0.002, 1.0]
    low[3] = 0.0
    most = [1.0, 1.0, 1.0, 0.001 + 0.001 * reach, 1.0]
    return stats_with("action", q01=low, q99=top, min=[-1.0, -1.0, -1.0, 0.0, -1.0], max=most)


@pytest.mark.parametrize("reach", [60.0, 3000.0])
def test_an_action_far_outside_its_quantiles_is_refused(reach):
    """A gripper that moves in one frame of 250: the loss starts in the tens or thousands."""
    with pytest.raises(
        ValueError, match=rf"action\[3\] reaches {reach:.4g} in normalised units.*--full-range action:3"
    ):
        check(reaching(reach))


@pytest.mark.parametrize("reach", [8.0, 40.0])
def test_an_action_outside_its_quantiles_is_reported(reach, caplog):
    caplog.set_level(logging.WARNING)
    check(reaching(reach))
    (record,) = caplog.records
    assert f"action[3] reaches {reach:.4g}" in record.getMessage()
    assert "--full-range action:3" in record.getMessage()


@pytest.mark.parametrize("reach", [1.0, 3.0])
def test_an_action_near_its_quantiles_is_fine(reach, caplog):
    check(reaching(reach))
    assert not caplog.records


@pytest.mark.parametrize("key", [STATE, "action"])
@pytest.mark.parametrize("name", ["q01", "q99", "min", "mean", "std"])
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_statistics_that_are_no_numbers_are_refused(key, name, bad):
    """One NaN in one frame is in some of the statistics, whichever the normalisation uses."""
    values = [0.0] * (7 if key == STATE else 5)
    values[2] = bad
    with pytest.raises(ValueError, match=rf"statistic {name} of {key}\[2\] is {bad}"):
        check(stats_with(key, **{name: values}))


def test_statistics_of_what_the_policy_does_not_read_are_not_asked_for():
    """Effort, velocities and environment states are in many datasets, often without quantiles."""
    inputs, outputs = make_features()
    unread = {
        "observation.effort": PolicyFeature(FeatureType.STATE, (6,)),
        "observation.environment_state": PolicyFeature(FeatureType.ENV, (3,)),
    }
    config = make_config(input_features=inputs | unread, output_features=outputs)
    config.validate_features()
    stats = make_stats() | {"observation.effort": {"mean": torch.zeros(6), "std": torch.ones(6)}}
    check_stats(config, stats)
    preprocessor, _ = make_pi05_geometry_pre_post_processors(config, stats)
    effort = torch.randn(2, 6)
    assert torch.equal(preprocessor(make_observation() | {"observation.effort": effort})["observation.effort"], effort)
    policy = PI05GeometryPolicy(config)
    policy.forward(make_batch() | {"observation.effort": effort})


def test_without_minimum_and_maximum_a_dimension_counts_as_not_constant():
    with pytest.raises(ValueError, match=r"action\[0\] has q01"):
        check(stats_with("action", q01=[0.0] * 5, q99=[0.0, 1.0, 1.0, 1.0, 1.0]))


def test_a_constant_dimension_is_only_reported(caplog):
    caplog.set_level(logging.WARNING)
    state = [0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    top = [0.5, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    check(stats_with(STATE, q01=state, q99=top, min=state, max=top))
    (record,) = caplog.records
    assert record.getMessage() == f"{STATE}[0] is constant (0.5) in the dataset; it carries no information."


def test_a_state_that_would_mostly_be_clipped_is_reported(caplog):
    caplog.set_level(logging.WARNING)
    low, high = [-1.0, *[-2.0] * 6], [1.0, *[2.0] * 6]
    check(stats_with(STATE, min=[-3.1, *[-2.0] * 6], max=high))
    assert "observation.state[0] span less than half" in caplog.text
    assert "pi05-geometry quantiles" in caplog.text
    caplog.clear()
    check(stats_with(STATE, min=low, max=high))
    assert not caplog.records


@pytest.mark.parametrize(
    ("mode", "names"),
    [
        (NormalizationMode.MEAN_STD, ("mean", "std")),
        (NormalizationMode.MIN_MAX, ("min", "max")),
        (NormalizationMode.IDENTITY, ()),
    ],
)
def test_other_normalisations_need_their_own_statistics_and_no_quantiles(mode, names):
    mapping = {"STATE": mode, "ACTION": mode}
    stats = {key: {name: torch.ones(size) for name in names} for key, size in ((STATE, 7), ("action", 5))}
    check(stats, normalization_mapping=mapping)
    check(
        stats | {"action": stats["action"] | {"q01": torch.zeros(5), "q99": torch.zeros(5)}},
        normalization_mapping=mapping,
    )
    if names:
        del stats["action"][names[0]]
        with pytest.raises(ValueError, match=f"no {'/'.join(names)} statistics for action, which {mode.value}"):
            check(stats, normalization_mapping=mapping)


def test_statistics_of_geometry_are_not_asked_for():
    check(make_stats() | {f"{FRONT}_depth": {}, "observation.calibration.wrist.extrinsics": {}})


def test_policy_and_processors_check_statistics():
    with pytest.raises(ValueError, match="no q01/q99 statistics for action"):
        PI05GeometryPolicy(make_config(), dataset_stats=stats_with("action", q01=None))


# --- relative and absolute ----------------------------------------------------------------------------------------


@pytest.fixture
def dataset(tmp_path):
    """A tiny dataset with statistics of absolute actions."""
    return write_dataset(tmp_path / "data")


def metadata(root) -> LeRobotDatasetMetadata:
    return LeRobotDatasetMetadata(REPO_ID, root=root)


def make_relative(root) -> None:
    """LeRobot's own statistics of relative actions."""
    recompute_stats(LeRobotDataset(REPO_ID, root=root), relative_action=True, relative_exclude_joints=[], chunk_size=3)


def test_the_kind_of_the_action_statistics_is_known(dataset):
    assert action_kind(metadata(dataset)) == "absolute"
    make_relative(dataset)
    assert action_kind(metadata(dataset)) == "relative"
    recompute_stats(LeRobotDataset(REPO_ID, root=dataset))
    assert action_kind(metadata(dataset)) == "absolute"
    assert action_kind(SimpleNamespace(root=dataset, stats=None)) is None
    assert action_kind(SimpleNamespace(root=dataset / "nothing", stats=metadata(dataset).stats)) is None


def test_the_frames_decide_of_what_kind_statistics_are(dataset):
    """LeRobot's recompute_stats leaves the statistics of the episodes as they were when an action is corrected."""
    (file,) = (dataset / "data").rglob("*.parquet")
    table = parquet.read_table(file)
    actions = np.stack(table["action"].to_pylist())
    actions[3] *= 3
    column = pyarrow.array(actions.tolist(), type=table.schema.field("action").type)
    number = table.schema.get_field_index("action")
    parquet.write_table(table.set_column(number, table.schema.field("action"), column), file)
    recompute_stats(LeRobotDataset(REPO_ID, root=dataset))
    assert action_kind(metadata(dataset)) == "absolute"
    write_frame_quantiles(dataset, REPO_ID, ("observation.state", "action"))
    with pytest.raises(ValueError, match="needs statistics of relative actions"):
        require_matching_kind(make_config(use_relative_actions=True), metadata(dataset))
    make_relative(dataset)
    assert action_kind(metadata(dataset)) == "relative"


def test_the_kind_is_known_without_the_frames_too(dataset):
    """Of a dataset that is streamed, only meta/ is there."""
    shutil.rmtree(dataset / "data")
    assert action_kind(metadata(dataset)) == "absolute"


def test_a_policy_and_statistics_of_another_kind_are_refused(dataset):
    absolute, relative = make_config(), make_config(use_relative_actions=True)
    require_matching_kind(absolute, metadata(dataset))
    with pytest.raises(ValueError, match=r"needs statistics of relative actions.*recompute_stats"):
        require_matching_kind(relative, metadata(dataset))
    make_relative(dataset)
    require_matching_kind(relative, metadata(dataset))
    with pytest.raises(ValueError, match=r"statistics are of relative actions.*use_relative_actions=true"):
        PI05GeometryPolicy(make_config(geometry_source="none"), dataset_meta=metadata(dataset))


def test_quantiles_leave_statistics_of_relative_actions_alone(dataset):
    """They came from whole chunks; single frames have other ones."""
    make_relative(dataset)
    before = metadata(dataset).stats
    assert set(write_frame_quantiles(dataset, REPO_ID)) == {STATE}
    after = metadata(dataset).stats
    for name, value in before["action"].items():
        assert np.array_equal(after["action"][name], value), name
    stored = (dataset / "meta" / "stats.json").read_text()
    with pytest.raises(ValueError, match=r"action statistics of .* are of relative actions"):
        write_frame_quantiles(dataset, REPO_ID, (STATE, "action"))
    assert (dataset / "meta" / "stats.json").read_text() == stored


def test_actions_are_recomputed_when_they_are_asked_for(dataset):
    content = json.loads((dataset / "meta" / "stats.json").read_text())
    for key in (STATE, "action"):
        content[key]["q99"] = [0.0] * len(content[key]["q99"])
    (dataset / "meta" / "stats.json").write_text(json.dumps(content))
    write_frame_quantiles(dataset, REPO_ID)
    assert metadata(dataset).stats["action"]["q99"].max() == 0
    write_frame_quantiles(dataset, REPO_ID, (STATE, "action"))
    frames = np.array(LeRobotDataset(REPO_ID, root=dataset).hf_dataset["action"])
    spread = frames.max(axis=0) - frames.min(axis=0)
    np.testing.assert_allclose(
        metadata(dataset).stats["action"]["q99"], np.quantile(frames, 0.99, axis=0), atol=0.1 * spread.max()
    )


def test_one_dimension_takes_its_whole_range_and_the_others_keep_their_quantiles(dataset):
    before = metadata(dataset).stats["action"]
    write_frame_quantiles(dataset, REPO_ID, (), {"action": [3]})
    after = metadata(dataset).stats["action"]
    for name in ("q01", "q10", "q50", "q90", "q99", "min", "max", "mean", "std"):
        expected = before[name].copy()
        if name in ("q01", "q10", "q90", "q99"):
            expected[3] = before["min" if name in ("q01", "q10") else "max"][3]
        np.testing.assert_allclose(after[name], expected, rtol=1e-6, err_msg=name)


def test_a_gripper_that_hardly_moves_is_refused_until_it_has_its_whole_range(dataset):
    """The remedy that the error names, from end to end."""
    content = json.loads((dataset / "meta" / "stats.json").read_text())
    content["action"]["q01"][4], content["action"]["q99"][4] = 0.5, 0.5004
    (dataset / "meta" / "stats.json").write_text(json.dumps(content))
    config = make_config(geometry_source="none", input_features={STATE: make_features()[0][STATE]})
    config.validate_features()
    with pytest.raises(ValueError, match="--full-range action:4"):
        check_stats(config, metadata(dataset).stats)
    write_frame_quantiles(dataset, REPO_ID, (), {"action": [4]})
    check_stats(config, metadata(dataset).stats)


@pytest.mark.parametrize(
    ("key", "dims", "told"), [("action", [5], "0 to 4"), ("action", [-1], "0 to 4"), ("x", [0], "x has no")]
)
def test_a_dimension_that_is_not_there_is_named(dataset, key, dims, told):
    with pytest.raises(ValueError, match=told):
        write_frame_quantiles(dataset, REPO_ID, (), {key: dims})


def with_states(root, change):
    """Change the states in the dataset's files. change: of all frames, (N, D) float32."""
    for path in (root / "data").rglob("*.parquet"):
        table = parquet.read_table(path)
        number, field = table.schema.get_field_index(STATE), table.schema.field(STATE)
        states = np.stack(table[STATE].to_pylist()).astype(np.float32)
        change(states)
        parquet.write_table(table.set_column(number, field, pyarrow.array(states.tolist(), type=field.type)), path)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_value_that_is_not_finite_leaves_the_quantiles_alone(dataset, value):
    stored = (dataset / "meta" / "stats.json").read_text()
    with_states(dataset, lambda states: states.__setitem__((3, 2), value))
    with pytest.raises(ValueError, match=rf"observation.state\[2\] is {value} in frame 3"):
        write_frame_quantiles(dataset, REPO_ID)
    assert (dataset / "meta" / "stats.json").read_text() == stored


def test_the_quantiles_of_a_constant_are_the_constant(dataset, caplog):
    """Rounding would give them a width, and the state would fill it."""
    constants = np.array([0.3, 0.0, 1000.0], np.float32)
    with_states(dataset, lambda states: states.__setitem__((slice(None), slice(2, 5)), constants))
    write_frame_quantiles(dataset, REPO_ID)
    stats = metadata(dataset).stats[STATE]
    for name in ("q01", "q10", "q50", "q90", "q99"):
        assert np.array_equal(stats[name][2:5], constants.astype(np.float64)), name
    config = make_config(geometry_source="none", input_features={STATE: make_features()[0][STATE]})
    config.validate_features()
    check_stats(config, metadata(dataset).stats)
    for dim in (2, 3, 4):
        assert f"{STATE}[{dim}] is constant" in caplog.text
