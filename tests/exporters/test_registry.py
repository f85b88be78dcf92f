"""Registry of formats, and the composite of all exporters of a bake."""

from __future__ import annotations

from pathlib import Path

import pytest

from synpick_warp.configs.dataset.export import ExportSettings
from synpick_warp.configs.schema import FORMATS, Config
from synpick_warp.exporters import registry
from synpick_warp.exporters.base import ExportContext
from synpick_warp.exporters.formats import FORMAT_TABLE
from synpick_warp.exporters.registry import Exporters, Needs, load_exporter_classes
from synpick_warp.views.frames import EpisodeEnd


class Fake:
    """Exporter that records its calls and keeps `on_committed` callbacks pending."""

    paths: tuple[str, ...] = ()

    def __init__(self, _: ExportContext | None) -> None:
        self.calls: list[str] = []
        self.pending: list = []

    @staticmethod
    def slot_bytes(_: object) -> int:
        return 7

    @classmethod
    def finalize(cls, *_: object) -> list[Path]:
        return [Path(name) for name in cls.paths]

    def write_constants(self) -> list[Path]:
        return [Path(name) for name in self.paths]

    def write_views(self, batch: str) -> None:
        self.calls.append(batch)

    write_ticks = write_views

    def end_episode(self, end: EpisodeEnd, on_committed) -> None:
        self.pending.append(on_committed)

    def files(self, episode: int) -> list[Path]:
        return [Path(f"{name}/{episode}") for name in self.paths]


class Other(Fake):
    paths = ("b", "a")

    @staticmethod
    def slot_bytes(_: object) -> int:
        return 9


def test_every_format_has_one_class_in_a_fixed_order():
    assert tuple(FORMAT_TABLE) == FORMATS
    classes = load_exporter_classes(("zarr", "bop", "zarr"))
    assert [one.__name__ for one in classes] == ["BopExporter", "TrajectoryExporter"]
    assert load_exporter_classes(FORMATS) == load_exporter_classes(FORMATS[::-1])


def test_episode_is_committed_when_the_last_exporter_has_committed_it():
    both = Exporters((Fake, Other), None)  # type: ignore[arg-type]
    first, second = both._all
    both.write_views("views")
    both.write_ticks("tick")
    assert first.calls == second.calls == ["views", "tick"]
    committed = []
    for episode in (4, 5):
        both.end_episode(EpisodeEnd(episode, 0, 1, 1), lambda episode=episode: committed.append(episode))
    second.pending[1]()
    first.pending[0]()
    assert committed == []
    first.pending[1]()
    assert committed == [5]
    second.pending[0]()
    assert committed == [5, 4]


def test_files_and_slot_size_combine_all_exporters():
    both = Exporters((Fake, Other), None)  # type: ignore[arg-type]
    assert both.files(3) == [Path("a/3"), Path("b/3")]
    assert sorted(both.write_constants()) == [Path("a"), Path("b")]
    assert registry.slot_bytes((Fake, Other), None) == 9  # type: ignore[arg-type]
    assert registry.finalize((Fake, Other), None, None, None, ()) == [Path("a"), Path("b")]  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("formats", "physics", "views", "images", "depth_files"),
    [
        (("bop",), False, True, False, True),
        (("coco",), False, True, False, False),
        (("lerobot",), True, True, True, False),
        (("usd",), False, False, False, False),
        (("zarr", "usd"), True, False, False, False),
        (("zarr", "shards"), True, True, False, True),
    ],
)
def test_needs_are_those_of_all_formats(formats, physics, views, images, depth_files):
    config = Config().with_values({"bake.formats": formats, "cameras.resolution": (64, 48)})
    needs = Needs.of(config)
    assert (needs.physics, needs.views, needs.images, needs.depth_files) == (physics, views, images, depth_files)
    assert needs.slot_bytes == max(one.slot_bytes(ExportSettings.of(config)) for one in needs.classes)
    assert (needs.slot_bytes == 0) == (formats == ("usd",))
