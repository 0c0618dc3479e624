from pathlib import Path

import pytest

from .processes import write_checkpoint


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("served") / "checkpoint", chunk_size=30, n_action_steps=10)
