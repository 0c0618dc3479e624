"""What arrives from LeRobot is checked: images, statistics, calibration."""

import logging
from copy import deepcopy
from types import SimpleNamespace

import pytest
import torch
from lerobot.configs import NormalizationMode

from lerobot_policy_pi05_geometry import PI05GeometryConfig
from lerobot_policy_pi05_geometry.data.images import prepare_images
from lerobot_policy_pi05_geometry.data.statistics import check_stats
from lerobot_policy_pi05_geometry.geometry.calibration import write_calibration_file
from lerobot_policy_pi05_geometry.geometry.resolve import resolve, resolve_calibration
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from tests.entry_points import FRONT, STATE, WRIST, make_batch, make_calibration, make_config, make_stats

CPU = torch.device("cpu")


# --- images -------------------------------------------------------------------------------------------------------


def test_images_are_scaled_resized_and_padded_with_black():
    config = make_config()
    config.validate_features()
    batch = make_batch() | {FRONT: torch.ones(2, 3, 14, 28), WRIST: torch.zeros(2, 3, 56, 56)}
    (front, wrist), masks = prepare_images(batch, config, CPU)
    assert front.shape == wrist.shape == (2, 3, 28, 28)
    torch.testing.assert_close(front[:, :, 7:21], torch.ones(2, 3, 14, 28))
    assert front[:, :, :7].eq(-1).all()
    assert front[:, :, 21:].eq(-1).all()
    assert wrist.eq(-1).all()
    assert all(mask.all() for mask in masks)


def test_an_absent_camera_is_none_and_masked():
    config = make_config(absent_cameras=[WRIST], empty_cameras=1)
    config.validate_features()
    batch = make_batch()
    del batch[WRIST]
    images, masks = prepare_images(batch, config, CPU)
    assert [image is None for image in images] == [False, True, True]
    assert [mask.tolist() for mask in masks] == [[True, True], [False, False], [False, False]]


# --- statistics ---------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("key", [STATE, "action"])
@pytest.mark.parametrize("name", ["q01", "q99"])
def test_missing_quantiles_are_named(key, name):
    with pytest.raises(ValueError, match=rf"no q01/q99 statistics for {key}.*pi05-geometry quantiles"):
        check(stats_with(key, **{name: None}))


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
    with pytest.raises(ValueError, match=r"action\[2\] has q01 .*no width.*normalization_mapping"):
        check(stats)


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


@pytest.mark.parametrize("mode", [NormalizationMode.MEAN_STD, NormalizationMode.MIN_MAX, NormalizationMode.IDENTITY])
def test_other_normalisations_need_no_quantiles(mode):
    check({STATE: {}, "action": {}}, normalization_mapping={"STATE": mode, "ACTION": mode})
    check(stats_with("action", q99=[0.0] * 5, q01=[0.0] * 5), normalization_mapping={"STATE": mode, "ACTION": mode})


def test_statistics_of_geometry_are_not_asked_for():
    check(make_stats() | {f"{FRONT}_depth": {}, "observation.calibration.wrist.extrinsics": {}})


def test_policy_and_processors_check_statistics():
    with pytest.raises(ValueError, match="no q01/q99 statistics for action"):
        PI05GeometryPolicy(make_config(), dataset_stats=stats_with("action", q01=None))


# --- calibration --------------------------------------------------------------------------------------------------


def calibration_with_focal_length(focal: float) -> dict:
    calibration = make_calibration()
    calibration["front"].intrinsics[0] = focal
    return calibration


@pytest.fixture
def dataset(tmp_path) -> SimpleNamespace:
    """Metadata of a dataset that brings its own calibration, focal length 20."""
    (tmp_path / "dataset" / "meta").mkdir(parents=True)
    write_calibration_file(tmp_path / "dataset" / "meta" / "calibration.json", calibration_with_focal_length(20.0))
    return SimpleNamespace(root=tmp_path / "dataset", features={})


def focal_length(config: PI05GeometryConfig, meta: SimpleNamespace | None) -> float:
    return resolve_calibration(config, meta)["front"].intrinsics[0]


def test_a_given_file_comes_first(tmp_path, dataset):
    write_calibration_file(tmp_path / "given.json", calibration_with_focal_length(10.0))
    config = make_config(calibration=calibration_with_focal_length(30.0), calibration_path=str(tmp_path / "given.json"))
    assert focal_length(config, dataset) == focal_length(config, None) == 10.0


def test_what_was_given_once_holds_over_the_datasets(dataset):
    config = make_config(calibration=calibration_with_focal_length(30.0), calibration_given=True)
    assert focal_length(config, dataset) == 30.0


def test_without_a_given_file_the_datasets_holds_and_without_that_the_recorded_one(dataset):
    assert focal_length(make_config(calibration={}), dataset) == 20.0
    assert focal_length(make_config(calibration={}), SimpleNamespace(root=str(dataset.root), features={})) == 20.0
    recorded = make_config(calibration=calibration_with_focal_length(30.0))
    assert focal_length(recorded, None) == 30.0
    (dataset.root / "meta" / "calibration.json").unlink()
    assert focal_length(recorded, dataset) == 30.0


def test_a_dataset_that_contradicts_the_checkpoint_is_an_error(dataset):
    assert focal_length(make_config(calibration=calibration_with_focal_length(20.0)), dataset) == 20.0
    with pytest.raises(
        ValueError, match=r"The calibration of the dataset at .* differs from the one recorded.*calibration_path"
    ):
        focal_length(make_config(calibration=calibration_with_focal_length(30.0)), dataset)


def test_the_policy_keeps_what_it_read_and_not_where_from(tmp_path):
    write_calibration_file(tmp_path / "given.json", calibration_with_focal_length(10.0))
    policy = PI05GeometryPolicy(make_config(calibration={}, calibration_path=str(tmp_path / "given.json")))
    assert policy.config.calibration == calibration_with_focal_length(10.0)
    assert policy.config.calibration_path is None
    assert policy.config.calibration_given
    policy.save_pretrained(tmp_path / "saved")
    (tmp_path / "given.json").unlink()
    loaded = PI05GeometryPolicy.from_pretrained(tmp_path / "saved")
    assert loaded.geometry.source.calibration == calibration_with_focal_length(10.0)


def test_a_file_that_is_not_there_is_an_error_and_not_the_next_choice(dataset):
    with pytest.raises(FileNotFoundError, match=r"nowhere.json does not exist"):
        resolve_calibration(make_config(calibration_path="nowhere.json"), dataset)


def test_resolving_changes_no_configuration(dataset):
    """What was found is returned; the policy alone writes it back."""
    config = make_config(calibration={})
    config.validate_features()
    before = deepcopy(config)
    source, changes = resolve(config, dataset)
    assert config == before
    assert source.calibration == changes["calibration"] == calibration_with_focal_length(20.0)
    with pytest.raises(AssertionError):
        config.record({"no_such_field": 1})


def test_the_policy_takes_the_datasets_calibration(dataset):
    policy = PI05GeometryPolicy(make_config(calibration={}), dataset_meta=dataset)
    assert policy.geometry.source.calibration == calibration_with_focal_length(20.0)
    assert policy.config.calibration == calibration_with_focal_length(20.0)
    assert not policy.config.calibration_given
