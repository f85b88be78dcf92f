"""Interface of a kind of gripper: how it holds objects, moves its setpoint, and chooses grasps."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import newton
import numpy as np
import warp as wp

from synpick_warp.configs.cell.gripper import SUCTION1, SUCTION_ARRAY, Suction
from synpick_warp.kernels.sim import cup_rays, seal, seal_array, vacuum
from synpick_warp.scenes.collision.hulls import plane_table
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.arrays import allocate_struct, struct_arrays
from synpick_warp.stages.constants import SceneData, fill
from synpick_warp.stages.launch import launch
from synpick_warp.stages.perception.images import Plan
from synpick_warp.stages.perception.perceive import GraspPlanner
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.stages.sim.gripper import TWO_SPEEDS, SetpointLaw
from synpick_warp.stages.sim.physics import Physics, contact_arrays
from synpick_warp.stages.sim.worlds import AttemptState, SealState, WorldState
from synpick_warp.system.plugins import load_plugin

MOUTH_RAYS = struct_arrays(vacuum.MouthRays, "world", "cup", "ray", leak=("world", "cup"), units={"depth": "m"})


class SuctionHold:
    """Hold by suction: rays and seals of a head of one cup."""

    seal_kernel: ClassVar[Any] = seal.apply_seal_forces_kernel

    def __init__(self, settings: Suction, catalog: Catalog, render_scene: RenderScene, device: wp.Device) -> None:
        """Upload the surfaces that rays hit: collision shapes or visual meshes, which `render_scene` owns, by `settings.surface`."""
        self._meshes = render_scene.keep
        self.surface = _surface_data(settings.surface == "mesh", catalog, render_scene.meshes.id, device)
        self.mouth = None if settings.vacuum is None else _mouth_data(settings, device)
        self.ray_count = settings.rays + settings.mouth_rays
        self._scratch: Any = None

    def engage(self, scene: SceneData, state: WorldState, attempts: AttemptState, seals: SealState, physics: Physics) -> None:
        """Switch suction on where task PRESS is complete: cast the rays and attach the engaged objects. Runs at the end of a tick."""
        sources = (scene, state, attempts, physics.state)
        if self.mouth is None:
            launch(cup_rays.count_seal_rays_kernel, len(state.phase), *sources, seals, self)
        else:
            self._evacuate(*sources, seals=seals)
        launch(cup_rays.engage_seals_kernel, state.catalog_index.shape, *sources, seals)

    def _evacuate(self, *sources: Any, seals: SealState) -> None:
        """Cast rays across the cups' mouths, sum up the leaks, and attach what lies below, with break forces by the vacuum left."""
        cups, device = seals.break_force.shape, seals.break_force.device
        if self._scratch is None:
            sizes = {"world": cups[0], "cup": cups[1], "ray": self.ray_count}
            self._scratch = allocate_struct(MOUTH_RAYS, sizes, device)
        launch(vacuum.cast_mouth_rays_kernel, (*cups, self.ray_count), *sources, self, rays=self._scratch)
        launch(vacuum.measure_leaks_kernel, cups, *sources, self, rays=self._scratch)
        launch(vacuum.set_vacuum_kernel, cups[0], *sources, seals, self, rays=self._scratch)

    def apply_forces(self, scene: SceneData, state: WorldState, seals: SealState, physics: Physics, current: newton.State) -> None:
        """Add the seals' wrenches to the joint forces of objects and gripper, and break overloaded seals.

        Runs before a step, after the gripper's forces were written.
        """
        bodies = {name: getattr(physics.model, name) for name in ("body_com", "body_inv_mass", "body_inv_inertia")}
        launch(self.seal_kernel, len(state.phase), scene, state, seals, current, physics.control, **bodies)

    def ignore_contacts(self, scene: SceneData, state: WorldState, seals: SealState, physics: Physics) -> None:
        """Disable contacts between cups and their attached objects. Runs between collision detection and solver."""
        threads, contacts = physics.contacts.rigid_contact_max, contact_arrays(physics)
        launch(seal.ignore_attached_contacts_kernel, threads, scene, state, seals, contacts=contacts)


class ArrayHold(SuctionHold):
    """Hold by several cups, or one off-centre: all cups on an object act as one spring-damper, whose wrench is shared out to them."""

    seal_kernel = seal_array.apply_array_forces_kernel


def _surface_data(use_mesh: bool, catalog: Catalog, meshes: wp.array, device: wp.Device) -> Any:
    """Fill `SurfaceData`; `meshes` are ids of visual meshes, those of the catalog first."""
    table = plane_table(catalog)
    parts = [[entry.mesh] if use_mesh else entry.pieces for entry in catalog.bodies]
    radius = [max(np.linalg.norm(part.vertices, axis=1).max() for part in entry) for entry in parts]
    return fill(
        cup_rays.SurfaceData,
        first_piece=wp.array(table.first_piece, dtype=wp.int32, device=device),
        first_plane=wp.array(table.first_plane, dtype=wp.int32, device=device),
        plane=wp.array(table.plane, dtype=wp.vec4, device=device),
        mesh=meshes,
        use_mesh=use_mesh,
        radius=wp.array(np.array(radius), dtype=wp.float32, device=device),
    )


def _mouth_data(settings: Suction, device: wp.Device) -> Any:
    """Fill `MouthData`: rays on the lip, and within it on a spiral on which each stands for the same area (Vogel, 1979)."""
    radius, count = settings.radius, settings.mouth_rays
    lip, within = math.tau * np.arange(settings.rays) / settings.rays, np.arange(count)
    angle = np.concatenate([lip, math.pi * (3.0 - math.sqrt(5.0)) * within])
    way = np.concatenate([np.ones_like(lip), np.sqrt((within + 0.5) / count)])
    area = np.concatenate([np.zeros_like(lip), np.full(count, math.pi * radius**2 / count)])
    rays = np.column_stack([radius * way * np.cos(angle), radius * way * np.sin(angle), area])
    return fill(
        vacuum.MouthData,
        settings,
        ray=wp.array(rays, dtype=wp.vec3, device=device),
        lip=settings.rays,
        compliance=2.0 * radius * (settings.compliance or 0.0),
        tilt=math.tan(math.radians(settings.swing_limit)),
        pressure=1e3 * (settings.vacuum or 0.0),
    )


class Hold(Protocol):
    """How grippers hold objects, in all worlds. All other code reads only its result, `SealState.attached`: which objects are held."""

    def engage(self, scene: SceneData, state: WorldState, attempts: AttemptState, seals: SealState, physics: Physics) -> None:
        """Attach objects where task PRESS is complete. Runs at the end of a tick."""

    def apply_forces(self, scene: SceneData, state: WorldState, seals: SealState, physics: Physics, current: newton.State) -> None:
        """Add the hold's wrenches to the joint forces of objects and gripper, and release what exceeds its strength. Runs before a step."""

    def ignore_contacts(self, scene: SceneData, state: WorldState, seals: SealState, physics: Physics) -> None:
        """Disable the contacts that the hold replaces. Runs between collision detection and solver."""


@dataclass(frozen=True)
class Behavior:
    """Behaviour of a kind of gripper: how it holds, how its setpoint moves, and how it chooses among grasps of the target."""

    hold: Callable[[Suction, Catalog, RenderScene, wp.Device], Hold]
    law: SetpointLaw = TWO_SPEEDS
    choose_grasps: Callable[[GraspPlanner, SceneData, Plan], None] | None = None
    """Replaces grasps of `Plan` by others of the target (point, normal, yaw, tilt), after it was framed; None: the frame is taken."""


BEHAVIORS: Mapping[str, Behavior] = {
    SUCTION1: Behavior(SuctionHold),
    SUCTION_ARRAY: Behavior(ArrayHold, choose_grasps=GraspPlanner.align_cups),
}
"""Behaviour, by `gripper.kind`."""


def behavior_of(kind: str) -> Behavior:
    """Behaviour of a kind of gripper, of this package or of a plug-in (`system/plugins.py`)."""
    return BEHAVIORS.get(kind) or load_plugin("grippers", kind, "make_head", "BEHAVIOR").BEHAVIOR
