"""Broad phase of collision detection for worlds of many empty slots, in place of Newton's."""

from collections.abc import Callable
from typing import Any, cast

import newton
import numpy as np
import warp as wp

from synpick_warp.kernels.newton_patches import broad_phase

BLOCK = 512
"""Threads per world that list overlapping bounding boxes; on a CPU one."""
SHAPE_BLOCK = 128
"""Block size of a launch with a thread for each shape."""
SEPARATION_BLOCK = 32
"""Block size of the test of separating axes, whose threads wait for the vertices of their hulls: few worlds use all multiprocessors so."""
SEPARATION_THREADS = 128
"""Threads per world that test separating axes, about one per overlap (130 per world in real piles); a grid-stride loop over all worlds'."""
MANY_SHAPES = 256
"""Shapes of a world above which each has a thread, instead of each world a block: worlds of the presets for few objects have up to 207."""
EMPTY = 1.0
"""Bound of empty bounding boxes: their lower corner is at +EMPTY, their upper one at -EMPTY [m]."""


class SeparatingBroadPhase(newton.geometry.BroadPhaseAllPairs):
    """All-pairs broad phase that skips empty shapes and rejects pairs by cached separating axes; a drop-in replacement for Newton's.

    Contacts are the same: a pair is rejected only if its shapes are farther apart than their gaps and margins. Newton's broad phase runs
    once, to find which pairs may collide at all; collision groups and body flags must not change later. Only for models of identical
    worlds; see `replace_broad_phase`.

    `overlap_count` is the number of pairs whose bounding boxes overlap (one) int32; those beyond the capacity for pairs are dropped.
    `choose` lists those of these pairs (overlap) vec2i, and their number (one) int32, that may have contacts; None: all may."""

    def __init__(self, pipeline: newton.CollisionPipeline) -> None:
        # The pipeline itself is not kept: a cycle of references would keep its arrays until a garbage collection.
        model, device = pipeline.model, pipeline.device
        worlds = model.world_count
        shapes = broad_phase.ShapeData()
        shapes.count = model.shape_count // worlds
        shapes.box, shapes.hull = int(newton.GeoType.BOX), int(newton.GeoType.CONVEX_MESH)
        shapes.kind, shapes.mesh, shapes.gap = model.shape_type, model.shape_source_ptr, model.shape_gap
        shapes.collides = wp.array(find_colliding(pipeline, shapes.count), dtype=wp.uint8, device=device)
        self._shapes, self._poses, self._geometry = shapes, pipeline.geom_transform, pipeline.geom_data
        self._occupied = wp.zeros((worlds, shapes.count), dtype=wp.int32, device=device)
        self._occupied_count = wp.zeros(worlds, dtype=wp.int32, device=device)
        self._overlaps = wp.zeros(pipeline.broad_phase_shape_pairs.shape[0], dtype=wp.vec2i, device=device)
        self.overlap_count = wp.zeros(1, dtype=wp.int32, device=device)
        self.choose: Callable[[wp.array, wp.array], tuple[wp.array, wp.array]] | None = None
        self._axes = wp.zeros((worlds, shapes.count * (shapes.count - 1) // 2), dtype=wp.uint32, device=device)

    def launch(  # pyright: ignore[reportIncompatibleMethodOverride]  # Newton passes further arguments by keyword.
        self,
        shape_lower: wp.array,
        shape_upper: wp.array,
        shape_gap: wp.array | None,
        shape_collision_group: wp.array,
        shape_world: wp.array,
        shape_count: int,
        candidate_pair: wp.array,
        candidate_pair_count: wp.array,
        **options: Any,
    ) -> None:
        """Launch the broad phase: write the candidate pairs of shapes (pair) vec2i for the narrow phase, and their number, which must be
        zero before (one) int32. Bounding boxes (shape) [m] are enlarged by the shapes' gaps and margins already; other arguments of
        Newton's `launch` are ignored."""
        shapes, device, worlds = self._shapes, candidate_pair.device, self._occupied.shape[0]
        self.overlap_count.zero_()
        boxes, lists = [shapes, shape_lower, shape_upper], [self._occupied, self._occupied_count]
        overlaps = [self._overlaps, self.overlap_count]
        if shapes.count > MANY_SHAPES:
            self._occupied_count.zero_()
            dim = worlds, shapes.count
            wp.launch(broad_phase.list_occupied_kernel, dim=dim, inputs=boxes, outputs=lists, device=device)
            inputs = [*boxes, *lists]
            wp.launch(
                broad_phase.list_overlaps_of_shapes_kernel, dim=dim, inputs=inputs, outputs=overlaps, block_dim=SHAPE_BLOCK, device=device
            )
        else:
            wp.launch_tiled(
                broad_phase.list_overlaps_kernel,
                dim=[worlds],
                inputs=boxes,
                outputs=[*lists, *overlaps],
                block_dim=BLOCK if device.is_cuda else 1,
                device=device,
            )
        threads = worlds * SEPARATION_THREADS if device.is_cuda else 1
        chosen = (self._overlaps, self.overlap_count) if self.choose is None else self.choose(self._overlaps, self.overlap_count)
        inputs = [shapes, threads, self._axes, self._poses, self._geometry, shape_lower, shape_upper, *chosen]
        wp.launch(
            broad_phase.reject_separated_kernel,
            dim=threads,
            inputs=inputs,
            outputs=[candidate_pair, candidate_pair_count],
            block_dim=SEPARATION_BLOCK,
            device=device,
        )


def replace_broad_phase(pipeline: newton.CollisionPipeline) -> None:
    """Replace Newton's all-pairs broad phase in a pipeline of identical worlds; any other pipeline keeps its own."""
    if isinstance(pipeline.broad_phase, newton.geometry.BroadPhaseAllPairs) and has_identical_worlds(pipeline.model):
        pipeline.broad_phase = SeparatingBroadPhase(pipeline)


def has_identical_worlds(model: newton.Model) -> bool:
    """Whether shapes are stored world by world, with the same local bodies and collision groups in every world.

    Body flags and excluded pairs are assumed to be the same, too.
    """
    worlds = model.world_count
    if not worlds or model.shape_count % worlds:
        return False
    world, body, group = (array.numpy().reshape(worlds, -1) for array in (model.shape_world, model.shape_body, model.shape_collision_group))
    local = np.where(body < 0, -1, body - np.arange(worlds)[:, None] * (model.body_count // worlds))
    return bool((world == np.arange(worlds)[:, None]).all() and (local == local[0]).all() and (group == group[0]).all())


def find_colliding(pipeline: newton.CollisionPipeline, count: int) -> np.ndarray:
    """Collision filter of a world, for a lower and a higher index of its `count` shapes (shape, shape) bool: True if the pair may collide.

    Found by a run of Newton's broad phase, which the pipeline has, on bounding boxes that all overlap in the first world, and are empty in
    the others."""
    model, newtons = pipeline.model, cast(newton.geometry.BroadPhaseAllPairs, pipeline.broad_phase)
    corner = np.full((model.shape_count, 3), EMPTY, np.float32)
    corner[:count] = -EMPTY
    lower, upper = (wp.array(corners, dtype=wp.vec3, device=pipeline.device) for corners in (corner, -corner))
    pairs = wp.zeros(count * (count - 1) // 2, dtype=wp.vec2i, device=pipeline.device)
    found = wp.zeros(1, dtype=wp.int32, device=pipeline.device)
    newtons.launch(
        lower,
        upper,
        None,
        model.shape_collision_group,
        model.shape_world,
        model.shape_count,
        pairs,
        found,
        shape_body=model.shape_body,
        body_flags=model.body_flags,
        include_static_kinematic_pairs=pipeline.include_static_kinematic_pairs,
        device=pipeline.device,
        filter_pairs=pipeline.shape_pairs_excluded,
        num_filter_pairs=pipeline.shape_pairs_excluded_count,
    )
    listed = pairs.numpy()[: int(found.numpy()[0])]
    colliding = np.zeros((count, count), bool)
    colliding[tuple(listed.T)] = True
    return colliding
