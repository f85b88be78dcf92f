"""A correct data set has no violation, and every planted fault is found and named."""

from __future__ import annotations

import pytest

from synpick_warp.apps.validation.registry import load_rules
from tests.validation import faults_annotations, faults_images, faults_models
from tests.validation.planting import FAULTS

MODULES = (faults_annotations, faults_images, faults_models)
"""Imported for the faults that they declare."""


def test_a_correct_set_has_no_violation(good, check):
    assert check(good) == []


@pytest.mark.parametrize("planted", FAULTS, ids=lambda planted: planted.name)
def test_a_planted_fault_is_found(copy, check, planted):
    planted.plant(copy)
    rendered = load_rules()[planted.rule].check.__module__.endswith("poses")
    found = [violation for violation in check(copy, sample=None if rendered else 0) if violation.rule == planted.rule]
    assert found, planted.rule
    assert any(planted.words in violation.text for violation in found), [violation.text for violation in found]
    assert all(violation.file for violation in found)


def test_every_rule_has_its_fault():
    assert {planted.rule for planted in FAULTS} == set(load_rules())
