"""Context of the exporters of a conversion: objects and lights are loaded again if a format needs them, and models copied."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from synpick_warp.apps.conversion.source import Source
from synpick_warp.configs.dataset.export import ExportSettings
from synpick_warp.dataset.object_names import names_of
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.base import ExportContext
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.scenes.looks import Looks
from synpick_warp.scenes.types import Catalog, EnvironmentMap


class StoredContext(ExportContext):
    """Context of the exporters that write a converted data set."""

    def __init__(self, source: Source, out: Path, settings: ExportSettings, pool: WriterPool) -> None:
        """
        Args:
            source: The data set that is converted.
            out: See `ExportContext`.
            settings: Settings of the converted data set.
            pool: See `ExportContext`.
        """
        from synpick_warp.scenes.cameras import make_cameras

        super().__init__(out, settings, Catalog(()), make_cameras(settings.rig), (), pool)
        self._source = source

    @cached_property
    def _assets(self) -> tuple[Catalog, tuple[EnvironmentMap, ...], Looks | None]:
        """Objects, lights and textures of the source, loaded again: its models are rounded to millimetres in single precision.

        Raises:
            DatasetError: They are not those that it was baked from.
        """
        from synpick_warp.dataset.commit.digests import digest_inputs
        from synpick_warp.scenes.catalog import load_catalog
        from synpick_warp.scenes.looks import load_looks
        from synpick_warp.stages.render.lamp_variants import load_scene_lights

        source, config = self._source, self._source.config
        catalog = load_catalog(config)
        lights = load_scene_lights(config.bake.lights, config.randomize, config.bake.seed, lambda line: None)
        looks = load_looks(config.randomize, lambda line: None)
        if any(source.inputs.get(name) != digest for name, digest in digest_inputs(catalog, lights, looks).items()):
            raise DatasetError(f"objects, lights or textures of {source.folder} have changed since its bake, but are needed; restore them")
        return catalog, lights, looks

    @property
    def catalog(self) -> Catalog:
        """Objects of the data set, loaded on first use. See `ExportContext`."""
        return self._assets[0]

    @property
    def lights(self) -> tuple[EnvironmentMap, ...]:
        """Environment maps of the data set, loaded on first use. See `ExportContext`."""
        return self._assets[1]

    @property
    def looks(self) -> Looks | None:
        """What episodes draw their looks from, loaded on first use. See `ExportContext`."""
        return self._assets[2]

    @property
    def names(self) -> dict[int, str]:
        """Names by obj_id, sorted: from the zarr store; without one from models and settings, else "obj_NNNNNN". See `ExportContext`."""
        found = names_of(self._source.data)
        return dict(sorted(found.items()))

    def copy_constants(self, names: tuple[Path, ...]) -> bool:
        """Copy these files and folders from the source to the output folder; returns True. See `ExportContext`."""
        self._source.copy_constants(names, self.out)
        return True
