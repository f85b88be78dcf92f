"""Permutations of kernels: which code a launch runs is told by the structs among its arguments."""

import pytest
import warp as wp

from synpick_warp.kernels.render.lighting.materials import AnySurfaces, DressedSurfaces, Surfaces, material_of
from synpick_warp.kernels.render.visibility.camera import AnyViews, LensViews, Views, lens_of
from synpick_warp.kernels.render.visibility.variants import kernel_for, kernel_of_views

MESH, ROW, LENS = 7, 5, 3


@kernel_of_views
def read_rows_kernel(surfaces: AnySurfaces, views: AnyViews, rows_out: wp.array[int]):
    """Rows of the lens of a view and of the material of its first body."""
    rows_out[0] = lens_of(views.cameras, 0)
    rows_out[1] = material_of(surfaces, 0, 0, MESH)


@pytest.mark.parametrize(
    ("surfaces", "views", "rows"),
    [
        (Surfaces, Views, [-1, MESH]),
        (Surfaces, LensViews, [LENS, MESH]),
        (DressedSurfaces, Views, [-1, ROW]),
        (DressedSurfaces, LensViews, [LENS, ROW]),
    ],
)
def test_structs_of_the_arguments_choose_the_kernel(surfaces, views, rows, device):
    arguments = [surfaces(), views(), wp.zeros(2, dtype=wp.int32, device=device)]
    arguments[1].cameras.lens = wp.full(1, LENS, dtype=wp.int32, device=device)
    if surfaces is DressedSurfaces:
        arguments[0].row = wp.full((1, 1), ROW, dtype=wp.int32, device=device)
    wp.launch(kernel_for(read_rows_kernel, *arguments), dim=1, inputs=arguments, device=device)
    assert arguments[2].numpy().tolist() == rows


def test_plain_structs_have_nothing_of_looks():
    """Known: a cell without looks has neither the rows nor the code that reads them."""
    assert set(DressedSurfaces.vars) - set(Surfaces.vars) == {"row", "recolor", "repeats"}
