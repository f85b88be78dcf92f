"""A correct data set has no violation, and every planted fault is found and named."""

from __future__ import annotations

import pytest

from synpick_warp.apps.validation.registry import load_rules
from tests.validation.faults import FAULTS


def test_a_correct_set_has_no_violation(good, check):
    assert check(good) == []


@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_is_found(copy, check, name):
    rule, words, plant = FAULTS[name]
    plant(copy)
    rendered = load_rules()[rule].check.__module__.endswith("poses")
    found = [violation for violation in check(copy, sample=None if rendered else 0) if violation.rule == rule]
    assert found, rule
    assert any(words in violation.text for violation in found), [violation.text for violation in found]
    assert all(violation.file for violation in found)


def test_every_rule_has_its_fault():
    assert {rule for rule, *_ in FAULTS.values()} == set(load_rules())
