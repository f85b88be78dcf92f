"""Bins of worlds: which one an episode draws and where, and that everything in the simulation is in its frame."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from synpick_warp.codes import Mode, Phase, Stream
from synpick_warp.configs.cell.bins import BinRow, Bins
from synpick_warp.scenes.bin_meshes.reading import measure_bins
from synpick_warp.scenes.bins import make_bins
from synpick_warp.stages.sim import arrange, gripper
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import read_tick
from tests.twins import rng
from tests.worlds.bin_meshes import round_bin, sloped_bin, tote
from tests.worlds.kernel_worlds import BIN, KernelWorlds
from tests.worlds.small_worlds import COARSE, catalog, settings

SEED, WORLDS = 7, 64
DROP = {"volume": 10.0, "pick_repeats": 0, "move_repeats": 0}
PLACES = Bins(shift=(0.1, 0.05), yaw=30.0)
LOW = dataclasses.replace(BIN, name="low", opening=(0.3, 0.2), height=0.1, base=-0.02, weight=3.0)


def started(device, worlds: int = WORLDS, **more) -> KernelWorlds:
    """Worlds that start episodes of five small objects, with bins drawn."""
    result = KernelWorlds(device, worlds, **{"objects": 5, "radius": np.full(5, 0.05), "drop": DROP} | more)
    result.set(result.state.phase, Phase.START)
    result.set(result.state.arrangement_id, np.stack([np.arange(worlds), np.arange(worlds) % 3], axis=1))
    arrange.sample_episodes(result.scene, result.state, SEED)
    return result


def test_bin_and_pose_follow_the_law(device):
    worlds = started(device, bins=(BIN, LOW), places=PLACES)
    key = np.array([rng.stream_key(SEED, world, world % 3, Stream.BIN) for world in range(WORLDS)])
    u = [rng.uniform(key, index) for index in range(4)]
    chosen = (u[0] >= 0.25).astype(int)
    assert 0 < chosen.sum() < WORLDS
    np.testing.assert_array_equal(worlds.state.bin.numpy(), chosen)
    pose = worlds.state.bin_pose.numpy()
    lift = np.where(chosen == 1, BIN.base - LOW.base, 0.0)
    np.testing.assert_allclose(pose[:, :3], np.stack([0.1 * (2 * u[1] - 1), 0.05 * (2 * u[2] - 1), lift], axis=1), atol=1e-6)
    yaw = Rotation.from_quat(pose[:, 3:]).as_euler("xyz")
    np.testing.assert_allclose(yaw, np.stack([0 * u[3], 0 * u[3], np.radians(30) * (2 * u[3] - 1)], axis=1), atol=1e-6)


def test_a_share_of_the_objects_begins_to_fall_upright_where_the_others_fall(device):
    worlds = started(device)
    arrange.drop_objects(worlds.scene, worlds.state, worlds.physics, SEED)
    lying = worlds.coordinates()
    worlds.set(worlds.state.phase, Phase.START)
    arrange.drop_objects(dataclasses.replace(worlds.scene, upright=0.4), worlds.state, worlds.physics, SEED)
    found, slots = worlds.coordinates(), worlds.state.body_slot.numpy()
    key = np.array([rng.stream_key(SEED, world, world % 3, Stream.UPRIGHT) for world in range(WORLDS)])
    for instance in range(5):
        u, turn = (rng.uniform(key, 2 * instance + index) for index in range(2))
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
        arrange.drop_objects(worlds.scene, worlds.state, worlds.physics, SEED)
        drops = worlds.coordinates()
        worlds.set(worlds.state.phase, Phase.ACT)
        worlds.set(worlds.state.mode, Mode.MOVE)
        worlds.set(worlds.state.frame, -1)
        gripper.begin_moving(worlds.scene, worlds.state, worlds.physics, SEED)
        pose = worlds.state.bin_pose.numpy().astype(np.float64)
        back = Rotation.from_quat(pose[:, 3:]).inv()
        points = [back.apply(each - pose[:, :3]) for each in (*drops[:, :, :3].transpose(1, 0, 2), worlds.state.setpoint.numpy())]
        turns = [(back * Rotation.from_quat(each)).as_matrix() for each in drops[:, :, 3:].transpose(1, 0, 2)]
        found.append((np.array(points), np.array(turns)))
    for first, second in zip(*found, strict=True):
        np.testing.assert_allclose(first, second, atol=2e-6)


@pytest.mark.parametrize(
    ("sizes", "place", "outside"),
    [
        (BIN, (0.24, 0.14, 0.1), False),
        (BIN, (0.26, 0.0, 0.1), True),
        (BIN, (0.26, 0.0, 0.3), False),
        (BIN, (0.0, 0.0, -0.02), True),
        (dataclasses.replace(BIN, shell=None, height=0.0, margin=0.1), (0.34, 0.0, 0.05), False),
        (dataclasses.replace(BIN, shell=None, height=0.0, margin=0.1), (0.36, 0.0, 0.05), True),
        (dataclasses.replace(BIN, shell=None, height=0.0, margin=0.1), (0.0, 0.26, 2.0), True),
    ],
)
def test_what_is_outside_is_outside_in_the_bins_frame(device, sizes, place, outside):
    worlds = started(device, 1, bins=(sizes,), places=PLACES)
    arrange.drop_objects(worlds.scene, worlds.state, worlds.physics, SEED)
    worlds.set(worlds.state.phase, Phase.SETTLE)
    pose = worlds.state.bin_pose.numpy()[0]
    inside = np.array([0.0, 0.0, 0.1])
    for instance in range(5):
        local = np.array(place) if instance == 2 else inside
        worlds.place(0, instance, [*(pose[:3] + Rotation.from_quat(pose[3:]).apply(local)), 0.0, 0.0, 0.0, 1.0])
    worlds.physics.contacts.rigid_contact_max = 0
    arrange.launch(arrange.rest.redrop_objects_kernel, 1, worlds.scene, worlds.state, worlds.physics.state, seed=np.uint64(SEED))
    assert worlds.state.progress.numpy()[0, 2] == int(outside)


@pytest.mark.parametrize(("layers", "height"), [(0, BIN.height), (1, 1.5 + 0.05 + 0.01)])
def test_what_is_dropped_again_begins_above_layers_that_still_fall(device, layers, height):
    worlds = started(device, 1, bins=(BIN,), drop=DROP | {"layers": layers})
    arrange.drop_objects(worlds.scene, worlds.state, worlds.physics, SEED)
    worlds.set(worlds.state.phase, Phase.SETTLE)
    for instance, z in enumerate((0.1, -0.5, 1.5, 0.9, -0.5)):
        worlds.place(0, instance, [0.0, 0.0, z, 0.0, 0.0, 0.0, 1.0])
    arrange.launch(arrange.rest.redrop_objects_kernel, 1, worlds.scene, worlds.state, worlds.physics.state, seed=np.uint64(SEED))
    slots = worlds.state.body_slot.numpy()[0, [1, 4]]
    np.testing.assert_allclose(worlds.coordinates()[0, slots, 2], [height + 0.05, height + 0.05 + 0.11], atol=1e-5)


def test_shapes_of_the_drawn_bin_are_at_its_pose_and_all_others_away(device):
    parts = [(0, 0, False), (1, 0, True), (2, 1, False), (3, 1, True)]
    worlds = started(device, bins=(BIN, LOW), places=PLACES, parts=parts)
    worlds.set(worlds.state.progress, [[0, 0, 0, world % 2] for world in range(WORLDS)])
    arrange.place_bins(worlds.scene, worlds.state, worlds.physics)
    found = worlds.physics.model.shape_transform.numpy().reshape(WORLDS, -1, 7)
    for world, (chosen, pose) in enumerate(zip(worlds.state.bin.numpy(), worlds.state.bin_pose.numpy(), strict=True)):
        for shape, owner, guide in parts:
            away = arrange.rest.SHAPES_AWAY if owner == chosen else arrange.rest.BINS_AWAY
            stands = owner == chosen and (not guide or world % 2 == 1)
            np.testing.assert_array_equal(found[world, shape], pose if stands else [0, 0, away, 0, 0, 0, 1])


def test_objects_fall_over_their_compartments_and_rounds_take_them_in_turn(device):
    sizes = dataclasses.replace(BIN, floor=(0.5, 0.3), compartments=(3, 2))
    worlds = started(device, bins=(sizes,))
    arrange.drop_objects(worlds.scene, worlds.state, worlds.physics, SEED)
    place = worlds.coordinates()[:, :, :2]
    apart = np.abs(place[:, :, None] - np.array(sizes.openings)[:, :2]) - (np.array(sizes.cell) / 2 - 0.05)
    there = (apart < 1e-6).all(axis=3)
    assert (there.sum(axis=2) == 1).all()
    key = np.array([rng.stream_key(SEED, world, world % 3, Stream.COMPARTMENT) for world in range(WORLDS)])
    expected = np.stack([rng.uniform_index(key, instance, 6) for instance in range(5)], axis=1)
    slots = worlds.state.body_slot.numpy()
    np.testing.assert_array_equal(np.take_along_axis(there.argmax(axis=2), slots, axis=1), expected)
    worlds.set(worlds.state.phase, Phase.ACT)
    worlds.set(worlds.state.mode, Mode.MOVE)
    worlds.set(worlds.state.frame, -1)
    gripper.begin_moving(worlds.scene, worlds.state, worlds.physics, SEED)
    compartment = worlds.state.corner_order.numpy().reshape(WORLDS, -1, 4) // 4
    assert (compartment == compartment[:, :, :1]).all()
    assert ((compartment[:, 1, 0] - compartment[:, 0, 0]) % 6 == 1).all()
    assert len(np.unique(compartment)) == 6


def test_the_gripper_passes_over_dividers_and_nowhere_below_the_rim_through_them(device):
    sizes = dataclasses.replace(BIN, floor=(0.5, 0.3), compartments=(2, 1))
    worlds = started(device, 1, bins=(sizes,), places=PLACES, move={"speed": 2.0})
    worlds.set(worlds.state.phase, Phase.ACT)
    worlds.set(worlds.state.mode, Mode.MOVE)
    worlds.set(worlds.state.frame, -1)
    gripper.begin_moving(worlds.scene, worlds.state, worlds.physics, SEED)
    points = [worlds.state.setpoint.numpy()[0].copy()]
    while worlds.state.waypoint.numpy()[0] < worlds.scene.move.waypoints:
        gripper.launch(gripper.gripper.advance_setpoints_kernel, 1, worlds.scene, worlds.state, worlds.attempts, worlds.plan)
        points.append(worlds.state.setpoint.numpy()[0].copy())
        assert len(points) < 5000
    pose = worlds.state.bin_pose.numpy()[0].astype(np.float64)
    local = Rotation.from_quat(pose[3:]).inv().apply(np.array(points) - pose[:3]) - (0.0, 0.0, worlds.scene.move.tcp_offset)
    crossing = np.flatnonzero(np.diff(np.sign(local[:, 0])))
    assert len(crossing) == 1
    assert (local[crossing[0] : crossing[0] + 2, 2] > sizes.height + 0.049).all()
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).max() < 2.0 * 2e-3 + 1e-6


def first_frames(config, worlds: int) -> dict[int, tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
    """Bin, its pose, and poses and catalog indices of the objects in the first frame of each episode."""
    config = dataclasses.replace(config, bake=dataclasses.replace(config.bake, worlds=worlds))
    simulation = Simulation(config, catalog(), 1, wp.get_device(config.bake.device))
    found = {}
    for _ in range(300):
        simulation.tick()
        report = read_tick(simulation.record)
        for world in np.flatnonzero(report.column("live") & (report.column("frame") == 0)):
            there = report.catalog_index[world] >= 0
            objects = report.pose[world][there], report.catalog_index[world][there]
            found[int(report.column("episode")[world])] = (
                int(report.snapshot.bin[world]),
                report.snapshot.fixture_pose[world, 0],
                *objects,
            )
        if len(found) == config.bake.episodes:
            return found
    raise AssertionError(f"{len(found)} of {config.bake.episodes} episodes began")


ROWS = (
    BinRow(name="halves", compartments=(2, 1), divider_height=0.15),
    BinRow(name="flat", outer_size=(0.615, 0.373, 0.1), wall=0.01, rim_size=(0.53, 0.34)),
)


def deepest(pieces, points: np.ndarray) -> float:
    """Largest depth of points in convex pieces [m]."""
    planes = (ConvexHull(piece.vertices.astype(float)).equations for piece in pieces)
    return max(float(-(points @ each[:, :3].T + each[:, 3]).max(axis=1).min()) for each in planes)


def test_piles_rest_within_meshes_and_sized_bins_in_any_number_of_worlds(tmp_path):
    """Bins of meshes and of sizes, shifted and turned: no corner of an object is in a wall, a floor or beside the inside."""
    meshes = {"sloped": sloped_bin(), "round": round_bin(), "moulded": tote()}
    for name, mesh in meshes.items():
        mesh.export(tmp_path / f"{name}.stl")
    rows = (*(BinRow(name=name, file=str(tmp_path / f"{name}.stl")) for name in meshes), ROWS[0])
    base = settings(bake__episodes=8, bake__mode="move", move__speed=10.0, **COARSE)
    config = dataclasses.replace(base, bins=dataclasses.replace(PLACES, kind="own"), **measure_bins(rows))
    found, bins, objects = first_frames(config, 4), make_bins(config.cell.bins), catalog().entries
    assert len({chosen for chosen, *_ in found.values()}) >= 3
    for chosen, pose, poses, indices in found.values():
        assert len(poses) > 0
        for place, index in zip(poses, indices, strict=True):
            corners = Rotation.from_quat(place[3:]).apply(objects[index].mesh.vertices) + place[:3]
            local = Rotation.from_quat(pose[3:]).inv().apply(corners - pose[:3])
            assert deepest(bins[chosen].pieces, local) < 2e-3
            assert (np.abs(local[:, :2]) < np.array(bins[chosen].sizes.opening) / 2 + 2e-3).all()
            assert (local[:, 2] > -2e-3).all()
            assert (local[:, 2] < 0.25).all()
    assert_same_frames(found, first_frames(config, 1))


def assert_same_frames(found, one) -> None:
    """Bins, poses and objects of all episodes are bit for bit those of another number of worlds."""
    for episode, (chosen, *arrays) in found.items():
        assert chosen == one[episode][0]
        for here, there in zip(arrays, one[episode][1:], strict=True):
            np.testing.assert_array_equal(here, there)


@pytest.mark.parametrize(
    "bins", [dataclasses.replace(PLACES, kind="own"), dataclasses.replace(PLACES, kind="none"), dataclasses.replace(PLACES, kind="pallet")]
)
def test_piles_rest_in_or_on_the_bin_that_is_drawn_in_any_number_of_worlds(bins):
    base = settings(bake__episodes=4, bake__mode="move", move__speed=10.0, **COARSE)
    config = dataclasses.replace(base, bins=bins, bin=ROWS if bins.kind == "own" else ())
    sizes, found = config.cell.bins, first_frames(config, 4)
    assert {chosen for chosen, *_ in found.values()} == set(range(len(sizes)))
    for chosen, pose, objects, _ in found.values():
        local = Rotation.from_quat(pose[3:]).inv().apply(objects[:, :3] - pose[:3])
        limit = np.array(sizes[chosen].opening) / 2 + sizes[chosen].margin
        assert len(objects) > 0
        assert (np.abs(local[:, :2]) < limit).all()
        # The smallest side of an object is 3 cm, and no object rests on the rim or a divider.
        assert (local[:, 2] > 0.014).all()
        assert (local[:, 2] < 0.15).all()
    assert_same_frames(found, first_frames(config, 1))
