"""Declarations of arrays, with which allocation and memory table agree; arguments of launches and members of structs, found by names."""

import contextlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import pytest
import warp as wp

from synpick_warp.configs.schema import LAYERS
from synpick_warp.kernels.structs import ModeData
from synpick_warp.stages.arrays import Row, StructArrays, allocate, allocate_struct, array_group, device_array, dry_run, struct_arrays
from synpick_warp.stages.buffers import view_buffer_sizes
from synpick_warp.stages.constants import fill
from synpick_warp.stages.launch import launch
from synpick_warp.stages.online.batches import allocate_slot
from synpick_warp.stages.perception.images import allocate_batch, count_views
from synpick_warp.stages.perception.perceive import allocate_votes
from synpick_warp.stages.render.denoised import scratch_sizes
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.sampling_rates import FIRST_FRAME_PATHS, first_frame_paths, paths_per_coarse_pixel
from synpick_warp.stages.render.scene import blank_scene
from synpick_warp.stages.sim.physics import MIN_GPU_WORLDS
from synpick_warp.stages.sim.simulate import allocate_worlds
from synpick_warp.stages.sim.step_log import allocate_record, record_sizes
from synpick_warp.stages.sim.worlds import world_sizes
from synpick_warp.stages.view_ring import RING, TransferSettings, allocate_ring
from synpick_warp.system.hardware.device import pick_device
from tests.harness.memory_tables import device_arrays, queued_ticks
from tests.worlds.small_worlds import settings

WORLDS = MIN_GPU_WORLDS + 1
NAMES = (
    "WorldState AttemptState SealState LastFrame Observation Plan WorldStatus Snapshot ViewBuffers ViewBodies GBuffer ShadedImage "
    "BoundaryBuffers BoundaryScratch Guide CoarseLight RatioImages LampShadows ShadowRays EdgeLists FootprintLists VisibilityBuffer "
    "CameraTable BorderBoxes BorderCounts KeptMasks Damage KeptColors KeptSources LightHistory MovingBodies PathLists PathQueues "
    "DepthBuffers DepthScratch SlotSums TileFlags"
)
BASE = set(NAMES.split())
"""Declarations of which every bake has arrays."""
PERCEPTION = {"Views", "PerceptionArrays", "SegmentationScratch", "VoteArrays", "Cycles"}


@dataclass(frozen=True, eq=False)
class Sample:
    gap: wp.array = device_array("world", "cup", dtype=wp.float32, unit="m")
    pose: wp.array = device_array("world", dtype=wp.transformf)
    flag: wp.array = device_array("cup", "cup", "world", dtype=wp.uint8)


def table_of(kind: Any, sizes: dict[str, int], only: Sequence[str] | None = None) -> list[Row]:
    """Rows of a dry run."""
    nowhere: Any = None
    with dry_run() as arrays:
        allocate_struct(kind, sizes, nowhere) if isinstance(kind, StructArrays) else allocate(kind, sizes, nowhere, only)
    return [array.row for array in arrays]


def test_allocated_arrays_have_declared_shapes_and_types_and_are_zero(device):
    made = allocate(Sample, {"world": 3, "cup": 2}, device)
    assert [made.gap.shape, made.pose.shape, made.flag.shape] == [(3, 2), (3,), (2, 2, 3)]
    assert [made.gap.dtype, made.pose.dtype, made.flag.dtype] == [wp.float32, wp.transformf, wp.uint8]
    assert all(array.device == device and not array.numpy().any() for array in (made.gap, made.pose, made.flag))


def test_a_dry_run_counts_bytes_and_allocates_nothing():
    rows = table_of(Sample, {"world": 3, "cup": 2})
    assert rows == [("Sample.gap", (3, 2), "m", 24), ("Sample.pose", (3,), "", 84), ("Sample.flag", (2, 2, 3), "", 12)]
    huge = table_of(Sample, {"world": 10**9, "cup": 1000})
    assert huge[0][3] == 4 * 10**12


def test_a_dry_run_is_that_of_its_thread_and_ends(device):
    """A stream of another thread allocates meanwhile; after an error, too, arrays are allocated again."""
    sizes = {"world": 3, "cup": 2}
    with contextlib.suppress(ZeroDivisionError), ThreadPoolExecutor(1) as other, dry_run() as arrays:
        assert isinstance(other.submit(allocate, Sample, sizes, device).result().pose, wp.array)
        assert not arrays
        raise ZeroDivisionError
    assert isinstance(allocate(Sample, sizes, device).pose, wp.array)
    assert not arrays


def test_a_dry_run_lists_what_the_same_calls_allocate(device, monkeypatch):
    """Shapes and sizes of the arrays of all stages, in small."""
    config = settings(render__layers=list(LAYERS), effects__blur=[0.0, 1.0], bake__worlds=2)
    rooms, layers, room = config.perception, config.render.layers, config.arrangement.max_objects

    def build() -> None:
        sizes = record_sizes(world_sizes(2, room, 3, 4, 1), 5)
        allocate_worlds(sizes, device)
        allocate_record(sizes, device, steps=True, supports=True)
        sections = (config.render, config.effects, config.depth_sensor)
        Renderer(blank_scene(3, 40, 24, device), *sections, seed=0, depth_scale=0.1, instances=room, views=4, histories=6)
        allocate_ring(view_buffer_sizes(4, 40, 24, room), layers, TransferSettings(jpeg_quality=95, depth_files=True), device)
        allocate_slot(view_buffer_sizes(4, 40, 24, room), layers, device)
        allocate_batch(rooms, room, 2, device)
        allocate_votes(rooms, room, 2, device)

    with dry_run() as arrays:
        build()
    made: list[wp.array] = []
    zeros = wp.zeros
    monkeypatch.setattr(wp, "zeros", lambda *shape, **rest: made.append(zeros(*shape, **rest)) or made[-1])
    build()
    assert {array.name.split(".")[0] for array in arrays} > BASE | PERCEPTION | {"LayerBuffers", "BodyMotions", "LensArrays", "JpegScratch"}
    assert [(array.shape, array.row[3]) for array in arrays] == [(array.shape, array.numpy().nbytes) for array in made]


@wp.struct
class SampleStruct:
    gap: wp.array2d[float]
    pose: wp.array[wp.transformf]
    count: int


def test_struct_arrays_have_the_types_of_the_struct_and_declared_dimensions(device):
    declared = struct_arrays(SampleStruct, "world", "cup", pose=("world",), units={"gap": "m"})
    struct = allocate_struct(declared, {"world": 3, "cup": 2}, device)
    assert (struct.gap.shape, struct.pose.shape, struct.count) == ((3, 2), (3,), 0)
    assert (struct.gap.dtype, struct.pose.dtype) == (wp.float32, wp.transformf)
    assert table_of(declared, {"world": 3, "cup": 2}) == [("SampleStruct.gap", (3, 2), "m", 24), ("SampleStruct.pose", (3,), "", 84)]


@pytest.mark.parametrize(
    ("shape", "others", "message"),
    [
        (("world", "cup"), {}, "SampleStruct.pose has 1 dimensions, not 2: world, cup"),
        (("world", "cup"), {"pose": ("world",), "count": ("world",)}, "SampleStruct has no array count"),
    ],
)
def test_dimensions_that_contradict_the_struct_are_an_error(shape, others, message):
    with pytest.raises(TypeError, match=message):
        struct_arrays(SampleStruct, *shape, **others)


def kinds_of(rows: list[Row]) -> set[str]:
    """Names of the declarations that a table lists."""
    return {name.removeprefix("queued ").split(".")[0] for name, *_ in rows}


def test_a_bakes_table_lists_every_array_with_its_copies():
    config = settings(bake__worlds=WORLDS, cameras__resolution=[8, 6], render__views_per_batch=3)
    rows = device_arrays(config)
    names = [name for name, *_ in rows]
    assert kinds_of(rows) == BASE
    assert names.count("Observation.votes") == names.count("Plan.target") == names.count("WorldStatus.table") == 1
    assert names.count("Snapshot.pose") == names.count("queued Snapshot.pose") == names.count("WorldState.phase") == 1
    assert names.count("ViewBuffers.color") == (RING if pick_device(config.bake.device).is_cuda else 1)
    by_name = {name: (shape, unit, size) for name, shape, unit, size in rows}
    assert by_name["Snapshot.pose"] == ((WORLDS, config.arrangement.max_objects), "m", 28 * WORLDS * config.arrangement.max_objects)
    assert by_name["queued Snapshot.pose"][0] == (queued_ticks(config) * WORLDS, config.arrangement.max_objects)
    assert by_name["ViewBuffers.color"] == ((3, 6, 8), "", 3 * 6 * 8 * 3)


@pytest.mark.parametrize(
    ("cell", "width", "shape"),
    [(0, 8, (6, 8, 6, 8)), (0, 960, (3, 480, 3, 480)), (0, 1920, (2, 384, 2, 384)), (3, 8, (2, 3, 2, 3)), (64, 8, (1,) * 4)],
)
def test_coarse_pixels_cover_the_image(cell, width, shape):
    sizes = scratch_sizes(settings(render__coarse_pixel=cell).render, width, 6)
    assert tuple(sizes[name] for name in ("cell_row", "cell_column", "shadow_row", "shadow_column")) == shape


@pytest.mark.parametrize(
    ("cell", "width", "histories", "columns", "paths"),
    [
        (0, 320, 0, 320, 2),
        (0, 480, 0, 480, 2),
        (0, 481, 0, 481, 1),
        (0, 640, 0, 640, 1),
        (0, 960, 0, 480, 2),
        (0, 1920, 0, 384, 2),
        (1, 1920, 0, 1920, 1),
        (0, 1920, 3, 480, 1),
        (0, 960, 3, 480, 2),
        (0, 640, 3, 640, 1),
        (0, 320, 3, 320, 2),
        (5, 1920, 3, 384, 2),
    ],
)
def test_coarse_pixels_and_their_paths_depend_on_the_resolution_and_on_histories(cell, width, histories, columns, paths):
    render = settings(render__coarse_pixel=cell).render
    assert scratch_sizes(render, width, 6, histories)["cell_column"] == columns
    assert paths_per_coarse_pixel(render, width, histories) == paths
    assert paths_per_coarse_pixel(replace(render, coarse_paths=5), width, histories) == 5
    assert first_frame_paths(render, width, histories) == (FIRST_FRAME_PATHS if histories else paths)
    # Without accumulation they are those of single views.
    alone = replace(render, history=0)
    assert scratch_sizes(alone, width, 6, histories) == scratch_sizes(render, width, 6)
    assert first_frame_paths(alone, width, histories) == paths_per_coarse_pixel(render, width)


def test_first_frames_trace_no_more_paths_than_a_history_counts():
    assert first_frame_paths(settings(render__history=6).render, 320, 3) == 6
    assert first_frame_paths(settings(render__coarse_paths=5).render, 320, 3) == 5
    assert first_frame_paths(settings().render, 320) == 2


def test_the_path_traced_reference_has_no_coarse_grid():
    names = {name.split(".")[0] for name, *_ in device_arrays(settings(render__mode="reference"))}
    assert "ShadedImage" in names
    assert not names & {"Guide", "CoarseLight", "RatioImages", "LampShadows"}


@pytest.mark.parametrize("mode", [{"bake__mode": "target"}, {"bake__mode": "mixed", "bake__mix": [1, 0, 3]}])
def test_a_bake_has_the_arrays_of_perception_if_it_may_pick(mode):
    assert kinds_of(device_arrays(settings(bake__mode="mixed", bake__mix=[0, 0, 1]))) == BASE
    config = settings(bake__worlds=WORLDS, perception__resolution=[64, 48], **mode)
    room = config.arrangement.max_objects
    looks = count_views(config.perception, config.bake.worlds, room, pick_device(config.bake.device))
    rows = device_arrays(config)
    assert kinds_of(rows) == BASE | PERCEPTION
    shapes = {name: shape for name, shape, _, _ in rows if name.split(".")[0] in PERCEPTION}
    assert shapes["PerceptionArrays.component"] == shapes["SegmentationScratch.gap"] == (looks, 48, 64)
    assert shapes["VoteArrays.count"] == (looks, room, room, 2)
    assert [name for name, *_ in rows].count("GBuffer.depth") == 4


def test_fields_left_out_are_neither_allocated_nor_counted_and_a_missing_extent_is_an_error(device):
    made = allocate(Sample, {"world": 3, "cup": 2}, device, only=("pose",))
    assert (made.gap, made.flag) == (None, None)
    assert made.pose.shape == (3,)
    assert table_of(Sample, {"world": 3}, only=("pose",)) == [("Sample.pose", (3,), "", 84)]
    with pytest.raises(KeyError, match="cup"):
        allocate(Sample, {"world": 3}, device)


def test_the_memory_table_lists_the_layers_of_the_settings():
    rows = {name: (shape, unit, size) for name, shape, unit, size in device_arrays(settings(render__layers=["flow", "nocs"]))}
    assert {name for name in rows if name.startswith("LayerBuffers")} == {"LayerBuffers.flow", "LayerBuffers.nocs"}
    assert rows["LayerBuffers.flow"][1] == "px"
    assert "BodyMotions.rotation" in rows
    assert not any(name.startswith("BodyMotions") for name, *_ in device_arrays(settings(render__layers=["nocs"])))


# ---- launches ----


@wp.kernel
def add_kernel(first: wp.array[int], count: int, second_inout: wp.array[int], first_out: wp.array[int]):
    index = wp.tid()
    second_inout[index] += count
    first_out[index] = first[index] + count


@wp.struct
class Pair:
    left: wp.array[int]
    right: wp.array[int]


@wp.kernel
def swap_kernel(pair_inout: Pair):
    index = wp.tid()
    left = pair_inout.left[index]
    pair_inout.left[index] = pair_inout.right[index]
    pair_inout.right[index] = left


class PairArrays(array_group(Pair, "place")):
    """The arrays of `Pair`."""


def numbers(*values: int) -> wp.array:
    return wp.array(values, dtype=wp.int32, device="cpu")


def test_arguments_are_found_by_name_and_outputs_in_their_object():
    one, two, out = SimpleNamespace(first=numbers(1, 2)), SimpleNamespace(second=numbers(5, 6)), SimpleNamespace(first=numbers(0, 0))
    launch(add_kernel, 2, one, two, out=out, count=10)
    assert [array.numpy().tolist() for array in (one.first, two.second, out.first)] == [[1, 2], [15, 16], [11, 12]]
    launch(add_kernel, 2, one, count=1, second_inout=two.second, first_out=out.first)
    assert [array.numpy().tolist() for array in (one.first, two.second, out.first)] == [[1, 2], [16, 17], [2, 3]]


def test_structs_are_groups_of_arrays_or_bundles_of_attributes():
    group = PairArrays(numbers(1, 2), numbers(3, 4))
    launch(swap_kernel, 2, SimpleNamespace(left=numbers(7, 7)), group)
    assert [array.numpy().tolist() for array in (group.left, group.right)] == [[3, 4], [1, 2]]
    halves = SimpleNamespace(left=group.left), SimpleNamespace(right=group.right)
    launch(swap_kernel, 1, *halves)
    assert [array.numpy().tolist() for array in (group.left, group.right)] == [[1, 4], [3, 2]]
    with pytest.raises(TypeError, match=r"swap_kernel: no source has Pair\.right"):
        launch(swap_kernel, 1, halves[0])


def test_missing_ambiguous_and_unknown_arguments_are_errors():
    one, both = SimpleNamespace(first=numbers(1)), SimpleNamespace(first=numbers(1), second=numbers(2))
    for sources, given, message in (
        ((one,), {}, "0 sources have second"),
        ((one, both), {}, "2 sources have first"),
        ((both,), {"other": 1}, "no parameter other"),
    ):
        with pytest.raises(TypeError, match=message):
            launch(add_kernel, 1, *sources, count=1, **given)


def test_derived_values_come_before_sections_and_earlier_sections_before_later():
    first, second = SimpleNamespace(first=0, pick_share=0.25, cycle=0, still=0), SimpleNamespace(pick_share=0.5, pick_or_target_share=0.75)
    result = fill(ModeData, first, second)
    assert (float(result.pick_share), float(result.pick_or_target_share)) == (0.25, 0.75)
    assert float(fill(ModeData, first, second, pick_share=1.0).pick_share) == 1.0


def test_missing_and_unknown_members_are_errors():
    with pytest.raises(AttributeError, match=r"no value for ModeData\.pick_or_target_share"):
        fill(ModeData, first=0, pick_share=0.5, cycle=0)
    with pytest.raises(TypeError, match="wrong_name"):
        fill(ModeData, first=0, pick_share=0.5, pick_or_target_share=0.5, cycle=0, wrong_name=1)
