"""The first sentence of a study's report."""

import pandas as pd

from lerobot_policy_pi05_geometry.study.report import floor_sentence, headline
from lerobot_policy_pi05_geometry.study.results import cells
from lerobot_policy_pi05_geometry.study.simulated_tasks import simulated_task


def table(rates: dict[tuple[str, str], int], condition: str = "outside") -> pd.DataFrame:
    """Ten episodes of two seeds each; rates: (task, arm) -> how many of ten succeed."""
    rows = [
        (task, arm, seed, condition, episode, episode < wins, 1, False)
        for (task, arm), wins in rates.items()
        for seed in (0, 1)
        for episode in range(10)
    ]
    columns = ["task", "arm", "training_seed", "condition", "episode_seed", "success", "steps", "crashed"]
    return pd.DataFrame(rows, columns=columns)


def test_an_arm_on_some_tasks_is_compared_with_geometry_on_these():
    """Pooled over all tasks, a control that ran on the hard one only would look worse than it is."""
    found = headline(
        table(
            {
                ("hard", "geometry"): 2,
                ("easy", "geometry"): 10,
                ("hard", "rgb"): 1,
                ("easy", "rgb"): 5,
                ("hard", "random"): 1,
                ("hard", "blind"): 0,
                ("easy", "blind"): 4,
            }
        )
    )
    assert "geometry succeeds in 60% (" in found
    assert "RGB only in 30% (" in found
    assert "random tokens 10% (on hard, where geometry has 20%)" in found
    assert "no camera 20%" in found
    assert "no camera 20% (on" not in found


def test_the_headline_states_whether_intervals_overlap():
    def said(geometry: int, rgb: int) -> str:
        return headline(table({("t", "geometry"): geometry, ("t", "rgb"): rgb}))

    assert "the intervals do not overlap" in said(9, 1)
    assert "the intervals do not overlap" in said(1, 9)
    assert "the intervals overlap" in said(5, 4)


def test_the_difference_is_averaged_over_tasks_and_resamples_training_seeds():
    rows = table({("a", "geometry"): 9, ("a", "rgb"): 1, ("b", "geometry"): 6, ("b", "rgb"): 4, ("c", "geometry"): 0})
    assert "The difference is +50 points (+" in headline(rows)
    lucky = rows[rows["training_seed"] == 0]
    assert "bootstrap over training seeds" not in headline(lucky)
    lost = rows[rows["training_seed"] == 1].assign(success=False)  # one seed in which nobody succeeds
    assert "The difference is +25 points (+0 to" in headline(pd.concat([lucky, lost]))


def test_without_the_outside_condition_the_best_cell_is_named():
    found = headline(table({("t", "geometry"): 3, ("t", "rgb"): 7}, condition="inside"))
    assert "The best cell of this study is rgb under 'inside': 70%" in found


def test_every_condition_has_its_place_in_a_report():
    """Conditions in the order of their list, each with its numbers of denoising steps, fewest first."""
    given = ["outside-steps-3", "steps-10", "noise", "steps-2", "outside", "inside"]
    rows = pd.concat([table({("t", "geometry"): 5}, condition) for condition in given])
    expected = ["inside", "steps-2", "steps-10", "outside", "outside-steps-3", "noise"]
    assert [cell.condition for cell in cells(rows)] == expected


def test_a_task_of_libero_brings_the_floor_of_its_placement():
    placed, stock = (simulated_task(f"libero_spatial/2-{placement}").floor() for placement in ("near", "stock"))
    assert placed is not None
    assert stock is not None
    assert (placed.placement, stock.placement) == ("near", "stock")
    shares = f"blind plan {placed.blind}/{placed.blind_episodes}, expert {placed.expert}/{placed.episodes}"
    assert shares in floor_sentence(placed)
    assert simulated_task("button-press-topdown-wide").floor() is None  # its study has a blind policy instead


def test_arms_are_compared_on_the_tasks_that_both_have():
    """Geometry also ran on an easy task, in another block: there RGB only would look worse than it is."""
    rates = {
        ("hard", "geometry"): 3,
        ("hard", "rgb"): 3,
        ("easy", "geometry"): 9,
        ("easy", "random"): 8,
        ("other", "blind"): 1,
    }
    rows = pd.concat([table(rates, condition) for condition in ("inside", "outside", "depth-off")])
    found = headline(rows)
    assert "geometry succeeds in 30% (" in found
    assert "RGB only in 30% (" in found
    assert "Both were evaluated on hard." in found
    assert "With its depth camera off and the camera within the range, geometry succeeds in 30% (" in found
    assert found.endswith("For comparison: random tokens 80% (on easy, where geometry has 90%).")
    assert "The best cell of this study" in headline(rows[(rows["arm"] != "rgb") | (rows["condition"] != "outside")])
