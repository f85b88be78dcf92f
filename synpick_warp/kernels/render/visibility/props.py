"""Props of a cell as further bodies of each world, behind its instances: the renderer takes them for objects without labels."""

import warp as wp

from synpick_warp.codes import SHAFT, Segment
from synpick_warp.kernels.state import Snapshots

wp.set_module_options({"enable_backward": False})


@wp.struct
class Props:
    """Props of a cell. Constant."""

    first: int
    """Row of `Meshes` of the first, which the others follow."""
    pose: wp.array[wp.transform]
    """(prop): to the world, or to the frame of the gripper's shaft [m]."""
    follows: wp.array[int]
    """(prop): 1: it follows the gripper."""


@wp.kernel
def place_props_kernel(
    # Scene:
    props: Props,
    # State:
    fixture_visible: wp.array2d[int],  # (world, fixture)
    snapshot: Snapshots,
    # Out:
    placed_out: Snapshots,
):
    """Copy the instances of a snapshot, and add the props behind them, in this frame and the one before. Launched over world, body."""
    world, body = wp.tid()
    prop = body - snapshot.pose.shape[1]
    if prop < 0:
        placed_out.catalog_index[world, body] = snapshot.catalog_index[world, body]
        placed_out.last_catalog_index[world, body] = snapshot.last_catalog_index[world, body]
        placed_out.pose[world, body] = snapshot.pose[world, body]
        placed_out.last_pose[world, body] = snapshot.last_pose[world, body]
        return
    mesh = props.first + prop
    last_mesh = mesh
    now = props.pose[prop]
    then = now
    if props.follows[prop] != 0:
        now = snapshot.fixture_pose[world, SHAFT] * now
        then = snapshot.last_fixture_pose[world, SHAFT] * then
        mesh = wp.where(fixture_visible[world, SHAFT] != 0, mesh, -1)
        last_mesh = wp.where(snapshot.last_fixture_visible[world, SHAFT] != 0, last_mesh, -1)
    placed_out.catalog_index[world, body] = mesh
    placed_out.last_catalog_index[world, body] = last_mesh
    placed_out.pose[world, body] = now
    placed_out.last_pose[world, body] = then


@wp.kernel
def hide_props_kernel(
    # Scene:
    instances: int,
    # Out:
    segment_inout: wp.array3d[wp.uint8],  # (view, row, column)
):
    """Give props the segmentation id of the table. Launched over view, row, column."""
    view, row, column = wp.tid()
    segment = int(segment_inout[view, row, column])
    if segment > instances and segment < Segment.TABLE:
        segment_inout[view, row, column] = wp.uint8(Segment.TABLE)
