"""Path-traced reference renderer."""

from collections.abc import Callable
from typing import Any

from synpick_warp.configs.schema import Render
from synpick_warp.kernels.render.lighting.paths.tracing import COMBINED, PathRules, trace_paths_kernel
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.launch import launch_pixels
from synpick_warp.stages.render.looks import shade_floor
from synpick_warp.stages.render.scene import RenderScene

ROULETTE = 2
"""First bounce with Russian roulette: the first bounces carry most of the light."""


def make_path_rules(render: Render, seed: int, samples: int, roulette: int) -> Any:
    """Make the path tracer's parameters: multiple importance sampling (Veach and Guibas, 1995) and no path regularization."""
    rules = PathRules()
    rules.samples = rules.first_samples = samples
    rules.bounces = render.bounces
    rules.roulette = roulette
    rules.strategy = int(COMBINED)
    rules.seed = seed
    return rules


class ReferenceRenderer:
    """Path tracer for reference images in linear radiance. `shade` only launches kernels."""

    def __init__(self, render: Render, seed: int, scene: RenderScene) -> None:
        """`render`: render settings: `samples` and `bounces`. `seed`: seed of the data set. `scene`: constant data."""
        self.scene = scene
        self.rules = make_path_rules(render, seed, render.samples, ROULETTE)

    def shade(self, snapshot: Snapshot, shot: Any, image: Any, add: Callable[[Any, Any], None] | None = None) -> None:
        """Render the radiance of a batch of views; arguments as of `DenoisedRenderer.shade`. It is anti-aliased. Each path traces its own
        camera ray: the G-buffer is read for the floor alone."""
        scene, pixels = self.scene, shot.views.count * self.scene.grid.tiles * int(TILE_PIXELS)
        launch_pixels(trace_paths_kernel, pixels, [scene.paths, shot, self.rules], [image], scene.device)
        shade_floor(scene, shot, image)
        if add is not None:
            add(shot, image)
