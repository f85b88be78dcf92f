"""Formats by name, and all exporters of a bake as one."""

from __future__ import annotations

from pathlib import Path

import pytest

from synpick_warp.configs.schema import FORMATS
from synpick_warp.errors import ConfigError
from synpick_warp.exporters import registry
from synpick_warp.exporters.base import ExportContext
from synpick_warp.exporters.registry import Exporters, load_exporter_classes
from synpick_warp.frames import EpisodeEnd


class Fake:
    """Remembers its calls; `whole` waits until it is let go."""

    needs_physics = False
    needs_views = False
    kept: tuple[str, ...] = ()

    def __init__(self, _: ExportContext | None) -> None:
        self.calls: list[str] = []
        self.waiting: list = []

    @staticmethod
    def slot_bytes(_: object) -> int:
        return 7

    @classmethod
    def finalize(cls, *_: object) -> list[Path]:
        return [Path(name) for name in cls.kept]

    def write_constants(self) -> list[Path]:
        return [Path(name) for name in self.kept]

    def write_views(self, batch: str) -> None:
        self.calls.append(batch)

    write_ticks = write_views

    def end_episode(self, end: EpisodeEnd, whole) -> None:
        self.waiting.append(whole)

    def files(self, episode: int) -> list[Path]:
        return [Path(f"{name}/{episode}") for name in self.kept]


class Other(Fake):
    needs_physics = True
    needs_views = True
    kept = ("b", "a")

    @staticmethod
    def slot_bytes(_: object) -> int:
        return 9


def test_every_format_has_its_class_once_in_a_fixed_order():
    assert tuple(registry.EXPORTERS) == FORMATS
    kinds = load_exporter_classes(("zarr", "bop", "zarr"))
    assert [kind.__name__ for kind in kinds] == ["BopExporter", "TrajectoryExporter"]
    assert load_exporter_classes(FORMATS) == load_exporter_classes(FORMATS[::-1])


def test_a_writer_that_cannot_be_loaded(monkeypatch):
    monkeypatch.setitem(registry.EXPORTERS, "usd", ("none", "None"))
    with pytest.raises(ConfigError, match=r"bake\.formats names usd, but its writer cannot be loaded: No module named .*none"):
        load_exporter_classes(("bop", "usd"))


def test_an_episode_is_whole_when_the_last_exporter_is_done():
    both = Exporters((Fake, Other), None)  # type: ignore[arg-type]
    first, second = both._all
    assert both.needs_physics
    both.write_views("views")
    both.write_ticks("tick")
    assert first.calls == second.calls == ["views", "tick"]
    whole = []
    for episode in (4, 5):
        both.end_episode(EpisodeEnd(episode, 0, 1, 1), lambda episode=episode: whole.append(episode))
    second.waiting[1]()
    first.waiting[0]()
    assert whole == []
    first.waiting[1]()
    assert whole == [5]
    second.waiting[0]()
    assert whole == [5, 4]


def test_files_and_room_are_those_of_all():
    both = Exporters((Fake, Other), None)  # type: ignore[arg-type]
    assert both.files(3) == [Path("a/3"), Path("b/3")]
    assert sorted(both.write_constants()) == [Path("a"), Path("b")]
    assert registry.slot_bytes((Fake, Other), None) == 9  # type: ignore[arg-type]
    assert registry.finalize((Fake, Other), None, None, None) == [Path("a"), Path("b")]  # type: ignore[arg-type]


def test_views_and_records_are_asked_for_if_one_exporter_wants_them():
    assert [(together.needs_physics, together.needs_views) for together in (Exporters((Fake,), None), Exporters((Fake, Other), None))] == [
        (False, False),
        (True, True),
    ]
    assert [kind.needs_views for kind in load_exporter_classes(FORMATS)] == [name in ("bop", "shards") for name in registry.EXPORTERS]
