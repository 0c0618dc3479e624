"""`pi05-geometry serve`: what is refused before a checkpoint is loaded."""

import pytest
from typer.testing import CliRunner

from lerobot_policy_pi05_geometry.serving.extras import require_extra
from pi05_geometry_cli import app

MISTAKES = {
    "an open host": (["--host", "0.0.0.0"], "clients need a key"),
    "an open host for LeRobot": (["--lerobot", "--host", "0.0.0.0"], "would serve everyone"),
    "a key for LeRobot": (["--lerobot", "--key-file", "key"], "can send no key"),
    "no key": (["--key-file", "nothing-there"], "is not there; write a key"),
    "a rate without LeRobot": (["--fps", "10"], "--fps is for --lerobot"),
    "no rate": (["--lerobot", "--fps", "0"], "--fps must be above 0"),
    "sizes": (["--batch-sizes", "1,two"], "must be ascending numbers, as 1,2,4; got 1,two"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_told_before_a_checkpoint_is_loaded(name, monkeypatch):
    monkeypatch.delenv("PI05_GEOMETRY_API_KEY", raising=False)
    options, sentence = MISTAKES[name]
    result = CliRunner().invoke(app, ["serve", "no-such-checkpoint", *options])
    assert isinstance(result.exception, ValueError | FileNotFoundError)
    assert sentence in str(result.exception)


def test_a_package_that_is_missing_is_named_with_its_extra():
    require_extra("serve", "websockets")
    with pytest.raises(ModuleNotFoundError, match=r"needs no_such; install .*\[serve\]"):
        require_extra("serve", "websockets", "no_such")
