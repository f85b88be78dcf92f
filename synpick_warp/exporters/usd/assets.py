"""The asset library that all USD episodes share: one file an object, and tote, finger, cup and table."""

# pxr's modules fill themselves when they are loaded, where no type checker sees it.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Gf, Usd, UsdGeom, UsdShade

from synpick_warp.configs.schema import Config
from synpick_warp.exporters.usd.lights import write_light_maps
from synpick_warp.exporters.usd.parts import (
    TEXTURES,
    add_body,
    add_collider,
    add_friction,
    add_mesh,
    add_surface,
    make_collider,
    new_asset,
    object_asset,
    save_layer,
    write_texture,
)
from synpick_warp.scenes.gripper import cup_collider, cup_fixture, finger_collider, finger_fixture, rod_inertia
from synpick_warp.scenes.tote import TABLE_SIZE, tote_colliders, tote_fixture
from synpick_warp.scenes.types import Catalog, CatalogEntry, ConvexPiece, EnvironmentMap, Fixture, Material, TriangleMesh

TABLE_ROUGHNESS = 0.8
"""The table is matt, as in the pictures."""


def write_library(library: Path, config: Config, catalog: Catalog, lights: tuple[EnvironmentMap, ...]) -> None:
    """Write all assets into an existing folder, in place of what may be there.

    Raises:
        OSError: A file cannot be written.
        OutputError: Likewise, said by USD.
    """
    for name in (TEXTURES, "lights"):
        (library / name).mkdir(exist_ok=True)
    write_light_maps(library, lights)
    for entry in catalog.entries:
        _write_object(library, config, entry)
    gripper = config.gripper
    _write_fixture(library, config, "tote", tote_fixture(config.tote), tote_colliders(config.tote))
    finger = _fixture(library, config, "finger", finger_fixture(gripper), (finger_collider(gripper),))
    length, mass = gripper.finger_length, gripper.finger_mass
    add_body(finger.GetDefaultPrim(), mass, np.array([0.0, 0.0, length / 2]), np.diag(rod_inertia(mass, length)), kinematic=True)
    save_layer(finger.GetRootLayer(), library / "finger.usdc")
    cup = _fixture(library, config, "cup", cup_fixture(gripper), (cup_collider(gripper),))
    length, mass = gripper.cup_length, gripper.cup_mass
    add_body(cup.GetDefaultPrim(), mass, np.array([0.0, 0.0, -length / 2]), np.diag(rod_inertia(mass, length)), kinematic=True)
    save_layer(cup.GetRootLayer(), library / "cup.usdc")
    _write_table(library, config)


def _write_object(library: Path, config: Config, entry: CatalogEntry) -> None:
    name = object_asset(entry.obj_id)
    stage = new_asset(name, entry.name)
    root = stage.GetDefaultPrim()
    root.SetDisplayName(entry.name)
    root.SetCustomDataByKey("obj_id", entry.obj_id)
    _dress(stage, config, entry.mesh, entry.material, write_texture(library, name, entry.material), entry.pieces)
    add_body(root, entry.mass, entry.center_of_mass, entry.inertia, kinematic=False)
    save_layer(stage.GetRootLayer(), library / f"{name}.usdc")


def _write_fixture(library: Path, config: Config, name: str, fixture: Fixture, pieces: tuple[ConvexPiece, ...]) -> None:
    stage = _fixture(library, config, name, fixture, pieces)
    save_layer(stage.GetRootLayer(), library / f"{name}.usdc")


def _fixture(library: Path, config: Config, name: str, fixture: Fixture, pieces: tuple[ConvexPiece, ...]) -> Usd.Stage:
    stage = new_asset(name, name)
    _dress(stage, config, fixture.mesh, fixture.material, write_texture(library, name, fixture.material), pieces)
    return stage


def _dress(
    stage: Usd.Stage, config: Config, mesh: TriangleMesh, material: Material, texture: str | None, pieces: tuple[ConvexPiece, ...]
) -> None:
    """Give an asset its mesh, its surface and its collision shapes."""
    root, friction = _materials(stage, config)
    add_mesh(stage, f"{root}/Visual", mesh, add_surface(stage, f"{root}/Materials/Surface", material, texture))
    UsdGeom.Scope.Define(stage, f"{root}/Collision")
    for index, piece in enumerate(pieces):
        add_collider(stage, f"{root}/Collision/piece_{index:02d}", piece, friction, config.physics.gap)


def _write_table(library: Path, config: Config) -> None:
    """The table on which the tote stands: a box that collides, and its upper side if it is in the pictures."""
    stage = new_asset("table", "table")
    root, friction = _materials(stage, config)
    half, height = np.array(TABLE_SIZE), -config.tote.wall
    if config.render.table:
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * half + [0.0, 0.0, height]
        uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
        quad = TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.tile([0.0, 0.0, 1.0], (4, 1)), uv)
        material = Material(config.render.table_color, None, 0.0, TABLE_ROUGHNESS)
        add_mesh(stage, f"{root}/Visual", quad, add_surface(stage, f"{root}/Materials/Surface", material, None))
    UsdGeom.Scope.Define(stage, f"{root}/Collision")
    box = UsdGeom.Cube.Define(stage, f"{root}/Collision/box")
    box.CreateSizeAttr(2.0)
    box.CreateExtentAttr([Gf.Vec3f(-1.0), Gf.Vec3f(1.0)])
    box.AddTranslateOp().Set(Gf.Vec3d(0.0, 0.0, height - TABLE_SIZE[2]))
    box.AddScaleOp().Set(Gf.Vec3f(*TABLE_SIZE))
    make_collider(box, friction, config.physics.gap)
    save_layer(stage.GetRootLayer(), library / "table.usdc")


def _materials(stage: Usd.Stage, config: Config) -> tuple[str, UsdShade.Material]:
    """Path of the asset's root, and the material of its collision shapes."""
    root = str(stage.GetDefaultPrim().GetPath())
    UsdGeom.Scope.Define(stage, f"{root}/Materials")
    return root, add_friction(stage, f"{root}/Materials/Contact", config.physics.friction)
