"""Views with their cameras, for kernels that tests launch without a renderer."""

from typing import Any

import numpy as np
import warp as wp

from synpick_warp.kernels.render.visibility.view_setup import aim_cameras_kernel
from synpick_warp.stages.arrays import allocate_struct
from synpick_warp.stages.render.cameras import VIEW_CAMERAS
from synpick_warp.stages.render.view_setup import make_views


def aimed_views(world: Any, camera: Any, instances: int, cameras: Any, device: wp.Device) -> Any:
    """The struct `Views` of worlds and cameras (view), rows of the struct `CameraTable`."""
    rows = (wp.array(np.asarray(values, np.int32), dtype=wp.int32, device=device) for values in (world, camera))
    views = make_views(*rows, len(world), instances, allocate_struct(VIEW_CAMERAS, {"view": len(world)}, device))
    wp.launch(aim_cameras_kernel, dim=len(world), inputs=[cameras], outputs=[views], device=device)
    return views
