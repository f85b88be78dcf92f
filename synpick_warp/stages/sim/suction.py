"""Suction: what the cup catches, the seals that hold it, and the contacts that these replace."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import warp as wp

from synpick_warp.configs.schema import Config
from synpick_warp.kernels.sim import cup_rays, seal
from synpick_warp.scenes.collision.hull_planes import plane_table
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.stages.sim.physics import Physics
from synpick_warp.stages.sim.worlds import AttemptState, SealState, WorldState


class Suction:
    """The cups' rays and seals."""

    def __init__(self, config: Config, catalog: Catalog, render_scene: RenderScene, device: wp.Device) -> None:
        """Put on the device what the rays hit: collision shapes or visual meshes, as `suction.surface` says.

        Args:
            config: All settings.
            catalog: The objects.
            render_scene: Holds the visual meshes.
            device: Where the rest lies.
        """
        self._meshes = render_scene.keep
        self.surface = _surface_data(config.suction.surface == "mesh", catalog, render_scene.meshes.id, device)

    def count_seal_rays(self, scene: SceneData, state: WorldState, attempts: AttemptState, seals: SealState, physics: Physics) -> None:
        """At the end of a tick, where a cup's time to press is up: cast its rays, and join what they catch to the cup."""
        task = [state.phase, attempts.task, attempts.steps]
        body_q, device = physics.state.body_q, state.phase.device
        wp.launch(
            cup_rays.count_seal_rays_kernel,
            dim=state.phase.shape[0],
            inputs=[scene.layout, scene.pick, scene.suction, self.surface, *task, state.catalog_index, state.body_slot, body_q],
            outputs=[attempts.hits, attempts.engaged_bits],
            device=device,
        )
        wp.launch(
            cup_rays.engage_seals_kernel,
            dim=state.catalog_index.shape,
            inputs=[scene.layout, scene.pick, scene.suction, *task, state.body_slot, body_q, attempts.hits, attempts.engaged_bits],
            outputs=[seals.attached, seals.object_in_tcp, seals.seal_force, seals.break_force],
            device=device,
        )

    def apply_seal_forces(self, scene: SceneData, state: WorldState, seals: SealState, physics: Physics, current: newton.State) -> None:
        """Before a step: pull what hangs on the cups to the tip, and break seals that bear too much.

        After the gripper's forces have been written: the reactions are added to them.
        """
        model = physics.model
        wp.launch(
            seal.apply_seal_forces_kernel,
            dim=state.phase.shape[0],
            inputs=[
                scene.layout,
                scene.suction,
                model.body_com,
                model.body_inv_mass,
                model.body_inv_inertia,
                state.body_slot,
                seals.object_in_tcp,
                seals.break_force,
                current.body_q,
                current.body_qd,
                seals.attached,
                seals.seal_force,
                seals.peak_force,
                physics.control.joint_f,
            ],
            device=state.phase.device,
        )

    def ignore_attached_contacts(self, scene: SceneData, state: WorldState, seals: SealState, physics: Physics) -> None:
        """Between collision and solver: cups do not touch what hangs on them."""
        contacts = physics.contacts
        wp.launch(
            seal.ignore_attached_contacts_kernel,
            dim=contacts.rigid_contact_max,
            inputs=[
                scene.layout,
                physics.model.shape_body,
                contacts.rigid_contact_count,
                state.body_slot,
                seals.attached,
                contacts.rigid_contact_shape0,
                contacts.rigid_contact_shape1,
            ],
            outputs=[contacts.rigid_contact_margin0],
            device=state.phase.device,
        )


def _surface_data(use_mesh: bool, catalog: Catalog, meshes: wp.array, device: wp.Device) -> Any:
    """The struct `SurfaceData`; `meshes` are ids of visual meshes, the catalog's entries first."""
    table = plane_table(catalog)
    data = cup_rays.SurfaceData()
    data.first_piece = wp.array(table.first_piece, dtype=wp.int32, device=device)
    data.first_plane = wp.array(table.first_plane, dtype=wp.int32, device=device)
    data.plane = wp.array(table.plane, dtype=wp.vec4, device=device)
    data.mesh = meshes
    data.use_mesh = int(use_mesh)
    parts = [[entry.mesh] if use_mesh else entry.pieces for entry in catalog.entries]
    radius = [max(np.linalg.norm(part.vertices, axis=1).max() for part in entry) for entry in parts]
    data.radius = wp.array(np.array(radius), dtype=wp.float32, device=device)
    return data
