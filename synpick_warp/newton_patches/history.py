"""Persistent state of Newton's collision pipeline and solver: everything that one step keeps for the next, accessed per world.

Newton can reset this state for a world, but can neither save it nor copy it to another world, and without it a simulation continues
differently.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import newton
import numpy as np
import warp as wp
from newton._src.geometry.contact_data import CONTACT_SORT_MAX_SHAPE_INDEX_BITS
from newton._src.solvers.steel import friction_patches

from synpick_warp.errors import StateError
from synpick_warp.kernels.newton_patches import contact_history as kernels
from synpick_warp.newton_patches import KNOWN_NEWTON

MATCHER_ARRAYS = {"key": "_prev_sorted_keys", "midpoint": "_prev_pos_world", "normal": "_prev_normal"}
SOLVER_ARRAYS = {
    "dense_slot": "_ws_prev_dense_slot",
    "free_slot": "_ws_prev_mf_slot",
    "propagation_slot": "_ws_prev_propagation_slot",
    "solved_normal": "_ws_prev_contact_normal",
}
PATCH_ARRAYS = {"pair": "keys", "pair_contact": "indices", "patch_normal": "normal", "friction": "mu"}
_SAME = "displacement body_a body_b shape_a shape_b owner anchor_a anchor_b surface_a surface_b valid tangent_impulse"
PATCH_ARRAYS |= {name: name for name in _SAME.split()}
"""Newton's names of the members of `ContactHistory`: in its contact matcher, its solver, and the previous frame of friction patches."""
ROW_ARRAYS = ("impulses", "row_type", "row_parent")
"""Warm-start data of each family of constraint rows."""
ROW_FAMILIES = ("", "mf_", "propagation_")
"""Families of constraint rows: joint-space, free bodies, and graph-colored contacts; the last two exist only in some solvers."""
STEP_COUNTERS = ("_ws_history_dt", "_ws_history_generation", "_ws_history_stream")
"""Counters that identify the step of the history, shared by all worlds."""

CONTACT_BYTES = sum(wp.types.type_size_in_bytes(member.type.dtype) for member in kernels.ContactHistory.vars.values())
"""Size of one contact in a contact history [bytes]."""


@dataclass(frozen=True, eq=False)
class SavedContacts:
    """Contact history of saved worlds; the contacts of row r begin at index r `capacity` of the arrays of `history`."""

    history: Any
    """The struct `ContactHistory`; worlds count from 0."""
    start: wp.array
    """First contact (row) int32."""
    count: wp.array
    """Contacts of the world, of which `capacity` at most are saved (row) int32."""
    capacity: int


class History:
    """Persistent solver state of all worlds: world-major arrays of fixed size by name (`rows`), and the contact history, a list of variable
    length.

    `families` are those of `ROW_FAMILIES` that the solver has, `live` is the struct `ContactHistory` of Newton's own arrays, and `counters`
    are step counters, shared by all worlds."""

    def __init__(
        self,
        model: newton.Model,
        state: newton.State,
        control: newton.Control,
        pipeline: newton.CollisionPipeline,
        contacts: newton.Contacts,
        solver: newton.solvers.SolverSteel,
    ) -> None:
        """Find the arrays, which must have been allocated: after the first step. Raises StateError if another version of Newton is
        installed, whose history is unknown."""
        if newton.__version__ != KNOWN_NEWTON:
            raise StateError(
                f"states need Newton {KNOWN_NEWTON}; what {newton.__version__}, which is installed, keeps of a step is unknown"
            )
        self.device, self.worlds = model.device, model.world_count
        self.patches: Any = solver._friction_patches
        self.matcher: Any = pipeline._contact_matcher
        self.families = [family for family in ROW_FAMILIES if hasattr(solver, f"_ws_prev_{family}{ROW_ARRAYS[0]}")]
        self.rows = find_rows(model, state, control) | dict(_find_solver_rows(solver, self.families))
        self.live = kernels.ContactHistory()
        for source, names in ((self.matcher, MATCHER_ARRAYS), (solver, SOLVER_ARRAYS), (self.patches.previous, PATCH_ARRAYS)):
            for name, theirs in names.items():
                setattr(self.live, name, getattr(source, theirs))
        counters = (getattr(solver, name) for name in STEP_COUNTERS)
        self.counters = [contacts.contact_generation, self.matcher._prev_frame, *counters]
        self.capacity = self.live.key.shape[0]
        numbers = kernels.ContactNumbers()
        numbers.shapes, numbers.bodies = model.shape_count // self.worlds, model.body_count // self.worlds
        numbers.all_bodies, numbers.contacts = model.body_count, 1
        numbers.shape_bits, numbers.contact_bits = self.matcher._shape_index_bits, self.matcher._sub_key_bits
        self._numbers, self._saved_numbers = numbers, kernels.ContactNumbers()
        self._saved_numbers.all_bodies, self._saved_numbers.contact_bits = numbers.bodies, numbers.contact_bits
        self._saved_numbers.shape_bits = CONTACT_SORT_MAX_SHAPE_INDEX_BITS
        self._worlds = wp.array(np.arange(self.worlds), dtype=wp.int32, device=self.device)
        self._live_start, self._start = (wp.zeros(self.worlds + 1, dtype=wp.int32, device=self.device) for _ in range(2))
        self._kept, self._count = (wp.zeros(self.worlds, dtype=wp.int32, device=self.device) for _ in range(2))

    @cached_property
    def _staging(self) -> Any:
        """Scratch of `load_contacts`: a list as long as Newton's."""
        return _allocate_history(self.capacity, self.device)

    def arrays(self) -> list[wp.array]:
        """All arrays of the history."""
        contacts = [getattr(self.live, name) for name in kernels.ContactHistory.vars]
        return [*self.rows.values(), *contacts, self.matcher._prev_claim, self.matcher._prev_count, *self.counters]

    def allocate_contacts(self, rows: int, capacity: int) -> SavedContacts:
        """Contact history of `rows` saved worlds, of up to `capacity` contacts each."""
        start, count = (wp.zeros(rows, dtype=wp.int32, device=self.device) for _ in range(2))
        return SavedContacts(_allocate_history(rows * capacity, self.device), start, count, capacity)

    def save_contacts(self, world: wp.array, saved: SavedContacts) -> None:
        """Save the contacts of the world of each row (row) int32; -1: the row keeps its own."""
        self._find_contacts()
        wp.launch(
            kernels.count_saved_kernel,
            dim=len(world),
            inputs=[saved.capacity, world, self._live_start],
            outputs=[saved.start, saved.count],
            device=self.device,
        )
        source = (self._numbers, self._live_start, self.live)
        self._copy(world, source, (self._saved_numbers, saved.start, saved.history), saved.count, saved.capacity)

    def load_contacts(self, row: wp.array, saved: SavedContacts, lost: wp.array, contacts_lost: int) -> None:
        """Replace the contacts of worlds by those of the row of each (world) int32; -1: the world keeps its own. Worlds that lose contacts,
        as there are too many, get the flag `contacts_lost` in `lost` (world) int32."""
        self._find_contacts()
        wp.launch(
            kernels.place_contacts_kernel,
            dim=1,
            inputs=[saved.capacity, self.capacity, contacts_lost, row, saved.count, self._live_start],
            outputs=[self._kept, self._start, self._count, lost],
            device=self.device,
        )
        live = (self._numbers, self._start, self.live)
        staging = (self._numbers, self._start, self._staging)
        self._copy(self._kept, (self._numbers, self._live_start, self.live), staging, self._count, self.capacity)
        self._copy(row, (self._saved_numbers, saved.start, saved.history), staging, self._count, saved.capacity)
        self._copy(self._worlds, staging, live, self._count, self.capacity)
        ends = [self.live.pair, self.live.valid, self.matcher._prev_claim, self.matcher._prev_count]
        wp.launch(kernels.end_contacts_kernel, dim=self.capacity, inputs=[self._start], outputs=ends, device=self.device)

    def _find_contacts(self) -> None:
        """Find the first contact of each world."""
        wp.launch(
            kernels.find_contacts_kernel,
            dim=self.worlds + 1,
            inputs=[self._numbers, self.live.key, self.matcher._prev_count],
            outputs=[self._live_start],
            device=self.device,
        )

    def _copy(
        self, place: wp.array, source: tuple[Any, wp.array, Any], target: tuple[Any, wp.array, Any], count: wp.array, capacity: int
    ) -> None:
        """Copy the contacts of worlds; `source`, `target`: how a list numbers, where its worlds start, the list."""
        (source_numbers, source_start, source_list), (target_numbers, target_start, target_list) = source, target
        wp.launch(
            kernels.copy_contacts_kernel,
            dim=(len(place), int(kernels.LANES)),
            inputs=[source_numbers, target_numbers, capacity, place, source_start, target_start, count, source_list],
            outputs=[target_list],
            device=self.device,
        )


def find_rows(model: newton.Model, state: newton.State, control: newton.Control) -> dict[str, wp.array]:
    """World-major arrays that exist before the first step, by name: joint and body motion, forces, model data set at run time.

    Masses and shapes of objects are not among them: they follow from the body variants (`Physics.select`).
    """
    names: Mapping[Any, tuple[str, ...]] = {
        state: ("joint_q", "joint_qd", "body_q", "body_qd"),
        control: ("joint_f", "joint_target_q"),
        model: ("body_variant", "joint_X_c", "shape_transform"),
    }
    return {name: getattr(owner, name) for owner, listed in names.items() for name in listed}


def _find_solver_rows(solver: Any, families: Sequence[str]) -> Iterator[tuple[str, wp.array]]:
    """World-major arrays of fixed size of the solver, by name: warm start and friction patches."""
    for family in families:
        yield from ((f"{family}{name}", getattr(solver, f"_ws_prev_{family}{name}")) for name in ROW_ARRAYS)
    patches = solver._friction_patches
    yield "patch_body_q", patches.previous_q
    yield "patch_shape_transform", patches._seen_geometry[friction_patches._GEOMETRY_FIELDS.index("shape_transform")]


def _allocate_history(length: int, device: wp.Device) -> Any:
    """The struct `ContactHistory` of a list of `length` contacts."""
    history = kernels.ContactHistory()
    for name, member in kernels.ContactHistory.vars.items():
        setattr(history, name, wp.zeros(length, dtype=member.type.dtype, device=device))
    return history
