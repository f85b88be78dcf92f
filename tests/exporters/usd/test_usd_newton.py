"""Newton imports USD episodes: same bodies, masses, poses of the first frame, and collision shapes."""

from collections import defaultdict

import newton
import numpy as np
import pytest

from synpick_warp.scenes import build
from synpick_warp.scenes.bins import TABLE_SIZE, tote_colliders
from synpick_warp.scenes.grippers import cup_collider, finger_collider
from tests.worlds import small_worlds, usd_sets

pytest.importorskip("newton_usd_schemas")  # Newton's importer needs it

CATALOG = small_worlds.catalog()
CONFIG = usd_sets.settings(objects__hull_vertices=64)
TICK = usd_sets.episode_ticks(0)[0]
PRESENT = [instance for instance, obj_id in enumerate(usd_sets.OBJECT_IDS) if obj_id >= 0]


@pytest.fixture(scope="module")
def read(tmp_path_factory) -> newton.ModelBuilder:
    """Builder of an episode imported by Newton."""
    folder = usd_sets.write_set(tmp_path_factory.mktemp("newton") / "set", CONFIG, CATALOG)
    builder = newton.ModelBuilder()
    info = builder.add_usd(str(folder / "000000.usdc"))
    known = {"up_axis": newton.Axis.Z, "mass_unit": 1.0, "linear_unit": 1.0, "duration": usd_sets.FRAMES - 1}
    assert {name: info[name] for name in known} == known
    return builder


def entry_of(instance: int):
    return next(entry for entry in CATALOG.entries if entry.obj_id == usd_sets.OBJECT_IDS[instance])


def body_of(read: newton.ModelBuilder, name: str) -> int:
    return read.body_label.index(f"/Episode/{name}")


def colliders(read: newton.ModelBuilder, body: int) -> list[int]:
    """Colliding shapes of a body."""
    flag = newton.ShapeFlags.COLLIDE_SHAPES
    return [shape for shape in range(read.shape_count) if read.shape_body[shape] == body and read.shape_flags[shape] & flag]


def points(read: newton.ModelBuilder, shape: int) -> np.ndarray:
    """Vertices of a convex shape in its body's frame, sorted."""
    assert read.shape_type[shape] == newton.GeoType.CONVEX_MESH
    np.testing.assert_allclose(np.array(read.shape_transform[shape]), [0, 0, 0, 0, 0, 0, 1], atol=1e-6)
    return sort(read.shape_source[shape].vertices * np.array(read.shape_scale[shape]))


def sort(vertices: np.ndarray) -> np.ndarray:
    rounded = np.round(vertices, 5)
    return vertices[np.lexsort(rounded.T)]


def test_bodies_are_the_same(read):
    names = {"/Episode/Gripper/Finger", "/Episode/Gripper/Cup", *(f"/Episode/Objects/instance_{instance:02d}" for instance in PRESENT)}
    assert set(read.body_label) == names
    assert read.body_count == len(names)
    assert read.joint_type.count(newton.JointType.FREE) == read.joint_count == len(names)


@pytest.mark.parametrize("instance", PRESENT)
def test_objects_have_mass_inertia_and_pose(read, instance):
    body, entry = body_of(read, f"Objects/instance_{instance:02d}"), entry_of(instance)
    assert read.body_mass[body] == pytest.approx(entry.mass)
    np.testing.assert_allclose(read.body_com[body], entry.center_of_mass, atol=1e-7)
    np.testing.assert_allclose(np.reshape(read.body_inertia[body], (3, 3)), entry.inertia, atol=1e-6 * np.trace(entry.inertia))
    assert_same_pose(np.array(read.body_q[body]), TICK.pose[0, instance])


@pytest.mark.parametrize(("name", "row", "mass"), [("Finger", 1, CONFIG.gripper.finger_mass), ("Cup", 2, CONFIG.gripper.cup_mass)])
def test_gripper_bodies_are_kinematic(read, name, row, mass):
    body = body_of(read, f"Gripper/{name}")
    assert read.body_mass[body] == pytest.approx(mass)
    assert read.body_flags[body] & newton.BodyFlags.KINEMATIC
    assert_same_pose(np.array(read.body_q[body]), TICK.fixture_pose[0, row])


def assert_same_pose(pose: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(pose[:3], expected[:3], atol=1e-6)
    assert abs(pose[3:] @ expected[3:]) == pytest.approx(1.0, abs=1e-6)


def test_collision_shapes_have_the_same_vertices_and_the_table_is_a_box(read):
    expected = {body_of(read, f"Objects/instance_{instance:02d}"): entry_of(instance).pieces for instance in PRESENT}
    expected[body_of(read, "Gripper/Finger")] = (finger_collider(CONFIG.gripper),)
    expected[body_of(read, "Gripper/Cup")] = (cup_collider(CONFIG.gripper),)
    expected[-1] = tote_colliders(CONFIG.tote)
    for body, pieces in expected.items():
        shapes = [shape for shape in colliders(read, body) if read.shape_type[shape] != newton.GeoType.BOX]
        assert len(shapes) == len(pieces)
        for shape, piece in zip(shapes, pieces, strict=True):
            np.testing.assert_allclose(points(read, shape), sort(piece.vertices), atol=1e-6)
    (table,) = (shape for shape in range(read.shape_count) if read.shape_type[shape] == newton.GeoType.BOX)
    assert read.shape_body[table] == -1
    np.testing.assert_allclose(read.shape_scale[table], TABLE_SIZE)
    np.testing.assert_allclose(np.array(read.shape_transform[table])[:3], [0, 0, -CONFIG.tote.wall - TABLE_SIZE[2]], atol=1e-6)


def test_shapes_have_friction_and_contact_gap(read):
    solid = [shape for body in range(-1, read.body_count) for shape in colliders(read, body)]
    np.testing.assert_allclose([read.shape_material_mu[shape] for shape in solid], CONFIG.physics.friction, rtol=1e-6)
    assert {read.shape_material_restitution[shape] for shape in solid} == {0.0}
    np.testing.assert_allclose([read.shape_gap[shape] for shape in solid], CONFIG.physics.gap, rtol=1e-6)
    finger, cup = (colliders(read, body_of(read, f"Gripper/{name}"))[0] for name in ("Finger", "Cup"))
    assert {(finger, cup), (cup, finger)} & set(map(tuple, read.shape_collision_filter_pairs))


def test_visible_meshes_do_not_collide(read):
    shown = defaultdict(int)
    for shape in range(read.shape_count):
        if read.shape_label[shape].endswith("/Visual"):
            shown[read.shape_body[shape]] += 1
            assert not read.shape_flags[shape] & newton.ShapeFlags.COLLIDE_SHAPES
    assert dict(shown) == {-1: 2} | dict.fromkeys(range(read.body_count), 1)


def test_the_simulated_model_has_the_same_shapes_and_the_one_that_was_read_can_be_simulated(read, device):
    """Compared without its guide walls, which are disabled at the first frame."""
    built = build.build_model(usd_sets.settings(bake__worlds=1, arrangement__max_objects=4), CATALOG, device)
    model, layout = built.model, built.layout
    bodies = model.shape_body.numpy()
    guides = [part.shape for part in layout.parts if part.guide]
    still = [shape for shape in np.flatnonzero(bodies == -1) if shape not in guides]
    assert len(still) == len(colliders(read, -1))
    mass = model.body_mass.numpy()[: build.GRIPPER_BODIES]
    np.testing.assert_allclose(mass, [read.body_mass[body_of(read, f"Gripper/{name}")] for name in ("Finger", "Cup")])
    np.testing.assert_allclose(read.finalize(device=device).gravity.numpy()[0], [0, 0, -CONFIG.physics.gravity], rtol=1e-6)
