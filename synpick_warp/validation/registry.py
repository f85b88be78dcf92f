"""Registry of validation rules: a rule is one function with a name, a sentence and a cure, declared by the decorator `rule`."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Any, NamedTuple, TypeVar

from synpick_warp.errors import SynpickError

MODULES = ("tree", "records", "info", "images", "masks", "coco", "models", "targets", "rig", "shards", "poses")
"""Modules in `validation.rules`, in the order of their rules."""
_Check = TypeVar("_Check", bound=Callable[[Any], Iterator[Any]])


class Level(enum.StrEnum):
    """Whether a violation makes a data set wrong, or only matters to some of its users."""

    ERROR = "error"
    WARNING = "warning"


class Violation(NamedTuple):
    """A violation of a rule."""

    level: Level
    file: str
    """Path relative to the data set; a member of a shard follows after a colon."""
    rule: str
    text: str
    """What is wrong."""


@dataclass(frozen=True)
class Rule:
    """A rule about one type of subject."""

    name: str
    subject: type
    """Type of what the rule is about: the folder, a model, a scene, a view, ..."""
    level: Level
    sentence: str
    """What holds in a correct data set."""
    cure: str
    """How to mend a violation."""
    check: Callable[[Any], Iterator[tuple[str, str]]]
    """Yields (file, what is wrong) for each violation."""


RULES: dict[str, Rule] = {}
"""All rules by name, once `load_rules` has been called."""


def rule(subject: type, name: str, sentence: str, cure: str, level: Level = Level.ERROR) -> Callable[[_Check], _Check]:
    """Declare the decorated function as the check of a rule.

    Args:
        subject: Type of the function's argument; the rule is applied to each such subject of a data set.
        name: Name of the rule: words joined by hyphens.
        sentence: What holds in a correct data set.
        cure: How to mend a violation.
        level: Level of its violations.
    """

    def declare(check: _Check) -> _Check:
        assert name not in RULES, name
        RULES[name] = Rule(name, subject, level, sentence, cure, check)
        return check

    return declare


def load_rules() -> dict[str, Rule]:
    """Import the modules of the rules; returns all rules by name, in the order in which they are documented."""
    for module in MODULES:
        import_module(f"synpick_warp.validation.rules.{module}")
    return RULES


def apply_rules(subject: object) -> Iterator[Violation]:
    """Check a subject by all rules about its type. A rule that meets unreadable data ends with a violation that says so."""
    for item in load_rules().values():
        if item.subject is not type(subject):
            continue
        try:
            for file, text in item.check(subject):
                yield Violation(item.level, file, item.name, text)
        except SynpickError as error:
            yield Violation(Level.ERROR, getattr(subject, "place", "."), item.name, f"cannot be checked: {error}")
