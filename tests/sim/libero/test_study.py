"""The smallest study on LIBERO, end to end, as a user starts it. Run with `-m libero -n 0`."""

import pandas as pd
import pytest

from tests import commands

pytestmark = pytest.mark.libero
SPEC = """
seeds = [0]
[budget]
variant = "tiny"
episodes = 1
steps = 2
batch_size = 4
image_size = 28
evaluation_episodes = 2
parallel = 2
videos = 1
[pretrain]
tasks = ["libero_goal/7-stock"]
cameras = "train"
evaluated = []
episodes = 1
steps = 2
[[compare]]
tasks = ["libero_goal/7-stock"]
arms = ["blind", "rgb+rays", "geometry"]
conditions = ["inside", "depth-off"]
"""


def test_a_study_on_libero_pretrains_converts_fine_tunes_and_reports(tmp_path):
    """Two cameras, a state of 8 and actions of 7: nothing of Meta-World's sizes is left in a study."""
    spec, folder = tmp_path / "libero.toml", tmp_path / "study"
    spec.write_text(SPEC)
    commands.run("pi05_geometry_cli.__main__", "study", "--spec", str(spec), "--output", str(folder), timeout=1200)
    table = pd.read_csv(folder / "episodes.csv")
    assert not table["crashed"].any()
    assert len(table) == 3 * 2 * 2  # arms, conditions, episodes
    assert set(table["task"]) == {"libero_goal/7-stock"}
    assert (folder / "report.html").read_text().count("<img ") >= 3
