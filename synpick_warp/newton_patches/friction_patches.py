"""Friction patches of SolverSteel, with contacts sorted by ranks within worlds instead of a radix sort of eight passes."""

import contextlib
import functools
import threading
from collections.abc import Callable
from typing import Any

import newton
import numpy as np
import warp as wp

from synpick_warp.kernels.newton_patches.friction_patches import sort_contacts_kernel
from synpick_warp.newton_patches.narrow_phase import small_blocks

BLOCK = 256
"""Threads that sort the contacts of a world."""
FEW_WORLDS, GROWTH_BLOCK = 64, 4
"""Up to FEW_WORLDS worlds, patches are built with GROWTH_BLOCK threads per block: one thread processes the contacts of a pair of bodies,
and the others of its warp wait for it. With 8 worlds this takes 58 us instead of 88; with 512 it is slower (H200)."""


def sort_by_worlds(patches: Any, model: newton.Model) -> None:
    """Have the contacts of a solver's friction patches sorted by `sort_contacts_kernel`, if worlds have equally many bodies, in their
    order, and shapes of their own. Contacts that no pipeline has sorted by shapes, as `contact_matching` does, keep Newton's sort."""
    bodies, shapes, worlds = model.body_world.numpy(), model.shape_world.numpy(), model.world_count
    each = len(bodies) // max(worlds, 1)
    ordered = len(shapes) > 0 and shapes.min() >= 0 and (np.diff(shapes) >= 0).all()
    if ordered and each > 0 and np.array_equal(bodies, np.arange(len(bodies)) // each):
        patches.build = functools.partial(_build, patches.build, worlds, each)


def _build(
    build: Callable[..., None],
    worlds: int,
    bodies: int,
    model: newton.Model,
    state: newton.State,
    contacts: newton.Contacts,
    **options: Any,
) -> None:
    """Build the patches of a substep; `model` and what follows as in Newton's `build`."""

    def sort(keys: wp.array, order: wp.array, *_: Any) -> None:
        inputs, device = [bodies, keys, order], model.device
        wp.launch_tiled(sort_contacts_kernel, dim=[worlds], inputs=inputs, block_dim=BLOCK if device.is_cuda else 1, device=device)

    _thread.sort = sort if contacts.contact_matching else None
    try:
        with small_blocks(GROWTH_BLOCK) if worlds <= FEW_WORLDS else contextlib.nullcontext():
            build(model, state, contacts, **options)
    finally:
        _thread.sort = None


def _sort_pairs(*arguments: Any, **options: Any) -> None:
    """Sort of a thread in `_build`, elsewhere Warp's radix sort."""
    (getattr(_thread, "sort", None) or _radix_sort_pairs)(*arguments, **options)


_thread, _radix_sort_pairs = threading.local(), wp.utils.radix_sort_pairs
wp.utils.radix_sort_pairs = _sort_pairs
