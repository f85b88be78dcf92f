"""Exporter of USD scenes: one file per episode, and an asset library that all episodes reference."""

from dataclasses import replace
from functools import cached_property
from pathlib import Path

from synpick_warp.configs.dataset import DataLayout
from synpick_warp.exporters.base import EpisodeExporter, SharedFiles, StagedEpisode
from synpick_warp.exporters.usd import episode as usd_episode
from synpick_warp.exporters.usd.assets import make_stage_light
from synpick_warp.exporters.writing.files import output_errors
from synpick_warp.exporters.writing.pool import WriteTask
from synpick_warp.scenes.bins import TABLE_ROUGHNESS, make_bins
from synpick_warp.scenes.types import Material
from synpick_warp.views.frames import EpisodeEnd, TickBatch

FOLDER = Path("usd")
"""Folder in the data set."""
LIBRARY = FOLDER / "assets"
_SPOOL = "ticks"
"""Name of the spool file in an episode's staging folder."""


class UsdExporter(EpisodeExporter[usd_episode.TickSpool]):
    """`Exporter` of USD. Episode k becomes usd/k.usdc, which references usd/assets.

    An episode's ticks are spooled to a hidden file, from which a writer process makes the episode's file when it has ended.
    """

    staging = FOLDER.name

    @staticmethod
    def shared_files(layout: DataLayout) -> SharedFiles:
        return SharedFiles((LIBRARY,), (), (FOLDER,))

    def write_constants(self) -> list[Path]:
        from synpick_warp.exporters.usd.assets import write_library  # pxr loads slowly, and only this method needs it.

        library = self._context.out / LIBRARY
        with output_errors(library):
            for folder in (library.parent, library):
                folder.mkdir(exist_ok=True)
            write_library(library, self._context)
        return [LIBRARY]

    def write_ticks(self, batch: TickBatch) -> None:
        instances = batch.object_id.shape[1]
        for index, row in zip(batch.episode.tolist(), usd_episode.tick_rows(batch), strict=True):
            spool = self._staged(index, lambda folder: usd_episode.TickSpool(folder / _SPOOL, instances)).content
            with output_errors(spool.path):
                spool.add(row)

    def _commit(self, episode: StagedEpisode[usd_episode.TickSpool], end: EpisodeEnd) -> WriteTask:
        spool, place = episode.content, self._context.out / self.places(end.episode)[0]
        with output_errors(spool.path):
            spool.flush()
        return WriteTask(
            usd_episode.write_episode, (), (spool.path, spool.instances, place, replace(end, attempts=()), self._settings), place
        )

    def places(self, episode: int) -> tuple[Path]:
        return (FOLDER / f"{episode:06d}.usdc",)

    @cached_property
    def _settings(self) -> usd_episode.UsdSettings:
        context = self._context
        settings = context.settings
        return usd_episode.UsdSettings(
            tick_rate=1.0 / settings.physics.tick_time,
            gravity=settings.physics.gravity,
            bins=tuple(usd_episode.bin_asset(sizes) if sizes.is_visible else None for sizes in settings.bins),
            cameras=context.cameras,
            lights=tuple(make_stage_light(index, light, settings.render.exposure) for index, light in enumerate(context.lights)),
            names={body.obj_id: body.name for body in context.catalog.bodies},
            props=tuple((prop.name, prop.pose, prop.follows) for prop in context.catalog.props),
            surfaces=self._surfaces() if context.looks else {},
        )

    def _surfaces(self) -> dict[str, usd_episode.AssetSurface]:
        """Materials of the objects, bins and the table, by asset."""
        settings, bodies = self._context.settings, self._context.catalog.bodies
        materials = {usd_episode.object_asset(body.obj_id): body.material for body in bodies}
        materials |= {usd_episode.bin_asset(one.sizes): one.fixture.material for one in make_bins(settings.bins)}
        materials["floor"] = usd_episode.FLOOR
        materials["table"] = Material(settings.render.table_color, None, 0.0, TABLE_ROUGHNESS)
        return {name: usd_episode.AssetSurface.of(name, material) for name, material in materials.items()}
