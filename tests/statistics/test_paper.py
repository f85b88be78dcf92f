"""Comparison with the SynPick paper: consistency of its published numbers, and the total variation distance."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.apps.statistics.figures import Annotations, EpisodeFigures, GroupStatistics
from synpick_warp.apps.statistics.paper import compare, object_distance, read_paper, total_variation

COUNTS = st.dictionaries(st.sampled_from("abcdef"), st.integers(0, 1000)).filter(lambda counts: sum(counts.values()) > 0)


def test_the_papers_numbers_add_up():
    paper = read_paper()
    assert sum(group.views for group in paper.groups) == paper.total_views == 503_232
    assert sum(group.instances for group in paper.groups) == 3_927_549
    assert {(group.split, group.mode) for group in paper.groups} == {
        (split, mode) for split in ("train", "test") for mode in ("pick", "target", "move")
    }
    assert all(len(group.objects) == 21 for group in paper.groups)
    # The total is the mean over views, to the digits of the table.
    mean = sum(group.views * group.visibility for group in paper.groups) / paper.total_views
    assert mean == pytest.approx(paper.total_visibility, abs=0.011)
    frames = [round(group.views / (group.sequences * paper.cameras)) for group in paper.groups[:3]]
    assert frames == [573, 416, 687]


def test_distances_have_known_answers():
    assert total_variation({"a": 1, "b": 1}, {"a": 5, "b": 5}) == 0.0
    assert total_variation({"a": 1}, {"b": 7}) == 1.0
    assert total_variation({"a": 3, "b": 1}, {"a": 1, "b": 1}) == pytest.approx(0.25)
    names = {1: "002_master_chef_can", 2: "003_cracker_box", 3: "banana"}
    theirs = {"master_chef_can": 1, "cracker_box": 1, "banana": 0}
    assert object_distance({1: 5, 2: 5}, names, theirs) == 0.0
    assert object_distance({3: 5}, names, theirs) is None  # An object of another set with the same word.
    assert object_distance({4: 5}, names, theirs) is None
    assert object_distance({}, names, theirs) is None


@given(first=COUNTS, second=COUNTS, third=COUNTS)
def test_total_variation_is_a_metric(first, second, third):
    distance = total_variation(first, second)
    assert 0.0 <= distance <= 1.0 + 1e-12
    assert distance == pytest.approx(total_variation(second, first))
    assert distance <= total_variation(first, third) + total_variation(third, second) + 1e-12


def test_the_papers_own_set_has_no_difference():
    paper = read_paper()
    ids = {name: index for index, name in enumerate(paper.groups[0].objects)}
    ours = []
    for each in paper.groups:
        objects = {ids[name]: count for name, count in each.objects.items()}
        episodes = EpisodeFigures(each.sequences, 0, {}, 0, 0, 0, 0, {}, 0, 0, None, ())
        ours.append(
            GroupStatistics(each.split, each.mode, episodes, Annotations(each.views, each.instances, each.visibility, 0, (), objects), ())
        )
    names = {index: f"000_{name}" for name, index in ids.items()}
    rows = compare(ours, {"train": "train", "test": "test"}, names, paper.cameras)
    assert len(rows) == 6
    for row in rows:
        assert row.ours == row.paper
        assert row.distance == 0.0
        assert 0.05 < row.paper_distance < 0.2
