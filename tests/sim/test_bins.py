"""Bins of worlds: which one an episode draws and where; that everything is in its frame; and piles at rest in bins, also in full ones."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from synpick_warp.codes import Ending, Mode, Phase, Stream
from synpick_warp.configs.cell.bins import BinRow, Bins
from synpick_warp.configs.schema import Config
from synpick_warp.factory.assembly import fit_to_catalog
from synpick_warp.scenes.bin_meshes.reading import measure_bins
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.build import GRIPPER_BODIES
from synpick_warp.stages.sim import arrange, gripper
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.system.progress import SilentProgress
from tests.builders import STIRRING, bake_boxes
from tests.harness.pieces import depth_within
from tests.twins import rng
from tests.worlds.bin_meshes import round_bin, sloped_bin, tote
from tests.worlds.cells import check_same
from tests.worlds.kernel_worlds import BIN, KernelWorlds
from tests.worlds.small_worlds import ANGLE, BOX, COARSE, catalog, run_ticks, settings

SEED, WORLDS = 7, 64
DROP = {"volume": 10.0, "pick_repeats": 0, "move_repeats": 0}
PLACES = Bins(shift=(0.1, 0.05), yaw=30.0)
LOW = dataclasses.replace(BIN, name="low", opening=(0.3, 0.2), height=0.1, base=-0.02, weight=3.0)


def started(device, worlds: int = WORLDS, **more) -> KernelWorlds:
    """Worlds that start episodes of five small objects, with bins drawn."""
    result = KernelWorlds(device, worlds, **{"objects": 5, "radius": np.full(5, 0.05), "drop": DROP} | more)
    result.begin(Phase.START, arrangement=np.arange(worlds) % 3)
    result.run(arrange.sample_episodes, SEED)
    return result


def numbers(stream: Stream, index: int) -> np.ndarray:
    """Uniform number of each world's episode, by the twin (world)."""
    return rng.uniform(np.array([rng.stream_key(SEED, world, world % 3, stream) for world in range(WORLDS)]), index)


def moving(worlds: KernelWorlds) -> KernelWorlds:
    """The same worlds as the gripper begins to move."""
    worlds.put(phase=Phase.ACT, mode=Mode.MOVE, frame=-1)
    worlds.run(gripper.begin_moving, SEED)
    return worlds


def redropped(worlds: KernelWorlds, places: Sequence[np.ndarray]) -> KernelWorlds:
    """The same worlds after a tick, with the objects of world 0 at these places in the bin's frame."""
    worlds.run(arrange.drop_objects, SEED)
    worlds.put(phase=Phase.SETTLE)
    pose = worlds["bin_pose"][0]
    for instance, place in enumerate(Rotation.from_quat(pose[3:]).apply(places) + pose[:3]):
        worlds.place(0, instance, [*place, 0.0, 0.0, 0.0, 1.0])
    arrange.launch(arrange.rest.redrop_objects_kernel, 1, worlds.scene, worlds.state, worlds.physics.state, seed=np.uint64(SEED))
    return worlds


def test_bin_and_pose_follow_the_law(device):
    worlds = started(device, bins=(BIN, LOW), places=PLACES)
    u = [numbers(Stream.BIN, index) for index in range(4)]
    chosen = (u[0] >= 0.25).astype(int)
    assert 0 < chosen.sum() < WORLDS
    np.testing.assert_array_equal(worlds["bin"], chosen)
    pose = worlds["bin_pose"]
    lift = np.where(chosen == 1, BIN.base - LOW.base, 0.0)
    np.testing.assert_allclose(pose[:, :3], np.stack([0.1 * (2 * u[1] - 1), 0.05 * (2 * u[2] - 1), lift], axis=1), atol=1e-6)
    yaw = Rotation.from_quat(pose[:, 3:]).as_euler("xyz")
    np.testing.assert_allclose(yaw, np.stack([0 * u[3], 0 * u[3], np.radians(30) * (2 * u[3] - 1)], axis=1), atol=1e-6)


def test_a_share_of_the_objects_begins_to_fall_upright_where_the_others_fall(device):
    worlds = started(device)
    worlds.run(arrange.drop_objects, SEED)
    lying = worlds.coordinates()
    worlds.put(phase=Phase.START)
    arrange.drop_objects(dataclasses.replace(worlds.scene, upright=0.4), worlds.state, worlds.physics, SEED)
    found, slots = worlds.coordinates(), worlds["body_slot"]
    for instance in range(5):
        u, turn = (numbers(Stream.UPRIGHT, 2 * instance + index) for index in range(2))
        before, after = (each[np.arange(WORLDS), slots[:, instance]] for each in (lying, found))
        np.testing.assert_array_equal(after[u >= 0.4], before[u >= 0.4])
        np.testing.assert_array_equal(after[:, :3], before[:, :3])
        expected = Rotation.from_euler("z", 2 * np.pi * turn[u < 0.4][:, None])
        assert (Rotation.from_quat(after[u < 0.4, 3:]).inv() * expected).magnitude().max() < 1e-5


def test_a_bin_that_does_not_move_is_exactly_at_the_origin(device):
    pose = started(device).state.bin_pose.numpy()
    assert pose.tobytes() == np.tile(np.array([0, 0, 0, 0, 0, 0, 1], np.float32), (WORLDS, 1)).tobytes()


def test_drops_and_waypoints_are_those_of_a_bin_at_the_origin_moved_with_it(device):
    """Drop poses and the gripper's first setpoint, in the bin's frame, do not depend on its pose."""
    found = []
    for places in (Bins(), PLACES):
        worlds = started(device, places=places)
        worlds.run(arrange.drop_objects, SEED)
        drops = worlds.coordinates()
        pose = moving(worlds)["bin_pose"].astype(np.float64)
        back = Rotation.from_quat(pose[:, 3:]).inv()
        points = [back.apply(each - pose[:, :3]) for each in (*drops[:, :, :3].transpose(1, 0, 2), worlds["setpoint"])]
        turns = [(back * Rotation.from_quat(each)).as_matrix() for each in drops[:, :, 3:].transpose(1, 0, 2)]
        found.append((np.array(points), np.array(turns)))
    for first, second in zip(*found, strict=True):
        np.testing.assert_allclose(first, second, atol=2e-6)


OPEN = dataclasses.replace(BIN, shell=None, height=0.0, margin=0.1)


@pytest.mark.parametrize(
    ("sizes", "place", "outside"),
    [
        (BIN, (0.0, 0.0, 0.0), False),
        (BIN, (0.24, 0.14, 0.1), False),
        (BIN, (0.26, 0.0, 0.1), True),
        (BIN, (-0.26, 0.0, 0.1), True),
        (BIN, (0.0, 0.16, 0.1), True),
        (BIN, (0.0, -0.16, 0.199), True),
        (BIN, (0.26, 0.0, 0.3), False),
        (BIN, (0.0, 0.16, 0.3), False),
        (BIN, (0.0, 0.0, -0.02), True),
        (BIN, (0.0, 0.0, 5.0), False),
        (OPEN, (0.34, 0.0, 0.05), False),
        (OPEN, (0.36, 0.0, 0.05), True),
        (OPEN, (0.0, 0.26, 2.0), True),
    ],
)
def test_what_is_outside_is_outside_in_the_bins_frame(device, sizes, place, outside):
    places = np.tile([0.0, 0.0, 0.1], (5, 1))
    places[2] = place
    assert redropped(started(device, 1, bins=(sizes,), places=PLACES), places)["progress"][0, 2] == int(outside)


@pytest.mark.parametrize(("layers", "height"), [(0, BIN.height), (1, 1.5 + 0.05 + 0.01)])
def test_what_is_dropped_again_begins_above_layers_that_still_fall(device, layers, height):
    places = np.outer((0.1, -0.5, 1.5, 0.9, -0.5), (0.0, 0.0, 1.0))
    worlds = redropped(started(device, 1, bins=(BIN,), drop=DROP | {"layers": layers}), places)
    slots = worlds["body_slot"][0, [1, 4]]
    np.testing.assert_allclose(worlds.coordinates()[0, slots, 2], [height + 0.05, height + 0.05 + 0.11], atol=1e-5)


def test_shapes_of_the_drawn_bin_are_at_its_pose_and_all_others_away(device):
    parts = [(0, 0, False), (1, 0, True), (2, 1, False), (3, 1, True)]
    worlds = started(device, bins=(BIN, LOW), places=PLACES, parts=parts)
    untouched = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]
    worlds.put(progress=[[0, 0, 0, world % 2] for world in range(WORLDS)], shape_transform=untouched)
    worlds.run(arrange.place_bins)
    found = worlds["shape_transform"].reshape(WORLDS, -1, 7)
    assert (found[:, len(parts) :] == untouched).all()
    for world, (chosen, pose) in enumerate(zip(worlds["bin"], worlds["bin_pose"], strict=True)):
        for shape, owner, guide in parts:
            away = arrange.rest.SHAPES_AWAY if owner == chosen else arrange.rest.BINS_AWAY
            stands = owner == chosen and (not guide or world % 2 == 1)
            np.testing.assert_array_equal(found[world, shape], pose if stands else [0, 0, away, 0, 0, 0, 1])


def test_objects_fall_over_their_compartments_and_rounds_take_them_in_turn(device):
    sizes = dataclasses.replace(BIN, floor=(0.5, 0.3), compartments=(3, 2))
    worlds = started(device, bins=(sizes,))
    worlds.run(arrange.drop_objects, SEED)
    place = worlds.coordinates()[:, :, :2]
    apart = np.abs(place[:, :, None] - np.array(sizes.openings)[:, :2]) - (np.array(sizes.cell) / 2 - 0.05)
    there = (apart < 1e-6).all(axis=3)
    assert (there.sum(axis=2) == 1).all()
    key = np.array([rng.stream_key(SEED, world, world % 3, Stream.COMPARTMENT) for world in range(WORLDS)])
    expected = np.stack([rng.uniform_index(key, instance, 6) for instance in range(5)], axis=1)
    slots = worlds["body_slot"]
    np.testing.assert_array_equal(np.take_along_axis(there.argmax(axis=2), slots, axis=1), expected)
    compartment = moving(worlds)["corner_order"].reshape(WORLDS, -1, 4) // 4
    assert (compartment == compartment[:, :, :1]).all()
    assert ((compartment[:, 1, 0] - compartment[:, 0, 0]) % 6 == 1).all()
    assert len(np.unique(compartment)) == 6


def test_the_gripper_passes_over_dividers_and_nowhere_below_the_rim_through_them(device):
    sizes = dataclasses.replace(BIN, floor=(0.5, 0.3), compartments=(2, 1))
    worlds = moving(started(device, 1, bins=(sizes,), places=PLACES, move={"speed": 2.0}))
    points = [worlds["setpoint"][0].copy()]
    while worlds["waypoint"][0] < worlds.scene.move.waypoints:
        gripper.launch(gripper.gripper.advance_setpoints_kernel, 1, worlds.scene, worlds.state, worlds.attempts, worlds.plan)
        points.append(worlds["setpoint"][0].copy())
        assert len(points) < 5000
    pose = worlds["bin_pose"][0].astype(np.float64)
    local = Rotation.from_quat(pose[3:]).inv().apply(np.array(points) - pose[:3]) - (0.0, 0.0, worlds.scene.move.tcp_offset)
    crossing = np.flatnonzero(np.diff(np.sign(local[:, 0])))
    assert len(crossing) == 1
    assert (local[crossing[0] : crossing[0] + 2, 2] > sizes.height + 0.049).all()
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).max() < 2.0 * 2e-3 + 1e-6


# ---- piles ----


def first_frames(config: Config, worlds: int) -> dict[int, tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
    """Bin, its pose, and poses and catalog indices of the objects in the first frame of each episode."""
    simulation = Simulation(config.with_values({"bake.worlds": worlds}), catalog(), 1, wp.get_device(config.bake.device))
    found = {}
    for _ in range(300):
        (report,) = run_ticks(simulation, 1)
        for world in np.flatnonzero(report.column("live") & (report.column("frame") == 0)):
            there, snapshot = report.catalog_index[world] >= 0, report.snapshot
            objects = report.pose[world][there], report.catalog_index[world][there]
            found[int(report.column("episode")[world])] = (int(snapshot.bin[world]), snapshot.fixture_pose[world, 0], *objects)
        if len(found) == config.bake.episodes:
            return found
    raise AssertionError(f"{len(found)} of {config.bake.episodes} episodes began")


MOST_DEPTH = 2e-3
"""Depth to which no vertex may be inside a wall or the floor [m]; the solver's penetrations are tenths of a millimetre."""
HALVES = BinRow(name="halves", compartments=(2, 1), divider_height=0.15)
FLAT = BinRow(name="flat", outer_size=(0.615, 0.373, 0.1), wall=0.01, rim_size=(0.53, 0.34))


@pytest.mark.parametrize(("kind", "rows"), [("own", ["sloped", "round", "moulded", HALVES, FLAT]), ("none", []), ("pallet", [])])
def test_piles_rest_in_or_on_the_bin_that_is_drawn_in_any_number_of_worlds(kind, rows, tmp_path):
    """Bins of meshes and of sizes, shifted and turned: no corner of an object is in a wall, a floor or beside the inside."""
    files = {name: str(tmp_path / f"{name}.stl") for name in rows if isinstance(name, str)}
    for path, mesh in zip(files.values(), (sloped_bin(), round_bin(), tote()), strict=False):
        mesh.export(path)
    base = settings(bake__episodes=8 if files else 4, bake__mode="move", move__speed=10.0, **COARSE)
    drawn = tuple(BinRow(name=row, file=files[row]) if row in files else row for row in rows)
    given = measure_bins(drawn) if files else {"bin": drawn}
    config = dataclasses.replace(base, bins=dataclasses.replace(PLACES, kind=kind), **given)
    found, bins, objects = first_frames(config, 4), make_bins(config.cell.bins), catalog().entries
    assert len({chosen for chosen, *_ in found.values()}) >= (3 if files else len(bins))
    for chosen, pose, poses, indices in found.values():
        turn, sizes = Rotation.from_quat(pose[3:]).inv(), bins[chosen].sizes
        centers, limit = turn.apply(poses[:, :3] - pose[:3]), np.array(sizes.opening) / 2 + sizes.margin
        assert len(poses) > 0
        assert (np.abs(centers[:, :2]) < limit).all()
        # The smallest side of an object is 3 cm, and no object rests on the rim or a divider.
        assert (centers[:, 2] > 0.014).all()
        assert (centers[:, 2] < 0.15).all()
        corners = [
            Rotation.from_quat(place[3:]).apply(objects[index].mesh.vertices) + place[:3]
            for place, index in zip(poses, indices, strict=True)
        ]
        corners = turn.apply(np.concatenate(corners) - pose[:3])
        assert depth_within(bins[chosen].pieces, corners) < MOST_DEPTH
        if kind == "own":
            assert (np.abs(corners[:, :2]) < limit + MOST_DEPTH).all()
            assert (corners[:, 2] > -MOST_DEPTH).all()
            assert (corners[:, 2] < 0.25).all()
    for episode, (chosen, *arrays) in first_frames(config, 1).items():
        assert found[episode][0] == chosen
        for one, other in zip(arrays, found[episode][1:], strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("shape", [BOX, ANGLE], ids=["boxes", "angles"])
def test_a_full_bin_rests_within_its_walls_and_capacities(device, shape):
    """60 boxes, or L of two boxes: no vertex enters a wall or the floor, none lies beside the bin, and nothing overflows."""
    objects = catalog(shape)
    fill = {"arrangement__counts": ((objects.entries[0].name, 60, 60),), "arrangement__max_objects": 60, "arrangement__drop": "layers"}
    config = settings(**COARSE | fill, settle__restless=0.05, bake__formats=["zarr"])
    bins = make_bins(config.cell.bins)
    config = fit_to_catalog(config, objects, bins, device, SilentProgress())
    simulation = Simulation(config, objects, 1, device)
    for _ in range(80):
        (seen,) = run_ticks(simulation, 1)
        assert seen.column("ending")[0] == Ending.RUNNING
        if seen.column("phase")[0] == Phase.ACT:
            break
    assert seen.column("phase")[0] == Phase.ACT
    pose = seen.pose[0]
    vertices = np.concatenate([piece.vertices for piece in objects.entries[0].pieces])
    points = np.einsum("nij,vj->nvi", Rotation.from_quat(pose[:, 3:]).as_matrix(), vertices) + pose[:, None, :3]
    assert len(pose) == 60
    assert depth_within(bins[0].pieces, points.reshape(-1, 3)) < MOST_DEPTH
    assert (np.abs(points[..., :2]) < np.array(config.tote.outer_size[:2]) / 2 + config.physics.gap).all()
    assert simulation.state.penetration.numpy()[GRIPPER_BODIES:].max() < MOST_DEPTH
    physics = simulation.physics
    assert 60 < int(physics.contacts.rigid_contact_count.numpy()[0]) < config.physics.contacts_per_world
    assert 60 < int(physics.overlap_count.numpy()[0]) < config.physics.pairs_per_world


@pytest.mark.slow
def test_bytes_of_full_bins_do_not_depend_on_worlds(tmp_path):
    """Three episodes of 40 boxes, with masks of each."""
    fill = {"counts": [["boxes_1", 40, 40]], "max_objects": 40, "drop": "layers"}
    given = STIRRING | {f"arrangement.{name}": value for name, value in fill.items()} | {"settle.restless": 0.5}
    given |= {"bake.episodes": 3, "bake.formats": ["bop", "usd", "zarr"], "cameras.resolution": [48, 27]}
    for worlds in (1, 2):  # Two are refilled once.
        bake_boxes(tmp_path / str(worlds), given | {"bake.worlds": worlds}, objects=lambda: catalog(BOX))
    check_same(tmp_path / "1", tmp_path / "2")
