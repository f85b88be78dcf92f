"""The denoiser on synthetic input, and its packed images."""

from typing import Any

import numpy as np
import warp as wp

from synpick_warp.kernels.render.lighting.color import MIN_RADIANCE
from synpick_warp.kernels.render.lighting.denoise import choose_widths_kernel, filter_blocks_kernel, smooth_ratios_kernel
from synpick_warp.kernels.render.lighting.tile_flags import ALL_STAGES, TileFlags
from synpick_warp.scenes.environment import LUMINANCE
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.arrays import allocate_struct
from synpick_warp.stages.render.cameras import build_cameras
from synpick_warp.stages.render.denoised import COARSE_LIGHT, GUIDE, RATIO_IMAGES, build_coarse_grid
from synpick_warp.stages.render.scene import build_grid, pack_half3_array
from synpick_warp.system.hardware.device import pick_device
from tests.harness.aimed_views import aimed_views
from tests.harness.environment import default_device


class FlatDenoiser:
    """The denoiser on coarse pixels of 1 px that all show one plane, which faces the camera at a depth of 1 m.

    Unless tests assign other light, there is none, but unoccluded light of 1.
    """

    def __init__(self, width: int, height: int) -> None:
        device = pick_device(default_device())
        sizes = {"view": 1, "cell_row": height, "cell_column": width}
        matrix = np.array([[100.0, 0.0, width / 2.0], [0.0, 100.0, height / 2.0], [0.0, 0.0, 1.0]])
        self.device, self.count = device, build_grid(width, height).tiles * 32
        self.coarse = build_coarse_grid(build_grid(width, height), 1, 1)
        cameras = build_cameras((Camera(width, height, matrix, np.eye(3), np.zeros(3)),), device)
        self.views = aimed_views([0], [0], 1, cameras, device)
        self.guide = allocate_struct(GUIDE, sizes, device)
        self.show(np.ones((height, width)), np.ones((height, width)))
        self.coarse_light, self.blocks = (allocate_struct(COARSE_LIGHT, sizes, device) for _ in range(2))
        self.chosen, self.ratios = (allocate_struct(RATIO_IMAGES, sizes, device) for _ in range(2))
        self.flags = TileFlags()
        self.flags.stages = wp.full((1, self.count // 32), ALL_STAGES, dtype=wp.uint8, device=device)
        self.flags.history_row = wp.zeros(1, dtype=wp.int32, device=device)
        names = ("diffuse", "specular", "unoccluded_diffuse", "unoccluded_specular", "indirect")
        self.light = {name: np.full((height, width, 3), float(name.startswith("unoccluded"))) for name in names}

    def show(self, segment: np.ndarray, depth: np.ndarray) -> None:
        """Set the guide image: segmentation ids and depth [m] (row, column) of surfaces that face the camera."""
        zero = np.zeros(segment.shape)
        self.guide.surface.assign(np.stack([zero, zero, depth, segment], axis=-1)[None].astype(np.float32))

    def assign(self, name: str, values: np.ndarray) -> None:
        """Set light: (row, column) grey, or (row, column, 3)."""
        self.light[name] = values if values.ndim == 3 else np.repeat(values[..., None], 3, axis=2)

    def run(self, variance_scale: float = 1.0) -> dict[str, np.ndarray]:
        """Denoise: arrays (row, column, 3) by the names of `Ratios` after smoothing, and with the prefix "chosen_" before."""
        for name in ("diffuse", "specular"):
            records = pack_light_array(self.light[name], self.light[f"unoccluded_{name}"])
            getattr(self.coarse_light, name).assign(records[None])
        self.coarse_light.indirect.assign(pack_half3_array(self.light["indirect"][None]))
        shared = [self.coarse, self.guide]
        for kernel, source, rules, out in (
            (filter_blocks_kernel, self.coarse_light, (), self.blocks),
            (choose_widths_kernel, self.blocks, (variance_scale,), self.chosen),
            (smooth_ratios_kernel, self.chosen, (), self.ratios),
        ):
            wp.launch(kernel, self.count, [*shared, source, self.views, self.flags, *rules, 0], [out], device=self.device)
        pairs = (("", self.ratios), ("chosen_", self.chosen))
        return {
            prefix + name: values for prefix, images in pairs for name, values in unpack_ratio_records(images.record.numpy()[0]).items()
        }


def unpack_ratio_records(records: np.ndarray) -> dict[str, np.ndarray]:
    """Light (..., 3) float32 in `RatioImages.record` (..., 3) uint64, by the names of `Ratios`."""
    return {name: unpack_half3_array(records[..., index]) for index, name in enumerate(("diffuse", "specular", "indirect"))}


def pack_light_array(light: np.ndarray, unoccluded: np.ndarray) -> np.ndarray:
    """NumPy twin of the kernels' `pack_light` for single coarse pixels: occluded and unoccluded light (..., 3) in (..., 4) float32."""
    records = np.zeros((*light.shape[:-1], 4), np.float32)
    records.view(np.float16)[..., :6] = np.concatenate([light, unoccluded], axis=-1)
    records[..., 3] = (light @ LUMINANCE) / np.maximum(unoccluded @ LUMINANCE, float(MIN_RADIANCE))
    return records


def guide_segments(guide: Any) -> np.ndarray:
    """Segmentation ids (view, row, column) in the struct `Guide`."""
    return np.abs(guide.surface.numpy()[..., 3]).astype(np.uint8)


def unpack_half3_array(packed: np.ndarray) -> np.ndarray:
    """Values (..., 3) float32 of `pack_half3_array`."""
    return packed[..., None].view(np.float16)[..., :3].astype(np.float32)
