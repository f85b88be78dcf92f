"""Settings of props: what stands around the bin, or hangs on the gripper, and is no object."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from synpick_warp.configs.cell.cameras import GRIPPER, WORLD, Pose
from synpick_warp.configs.fields import setting

CONVEYOR, FRAME = "conveyor", "frame"
EMBEDDED = (CONVEYOR, FRAME)
"""Names of the embedded props."""


@dataclass(frozen=True)
class PropRow:
    """A prop: scenery that is drawn, hides objects, casts shadows and is mirrored, but has no label. Not in the paper."""

    REQUIRED: ClassVar = ("name", "mesh", "pose")
    name: str = setting("", "Unique name of at most 32 lower-case letters, digits and underscores, a letter first.")
    mesh: str = setting(
        "",
        "Mesh file (.stl, .ply, .obj, .glb, .gltf, .step), in metres, or the name of an embedded prop.",
        choices=EMBEDDED,
        allowed=f"a path, in a file relative to it, or {', '.join(EMBEDDED)}",
        path=True,
    )
    pose: Pose = setting(Pose(), "Pose in the tote's frame, as of a camera in whose axes the mesh is; a position alone: without rotation.")
    scale: Annotated[float, "(0, 1e4]"] = setting(1.0, "Factor on the mesh, such as 0.001 for a file in millimetres.")
    collide: bool = setting(False, "Collide, as the convex hull of each connected part of the mesh.")
    follows: str = setting(
        WORLD,
        "What carries the prop: the world, or the gripper (the pose is in the frame of its shaft, and the layer suction_seal takes the "
        "prop for an obstacle).",
        choices=(WORLD, GRIPPER),
    )
