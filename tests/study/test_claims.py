"""Claims against tables of episodes: thresholds, intervals, and the factor by which geometry learns faster."""

import pandas as pd
import pytest

from lerobot_policy_pi05_geometry.study.claims import claims, speed_factor

EPISODES = 50


def episodes(cells: dict[tuple[str, str, int], float], tasks: str = "ab") -> pd.DataFrame:
    """cells: (arm, condition, multiple) -> success rate, in each of two training seeds and of the tasks."""
    rows = [
        (task, arm, multiple, seed, condition, episode, episode < round(rate * EPISODES))
        for (arm, condition, multiple), rate in cells.items()
        for task in tasks
        for seed in (0, 1)
        for episode in range(EPISODES)
    ]
    columns = ["task", "arm", "multiple", "training_seed", "condition", "episode_seed", "success"]
    return pd.DataFrame(rows, columns=columns)


def verdicts(**changed: float) -> list[str]:
    rates = {
        "geometry_outside": 0.6,
        "rgb_outside": 0.2,
        "geometry_inside": 0.7,
        "rgb_inside": 0.7,
        "off": 0.6,
        "wide": 0.3,
    }
    rates |= changed
    table = episodes(
        {
            ("geometry", "outside", 1): rates["geometry_outside"],
            ("rgb", "outside", 1): rates["rgb_outside"],
            ("geometry", "inside", 1): rates["geometry_inside"],
            ("rgb", "inside", 1): rates["rgb_inside"],
            ("geometry", "depth-off", 1): rates["off"],
            ("rgb-wide", "outside", 1): rates["wide"],
        }
    )
    return [claim.verdict for claim in claims(table, table, 1500)]


def test_each_claim_stands_on_its_own_figure():
    """Outside, inside, depth off, then the three rivals, of which one is in the table."""
    rest = ["not tested", "not tested"]
    assert verdicts() == ["yes", "yes", "yes", "yes", *rest]
    assert verdicts(rgb_outside=0.32) == ["no", "yes", "yes", "yes", *rest]  # apart, but not twice
    assert verdicts(geometry_outside=0.04, rgb_outside=0.02)[0] == "no"  # twice, but not apart
    assert verdicts(geometry_inside=0.6)[1] == "no"  # -10, with a lower bound below -10
    assert verdicts(off=0.54) == ["yes", "yes", "no", "yes", *rest]
    assert verdicts(wide=0.6) == ["yes", "yes", "yes", "no", *rest]


def test_a_rival_that_reaches_geometry_gives_a_factor():
    cells = {("geometry", "outside", m): r for m, r in ((1, 0.5), (2, 0.6), (4, 0.6))}
    cells |= {("rgb-wide", "outside", m): r for m, r in ((1, 0.2), (2, 0.4), (4, 0.6))}
    table = episodes(cells)
    assert speed_factor(table, "rgb-wide") == (4, 2)
    final = table[table["multiple"] == 4]
    sentence = next(c.sentence for c in claims(final, table, 1500) if c.claim.startswith("rgb-wide"))
    assert "3,000 steps instead of 6,000: it learns 2 times as fast" in sentence
    never = episodes({("geometry", "outside", 1): 0.1, ("rgb-wide", "outside", 1): 0.2})
    assert speed_factor(never, "rgb-wide") is None


def test_the_policy_that_got_geometry_after_rgb_is_judged_by_its_own_episodes():
    rates = {
        ("rgb", "outside"): 0.2, ("rgb", "inside"): 0.7,
        ("geometry", "outside"): 0.6, ("geometry", "inside"): 0.7, ("geometry", "depth-off"): 0.1,
        ("geometry-after-rgb", "outside"): 0.3, ("geometry-after-rgb", "inside"): 0.8, ("geometry-after-rgb", "depth-off"): 0.64,
    }  # fmt: skip
    table = episodes({(*cell, 2): rate for cell, rate in rates.items()})
    found = claims(table, table, 1500)
    assert [claim.verdict for claim in found[:3]] == ["yes", "yes", "no"]
    of_after = found[3:6]
    assert [claim.verdict for claim in of_after] == ["no", "yes", "yes"]
    assert all(claim.claim.startswith("geometry-after-rgb: ") for claim in of_after)
    assert ["30%" in of_after[0].sentence, "+10 points" in of_after[1].sentence, "64%" in of_after[2].sentence] == [
        True
    ] * 3
    without = table[table["arm"] != "geometry-after-rgb"]
    assert len(claims(without, without, 1500)) == len(found) - 3
    alone = table[table["arm"] != "geometry"]
    assert claims(alone, alone, 1500)[:3] == of_after  # the report begins with the first claim


@pytest.mark.parametrize("missing", ["geometry", "rgb"])
def test_what_was_not_run_is_not_claimed(missing):
    table = episodes({(arm, "outside", 1): 0.5 for arm in {"geometry", "rgb"} - {missing}})
    assert {claim.verdict for claim in claims(table, table, 1500)} == {"not tested"}


def test_a_claim_is_of_the_tasks_that_both_arms_have():
    """Geometry also ran on an easy task, and blocks of other arms on others."""
    arms, conditions = ("geometry", "rgb", "rgb-wide"), ("inside", "outside", "depth-off")
    common = episodes({(arm, condition, 1): 0.3 for arm in arms for condition in conditions}, "a")
    alone = episodes({("geometry", condition, 1): 0.9 for condition in conditions}, "b")
    table = pd.concat([common, alone, episodes({("rgb+rays", "outside", 1): 0.9}, "c")])
    found = claims(table, table, 1500)
    assert [claim.verdict for claim in found] == ["no", "yes", "yes", "no", "not tested", "not tested"]
    assert "90%" not in " ".join(claim.sentence for claim in found)
    assert speed_factor(table, "rgb-wide") == (1, 1)
    apart = pd.concat([alone, common[common["arm"] != "geometry"]])
    assert {claim.verdict for claim in claims(apart, apart, 1500)} == {"not tested"}
