"""Launcher of observations: images of a batch go to the device; crops and surface points of each instance come from them."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from synpick_warp.kernels.pose.observation import (
    CROP,
    Images,
    Observation,
    Targets,
    clear_boxes_kernel,
    find_boxes_kernel,
    find_nearest_kernel,
    find_row_nearest_kernel,
    place_crops_kernel,
    sample_crops_kernel,
)
from synpick_warp.kernels.pose.points import count_points_kernel, sample_points_kernel, summarize_points_kernel
from synpick_warp.scenes.assets.appearance import srgb_to_linear
from synpick_warp.stages.arrays import allocate_struct, struct_arrays
from synpick_warp.stages.pose.batch import InstanceTable, RgbdBatch

LABELS = 256
"""Values of a label image."""
IMAGES = struct_arrays(
    Images,
    "view",
    "row",
    "column",
    depth_scale=("view",),
    intrinsics=("view",),
    linear=("level",),
    units={"depth_scale": "m", "intrinsics": "px"},
)
TARGETS = struct_arrays(Targets, "instance", row=("view", "label"))
OBSERVATION = struct_arrays(
    Observation,
    "instance",
    box=("instance", "side"),
    inside=("instance", "crop_row", "crop_column"),
    color=("instance", "crop_row", "crop_column"),
    nearest=("instance", "crop_row", "crop_column"),
    row_nearest=("instance", "crop_row", "crop_column"),
    row_points=("instance", "crop_row"),
    point=("instance", "point"),
    normal=("instance", "point"),
    gray=("instance", "point"),
    units={"box": "px", "pixels": "px", "corner": "px", "pitch": "px", "nearest": "crop px", "point": "m", "area": "m²", "centroid": "m"},
)


class Observer:
    """Uploads batches of views and observes their instances. Owns all arrays; the structs are valid until the next batch.

    Attributes:
        images: The struct `Images`.
        targets: The struct `Targets`.
        observation: The struct `Observation`.
        instances: Number of instances N.
    """

    def __init__(self, table: InstanceTable, views: int, height: int, width: int, points: int, device: wp.Device) -> None:
        """
        Args:
            table: The instances.
            views: Number of views in a batch.
            height: Of the images [px].
            width: Of the images [px].
            points: Maximum number of surface points of an instance.
            device: Where to compute.
        """
        self.device, self.instances = device, len(table.view)
        self.images = allocate_struct(IMAGES, {"view": views, "row": height, "column": width, "level": 256}, device)
        self.images.width, self.images.height = width, height
        self.images.linear.assign(srgb_to_linear(np.arange(256) / 255.0).astype(np.float32))
        self.targets = make_targets(table, views, device)
        crop = int(CROP)
        sizes = {"instance": self.instances, "side": 4, "crop_row": crop, "crop_column": crop, "point": points}
        self.observation = allocate_struct(OBSERVATION, sizes, device)

    def observe(self, batch: RgbdBatch) -> None:
        """Upload a batch, and launch the kernels that compute its observation."""
        images, targets, observation, device = self.images, self.targets, self.observation, self.device
        images.color.assign(batch.color)
        images.depth.assign(batch.depth)
        images.label.assign(batch.label)
        images.depth_scale.assign(batch.depth_scale)
        images.intrinsics.assign(batch.intrinsics)
        n, crop = self.instances, int(CROP)
        box, pixels = observation.box, observation.pixels
        wp.launch(clear_boxes_kernel, dim=n, inputs=[images], outputs=[box, pixels], device=device)
        rows = (images.label.shape[0], images.height)
        wp.launch(find_boxes_kernel, dim=rows, inputs=[images, targets], outputs=[box, pixels], device=device)
        outputs = [observation.corner, observation.pitch]
        wp.launch(place_crops_kernel, dim=n, inputs=[box], outputs=outputs, device=device)
        wp.launch(sample_crops_kernel, dim=(n, crop, crop), inputs=[images, targets], outputs=[observation], device=device)
        wp.launch(count_points_kernel, dim=(n, crop), inputs=[images, targets], outputs=[observation], device=device)
        wp.launch(sample_points_kernel, dim=(n, crop), inputs=[images, targets], outputs=[observation], device=device)
        wp.launch(summarize_points_kernel, dim=n, inputs=[images, targets], outputs=[observation], device=device)
        inside, row_nearest = observation.inside, observation.row_nearest
        wp.launch(find_row_nearest_kernel, dim=(n, crop), inputs=[pixels, inside], outputs=[row_nearest], device=device)
        outputs = [observation.nearest]
        wp.launch(find_nearest_kernel, dim=(n, crop, crop), inputs=[pixels, row_nearest], outputs=outputs, device=device)


def make_targets(table: InstanceTable, views: int, device: wp.Device) -> Any:
    """Build the struct `Targets` of an instance table."""
    targets = allocate_struct(TARGETS, {"instance": len(table.view), "view": views, "label": LABELS}, device)
    row = np.full((views, LABELS), -1, np.int32)
    row[table.view, table.slot + 1] = np.arange(len(table.view))
    targets.view.assign(table.view)
    targets.label.assign((table.slot + 1).astype(np.int32))
    targets.model.assign(table.model)
    targets.row.assign(row)
    return targets
