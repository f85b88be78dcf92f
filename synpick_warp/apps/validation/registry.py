"""Registry of validation rules: a rule is a function with a name and advice, declared by `rule`; its docstring says what holds.

Deviations are summed up by rule and object as median, 95th percentile and maximum, which `validate --tolerance` reports.
"""

import enum
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple, TypeVar

import numpy as np

from synpick_warp.errors import ConfigError, SynpickError, format_value

MODULES = ("tree", "records", "images", "coco", "models", "cross_file", "poses", "trials")
"""Modules in `validation.rules`, in the order of their rules."""
UNITS = ("mm", "px")
"""Units of deviations."""


class Level(enum.StrEnum):
    """Whether a violation makes a data set wrong, or only matters to some of its users."""

    ERROR = "error"
    WARNING = "warning"


class Tolerance(NamedTuple):
    """Annotation tolerance of a measured data set: the largest deviations that are accepted."""

    mm: float
    """Largest distance between depth and the model at its pose [mm]."""
    px: float
    """Largest distance of outlines and of the sides of boxes [px], and largest surplus of visible pixels per pixel of the outline."""


class Deviation(NamedTuple):
    """Deviation of an annotated instance from its rendering, or from another annotation of it, in the unit of the rule."""

    file: str
    text: str
    """Description, for the case that it is a violation."""
    obj_id: int
    value: float
    """Deviation in the unit of the rule; 0: the annotation agrees."""
    wrong: bool = False
    """Whether validation without a tolerance reports it as a violation."""
    explained: bool = False
    """Whether a finding, or depth in coarse counts, explains it. It is then part of the distribution, but not reported as a violation."""


Findings = Iterator[tuple[str, str] | Deviation]
"""Results of a check: (file, description) of each violation, and the deviation of each instance that was compared, also if it is right."""
_Check = TypeVar("_Check", bound=Callable[[Any], Findings])


class Violation(NamedTuple):
    """Violation of a rule: level, file, rule, and what is wrong."""

    level: Level
    file: str
    """Path relative to the data set; a member of a shard follows after a colon."""
    rule: str
    text: str


@dataclass(frozen=True)
class Rule:
    """Rule about one type of subject; its check yields (file, what is wrong)."""

    name: str
    subject: type
    """Type of what the rule is about: the folder, a model, a scene, a view, ..."""
    level: Level
    sentence: str
    """What holds in a correct data set."""
    cure: str
    """How to mend a violation."""
    check: Callable[[Any], Findings]
    unit: str = ""
    """Unit of the deviations, mm or px; empty: the rule is logical and has no tolerance."""


RULES: dict[str, Rule] = {}
"""Declared rules by name, in the order of imports; see `load_rules`."""


def rule(subject: type, name: str, cure: str, level: Level = Level.ERROR, unit: str = "") -> Callable[[_Check], _Check]:
    """Declare the decorated function as the check of a rule, whose sentence is its docstring, about each subject of a type; `name` is words
    joined by hyphens, `cure` how to mend a violation, `unit` that of its deviations, empty: it has none."""

    def declare(check: _Check) -> _Check:
        assert name not in RULES, name
        RULES[name] = Rule(name, subject, level, " ".join((check.__doc__ or "").split()), cure, check, unit)
        return check

    return declare


@cache
def load_rules() -> dict[str, Rule]:
    """Import the modules of the rules; returns all rules by name, in the order of MODULES and of the declarations in each."""
    names = [f"synpick_warp.apps.validation.rules.{module}" for module in MODULES]
    for name in names:
        import_module(name)
    return dict(sorted(RULES.items(), key=lambda item: names.index(item[1].check.__module__)))


def apply_rules(
    subject: object, tolerance: Tolerance | None = None, deviations: list[tuple[str, int, float]] | None = None
) -> Iterator[Violation]:
    """Check a subject by all rules for its type; yields violations. A rule that meets unreadable data ends with a violation about it.

    Deviations up to a tolerance are accepted, and (rule, obj_id, value) of each appended to `deviations`; None: each rule has its bound.
    """
    for item in load_rules().values():
        if item.subject is not type(subject):
            continue
        try:
            for found in item.check(subject):
                if isinstance(found, Deviation):
                    if tolerance is not None and deviations is not None:
                        deviations.append((item.name, found.obj_id, found.value))
                    exceeds = found.wrong if tolerance is None else not found.explained and found.value > getattr(tolerance, item.unit)
                    if not exceeds:
                        continue
                yield Violation(item.level, found[0], item.name, found[1])
        except SynpickError as error:
            yield Violation(Level.ERROR, getattr(subject, "place", "."), item.name, f"cannot be checked: {error}")


class DeviationSummary(NamedTuple):
    """Distribution of the deviations of one rule over the instances of an object, or of all."""

    rule: str
    obj_id: int | None
    """None: all objects."""
    unit: str
    instances: int
    median: float
    percentile_95: float
    largest: float


def distributions(deviations: Mapping[tuple[str, int], Sequence[float]]) -> list[DeviationSummary]:
    """Distributions of deviations by (rule, obj_id): of each rule over all objects, then over each, in the order of the rules."""
    found = []
    for item in load_rules().values():
        parts = {obj_id: np.array(values) for (rule, obj_id), values in sorted(deviations.items()) if rule == item.name}
        if parts:
            every = {None: np.concatenate(list(parts.values()))} | parts
            for obj_id, part in every.items():
                shares = float(np.median(part)), float(np.quantile(part, 0.95)), float(part.max())
                found.append(DeviationSummary(item.name, obj_id, item.unit, len(part), *shares))
    return found


def parse_tolerance(text: str) -> Tolerance:
    """Parse the tolerance MM,PX; raises ConfigError if the text is not two numbers above 0."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != len(UNITS) or not all(np.isfinite(value) and value > 0.0 for value in values):
        raise ConfigError(f"--tolerance is {format_value(text)}; allowed: millimetres, and pixels, above 0, such as 15,3")
    return Tolerance(*values)
