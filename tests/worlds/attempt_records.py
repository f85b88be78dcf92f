"""Records of attempts, as attempts.jsonl has them, for data sets made of boxes."""

from __future__ import annotations

from typing import Any

from synpick_warp.apps.viz.explain_record import SeenAttempt
from synpick_warp.dataset.records import InstanceObservation, RecordedObservation


def seen_object(instance: int, object_id: int, suction: tuple[float, float], **other: Any) -> dict[str, Any]:
    """An entry of perception.instances; its three candidates lie beside each other, the suction point is the pole."""
    column, row = suction
    entry = {
        "instance": instance,
        "object_id": object_id,
        "visible": 100,
        "visible_fraction": 0.5,
        "pole": [column, row],
        "centroid": [column + 8.0, row],
        "midpoint": [column + 4.0, row],
        "distances": [6.0, 3.0, 5.1],
        "grasp_pixel": [round(column), round(row)],
        "depth": 1.4,
        "above": [],
        "ancestors": [],
    }
    return entry | other


def record(seen: list[dict[str, Any]], **other: Any) -> dict[str, Any]:
    """A line of attempts.jsonl: attempt 0 of episode 0, from image 0, that picked the first object of those given."""
    target = seen[0]["instance"] if seen else None
    line = {
        "episode": 0,
        "attempt": 0,
        "mode": "pick",
        "frame": 0,
        "end_frame": 4,
        "outcome": "target_picked",
        "sentence": "the target hung on the cup after the lift",
        "target": target,
        "object_id": seen[0]["object_id"] if seen else None,
        "point": [0.0, 0.0, 0.1],
        "normal": [0.0, 0.0, 1.0],
        "yaw": 0.0,
        "tilt": 0.2,
        "rays": 10,
        "hits": 10 if seen else 0,
        "good_seal": bool(seen),
        "engaged": [target] if seen else [],
        "picked": [target] if seen else [],
        "peak_force": [0.0, 20.0, 20.0, 20.0] if seen else [],
        "observation": {"resolution": [96, 72], "instances": seen, "votes": []},
    }
    return line | other


def nothing_seen(**other: Any) -> dict[str, Any]:
    """The line of an attempt that ended before it began."""
    gone = {
        "sentence": "no object in the tote is visible",
        "outcome": "nothing_seen",
        "point": None,
        "normal": None,
        "yaw": None,
        "tilt": None,
    }
    return record([]) | gone | other


def attempt(
    seen: tuple[InstanceObservation, ...], votes: dict[tuple[int, int], float], target: int | None = None, **other: Any
) -> SeenAttempt:
    """An attempt as `read_attempts` returns it, with the graph that is given."""
    observation = RecordedObservation((96, 72), list(seen), [(*edge, number) for edge, number in votes.items()])
    values: dict[str, Any] = {"sentence": "s", "target": target, "tilt": None, "hits": 10, "good_seal": True}
    return SeenAttempt(**record([], **values | other, observation=observation))


def seen(instance: int, above: frozenset[int] = frozenset(), ancestors: frozenset[int] | None = None, **other: Any) -> InstanceObservation:
    """A seen object as `read_attempts` returns it; its obj_id is its instance plus 1."""
    graph = {"above": sorted(above), "ancestors": sorted(above if ancestors is None else ancestors)}
    return InstanceObservation(**seen_object(instance, instance + 1, (10.0, 10.0)) | graph | other)
