"""Where the calibration of a policy comes from."""

from copy import deepcopy
from types import SimpleNamespace

import pytest

from lerobot_policy_pi05_geometry import PI05GeometryConfig
from lerobot_policy_pi05_geometry.geometry.calibration import Rig, write_calibration_file
from lerobot_policy_pi05_geometry.geometry.resolve import resolve, resolve_calibration
from lerobot_policy_pi05_geometry.geometry.rgbd import RgbdSource
from lerobot_policy_pi05_geometry.modeling_pi05_geometry import PI05GeometryPolicy
from tests.entry_points import make_calibration, make_config


def calibration_with_focal_length(focal: float) -> dict:
    calibration = make_calibration()
    calibration["front"].intrinsics[0] = focal
    return calibration


@pytest.fixture
def dataset(tmp_path) -> SimpleNamespace:
    """Metadata of a dataset that brings its own calibration, focal length 20."""
    (tmp_path / "dataset" / "meta").mkdir(parents=True)
    write_calibration_file(tmp_path / "dataset" / "meta" / "calibration.json", Rig(calibration_with_focal_length(20.0)))
    return SimpleNamespace(root=tmp_path / "dataset", features={})


def cameras_of(source: RgbdSource) -> dict:
    return {name: placed.cameras[0] for name, placed in source.placed.items()}


def focal_length(config: PI05GeometryConfig, meta: SimpleNamespace | None) -> float:
    return resolve_calibration(config, meta).cameras["front"].intrinsics[0]


def test_a_given_file_comes_first(tmp_path, dataset):
    write_calibration_file(tmp_path / "given.json", Rig(calibration_with_focal_length(10.0)))
    config = make_config(calibration=calibration_with_focal_length(30.0), calibration_path=str(tmp_path / "given.json"))
    assert focal_length(config, dataset) == focal_length(config, None) == 10.0


def test_what_was_given_once_holds_over_the_datasets_and_says_so(dataset, caplog):
    config = make_config(calibration=calibration_with_focal_length(30.0), calibration_given=True)
    assert focal_length(config, dataset) == 30.0
    assert "another calibration than the one that was given" in caplog.text
    caplog.clear()
    assert (
        focal_length(make_config(calibration=calibration_with_focal_length(20.0), calibration_given=True), dataset)
        == 20.0
    )
    assert "another calibration" not in caplog.text


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
    write_calibration_file(tmp_path / "given.json", Rig(calibration_with_focal_length(10.0)))
    policy = PI05GeometryPolicy(make_config(calibration={}, calibration_path=str(tmp_path / "given.json")))
    assert policy.config.calibration == calibration_with_focal_length(10.0)
    assert policy.config.calibration_path is None
    assert policy.config.calibration_given
    policy.save_pretrained(tmp_path / "saved")
    (tmp_path / "given.json").unlink()
    loaded = PI05GeometryPolicy.from_pretrained(tmp_path / "saved")
    assert cameras_of(loaded.geometry.source) == calibration_with_focal_length(10.0)


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
    assert cameras_of(source) == changes["calibration"] == calibration_with_focal_length(20.0)
    with pytest.raises(AssertionError):
        config.record({"no_such_field": 1})


def test_the_policy_takes_the_datasets_calibration(dataset):
    policy = PI05GeometryPolicy(make_config(calibration={}), dataset_meta=dataset)
    assert cameras_of(policy.geometry.source) == calibration_with_focal_length(20.0)
    assert policy.config.calibration == calibration_with_focal_length(20.0)
    assert not policy.config.calibration_given
