"""Checkpoints of worlds: complete simulation states, from which any world of any simulation of the same objects continues bit by bit.

A checkpoint has a row for each saved world. It holds everything that a tick reads from the previous tick: the per-world arrays of
`WorldState` and the other state groups, Newton's own arrays listed in `newton_patches.history`, and the world's contacts. All other arrays
are constant or recomputed within a tick; `tests/sim/test_states.py` finds every array of a simulation and verifies this. Random numbers are
counter-based: functions of episode, arrangement and attempt, without a state of their own. The renderer's light history is not part of a
checkpoint: environments render without one (`environment.settings.fixed_settings`), and candidates are sampled from G-buffers.
"""

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import warp as wp

from synpick_warp.codes import Lost
from synpick_warp.configs.cell.bins import Cell
from synpick_warp.configs.cell.gripper import Gripper
from synpick_warp.errors import StateError
from synpick_warp.kernels import world_rows
from synpick_warp.newton_patches.history import CONTACT_BYTES, ROW_ARRAYS, History, SavedContacts, find_rows
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.arrays import ArraySpec
from synpick_warp.stages.sim.physics import Physics
from synpick_warp.system.hardware.free_memory import free_device_memory, free_host_memory

VERSION = 1
"""Version of the content of states."""
WORD = 4
"""Size of a word [bytes]."""
VARIANTS = "physics.body_variant"
"""Field of the body variants, by which a world gets the shapes and masses of its objects."""
COUNT = "contacts.count"
"""Array of the numbers of contacts (row)."""
KEPT = ("worlds.arrangement_id", "worlds.phase", "worlds.ending", VARIANTS)
"""Fields that `WorldStates.reset` keeps: the assignment of the episode, and the variants, which `Physics.select` replaces."""
ORIGINS = {"catalog": "catalog of objects", "cell": "cell or gripper"}
"""Key of a checksum of `WorldStates.origin` -> noun in messages."""


@dataclass(frozen=True, eq=False)
class State:
    """Saved states of worlds, a row each, on the device. Independent of the world and the number of worlds they were saved from."""

    words: wp.array
    """Content of the per-world arrays, concatenated (row, word) uint32."""
    contacts: SavedContacts
    """Contact history of the last step."""
    origin: Mapping[str, str]
    """Checksums by the keys of ORIGINS: a state is only loaded into worlds with the same."""

    def __len__(self) -> int:
        return self.words.shape[0]


@dataclass(frozen=True)
class Field:
    """Layout of one array within a row: name, scalar type, shape per world, and offset in words."""

    name: str
    dtype: np.dtype
    shape: tuple[int, ...]
    first: int

    @property
    def words(self) -> int:
        """Number of words."""
        return math.prod(self.shape) * self.dtype.itemsize // WORD


class WorldStates:
    """Saves, loads and branches the states of a simulation's worlds. Runs on the device; only copies to the host wait for it.

    `fields` is the layout of a row, `history` the state that Newton keeps between steps, and `origin` has checksums of what the worlds are
    made of, by the keys of ORIGINS."""

    def __init__(
        self,
        groups: Mapping[str, object],
        physics: Physics,
        origin: Mapping[str, str],
        variant: wp.array,
        restarted: wp.array,
        fresh: Mapping[str, np.ndarray],
    ) -> None:
        """Find all arrays of the state, after the first tick: those of `groups`, dataclasses by the name of their part of a row, whose
        first dimension is `world`.

        `origin` has checksums by the keys of ORIGINS (`checksum`, `cell_checksum`). Body variants to select (body) int32 are written to
        `variant`, in worlds that are written to `restarted` (world + 1) bool. `fresh` is the content of a world before the first tick
        (`copy_fresh`)."""
        self.physics, self.origin = physics, origin
        self.device, self.worlds = physics.device, physics.layout.worlds
        self._variant, self._restarted = variant, restarted
        self.history = History(physics.model, physics.state, physics.control, physics.pipeline, physics.contacts, physics.solver)
        named = dict(_find_arrays(groups))
        named |= {f"physics.{name}": array for name, array in self.history.rows.items()}
        self.fields: dict[str, Field] = {}
        addresses, strides, first = [], [], 0
        for name, array in named.items():
            self.fields[name] = field = _describe(name, array, self.worlds, first)
            addresses.append(np.uint64(array.ptr or 0) + WORD * np.arange(field.words, dtype=np.uint64))
            strides.append(np.full(field.words, WORD * field.words))
            first += field.words
        self._arrays, self.words = list(named.values()), first
        self._table = world_rows.WordTable()
        self._table.address = wp.array(np.concatenate(addresses), dtype=wp.uint64, device=self.device)
        self._table.stride = wp.array(np.concatenate(strides), dtype=wp.int32, device=self.device)
        words = [fresh[name].view(np.uint32) if name in fresh else np.zeros(field.words, np.uint32) for name, field in self.fields.items()]
        resets = [np.arange(field.first, field.first + field.words) for name, field in self.fields.items() if name not in KEPT]
        self._fresh = wp.array(np.concatenate(words), dtype=wp.uint32, device=self.device)
        self._resets = wp.array(np.concatenate(resets), dtype=wp.int32, device=self.device)
        self._branch = self.allocate(1)

    def arrays(self) -> list[wp.array]:
        """All arrays of the simulation that are saved."""
        return [*self._arrays, *self.history.arrays()]

    @property
    def contact_capacity(self) -> int:
        """Contacts of a row: those of a world that has more are lost, which ends its episode."""
        return self.physics.settings.contacts_per_world

    def allocate(self, rows: int) -> State:
        """Allocate an empty state of `rows` rows; raises StateError if memory is too short."""
        each = WORD * self.words + self.contact_capacity * CONTACT_BYTES
        free = free_device_memory(self.device) if self.device.is_cuda else free_host_memory()
        if rows * each > free:
            need, most = rows * each / 1e9, free // each
            raise StateError(f"states of {rows:,} worlds take {need:.3g} GB, but {free / 1e9:.3g} GB are free; take at most {most:,}")
        words = wp.zeros((rows, self.words), dtype=wp.uint32, device=self.device)
        return State(words, self.history.allocate_contacts(rows, self.contact_capacity), self.origin)

    def save(self, state: State, world: wp.array) -> None:
        """Save the world of each row (row) int32; -1: the row keeps its content. Only launches kernels."""
        wp.launch(
            world_rows.save_rows_kernel,
            dim=state.words.shape,
            inputs=[self._table, world],
            outputs=[state.words],
            device=self.device,
        )
        for family in self.history.families:
            impulses, *others = (self.fields[f"physics.{family}{name}"] for name in ROW_ARRAYS)
            wp.launch(
                world_rows.clear_idle_rows_kernel,
                dim=(len(world), impulses.words),
                inputs=[impulses.first, *(field.first for field in others), world],
                outputs=[state.words],
                device=self.device,
            )
        self.history.save_contacts(world, state.contacts)

    def load(self, state: State, row: wp.array) -> None:
        """Load the row of each world (world) int32; -1: the world goes on as it is. Only launches kernels."""
        bodies = self.physics.layout.bodies_per_world
        wp.launch(
            world_rows.select_variants_kernel,
            dim=(self.worlds, bodies),
            inputs=[bodies, self.fields[VARIANTS].first, row, state.words],
            outputs=[self._variant, self._restarted],
            device=self.device,
        )
        self.physics.select(self._variant, self._restarted)
        dim = (self.worlds, self.words)
        wp.launch(world_rows.load_rows_kernel, dim=dim, inputs=[self._table, row, state.words], device=self.device)
        self.history.load_contacts(row, state.contacts, self.physics.lost, int(Lost.CONTACTS))

    def reset(self, phase: wp.array) -> None:
        """Reset worlds in the phases START and IDLE to the content before the first tick, but for KEPT, so that nothing of an episode, NaN
        included, reaches the next one. Contacts are left to `Physics.load`. Only launches kernels.
        """
        dim = (self.worlds, len(self._resets))
        wp.launch(world_rows.reset_rows_kernel, dim=dim, inputs=[self._table, self._fresh, phase, self._resets], device=self.device)

    def get(self, worlds: Sequence[int]) -> State:
        """State of worlds, a row each; raises StateError if a world does not exist, or memory is too short."""
        state = self.allocate(len(self._checked(worlds)))
        self.save(state, wp.array(worlds, dtype=wp.int32, device=self.device))
        return state

    def set(self, state: State, worlds: Sequence[int], rows: Sequence[int] | None = None) -> None:
        """Load rows into worlds; `rows` names the row of each, None: all in order, or the only one into every world. Raises StateError if a
        world or a row does not exist, there is not a row for each world, or the state is of other worlds."""
        self._check_origin(state.origin)
        if rows is None:
            rows = [0] * len(worlds) if len(state) == 1 else range(len(state))
        if len(rows) != len(worlds):
            raise StateError(f"{len(rows)} rows cannot be loaded into {len(worlds)} worlds; name the row of each")
        if wrong := [row for row in rows if not 0 <= row < len(state)]:
            raise StateError(f"there is no row {wrong[0]}; the state has rows 0 to {len(state) - 1}")
        if state.words.shape[1] != self.words or state.contacts.capacity != self.contact_capacity:
            raise StateError("the state is of a simulation with other capacities; load it from the host to see which")
        table = np.full(self.worlds, -1)
        table[np.asarray(self._checked(worlds), int)] = rows
        self.load(state, wp.array(table, dtype=wp.int32, device=self.device))

    def branch(self, world: int, into: Sequence[int]) -> None:
        """Copy a world into others: they continue as it does. Raises StateError if a world does not exist."""
        self._checked([world])
        self.save(self._branch, wp.array([world], dtype=wp.int32, device=self.device))
        self.set(self._branch, into)

    def to_host(self, state: State) -> dict[str, np.ndarray]:
        """Copy a state to the host: by name the arrays of its rows and contacts, and what they fit; `np.savez` can store them."""
        words, contacts = state.words.numpy(), state.contacts
        arrays = {name: words[:, field.first : field.first + field.words].view(field.dtype) for name, field in self.fields.items()}
        arrays = {name: array.reshape(len(state), *self.fields[name].shape) for name, array in arrays.items()}
        arrays[COUNT] = contacts.count.numpy()
        for name in contacts.history._cls.vars:
            values = getattr(contacts.history, name).numpy()
            arrays[f"contacts.{name}"] = values.reshape(len(state), contacts.capacity, *values.shape[1:])
        return {"version": np.array(VERSION)} | {key: np.array(value) for key, value in state.origin.items()} | arrays

    def from_host(self, arrays: Mapping[str, np.ndarray]) -> State:
        """Copy a `to_host` state to a device; raises StateError if version, objects, cell or capacities differ, or as of `check_array`."""
        given = {name: str(arrays[name]) if name in arrays else "unknown" for name in ("version", *ORIGINS)}
        if given["version"] != str(VERSION):
            raise StateError(f"the state has version {given['version']}, but this release reads version {VERSION}")
        self._check_origin(given)
        empty = {name: like for name, like in self.to_host(self.allocate(1)).items() if like.ndim}
        lengths = [np.shape(arrays[name])[0] for name in empty if name in arrays and np.shape(arrays[name])]
        rows = max(set(lengths), key=lengths.count, default=0)
        arrays = {name: check_array(name, arrays, like.dtype, (rows, *like.shape[1:])) for name, like in empty.items()}
        if (arrays[COUNT] < 0).any():
            raise StateError(f"{COUNT} of the state is {arrays[COUNT].min()}; allowed: 0 or more")
        state = self.allocate(rows)
        words = [np.ascontiguousarray(arrays[name]).reshape(rows, -1).view(np.uint32) for name in self.fields]
        state.words.assign(np.concatenate(words, axis=1))
        state.contacts.start.assign(np.arange(rows) * state.contacts.capacity)
        state.contacts.count.assign(arrays[COUNT])
        for name in state.contacts.history._cls.vars:
            target = getattr(state.contacts.history, name)
            target.assign(arrays[f"contacts.{name}"].reshape(target.shape[0], *arrays[f"contacts.{name}"].shape[2:]))
        return state

    def _check_origin(self, origin: Mapping[str, str]) -> None:
        """Raise StateError unless a state of these checksums fits the worlds."""
        for key, noun in ORIGINS.items():
            if origin[key] != self.origin[key]:
                raise StateError(f"the state is of another {noun} ({origin[key][:8]}, not {self.origin[key][:8]})")

    def _checked(self, worlds: Sequence[int]) -> Sequence[int]:
        """The worlds, if all of them exist, once each."""
        if wrong := [world for world in worlds if not 0 <= world < self.worlds]:
            raise StateError(f"there is no world {wrong[0]}; the simulation has worlds 0 to {self.worlds - 1}")
        if len(set(worlds)) < len(worlds):
            raise StateError("a world is named twice")
        return worlds


def check_array(name: str, arrays: Mapping[str, np.ndarray], dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    """Array of a state on the host, copied; raises StateError if it is missing, has another type or shape, or is not finite."""
    if name not in arrays:
        raise StateError(f"the state lacks {name}; allowed: all arrays of `state_to_host`")
    values = np.array(arrays[name])
    if (values.dtype, values.shape) != (dtype, shape):
        raise StateError(f"{name} of the state is {values.dtype} {values.shape}; allowed: {dtype} {shape}")
    if not np.isfinite(values).all():
        raise StateError(f"{name} of the state has a value that is not finite, in row {np.argwhere(~np.isfinite(values))[0][0]}")
    return values


def checksum(catalog: Catalog) -> str:
    """SHA-256 of what physics and perception know of a catalog's objects, in hexadecimal digits."""
    digest = hashlib.sha256()
    for entry in catalog.bodies:
        shapes = (entry.mesh.vertices, entry.mesh.faces, *(piece.vertices for piece in entry.pieces), entry.inertia, entry.center_of_mass)
        digest.update(repr((entry.obj_id, entry.mass, [np.shape(shape) for shape in shapes])).encode())
        for shape in shapes:
            digest.update(np.ascontiguousarray(shape))
    return digest.hexdigest()


def cell_checksum(cell: Cell, gripper: Gripper) -> str:
    """SHA-256 of the extents of a cell's bins and of the gripper's settings, in hexadecimal digits; meshes count by their own checksums."""
    parts = [*(bin_.measured or bin_ for bin_ in cell.bins), replace(gripper, mesh="")]
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def copy_fresh(groups: Mapping[str, object], physics: Physics) -> dict[str, np.ndarray]:
    """Copy to the host what one world holds before the first tick, by the names of fields (scalar); the solver's fields are missing."""
    rows = find_rows(physics.model, physics.state, physics.control)
    named = dict(_find_arrays(groups)) | {f"physics.{name}": array for name, array in rows.items()}
    return {name: array[: array.shape[0] // physics.layout.worlds].numpy().flatten() for name, array in named.items()}


def _find_arrays(groups: Mapping[str, object]) -> Iterator[tuple[str, wp.array]]:
    """Arrays by world that dataclasses declare, by name of the group and the field."""
    for group, owner in groups.items():
        for item in fields(owner):  # type: ignore[arg-type]
            spec: ArraySpec = item.metadata["array"]
            if spec.shape[0] == "world":
                yield f"{group}.{item.name}", getattr(owner, item.name)


def _describe(name: str, array: wp.array, worlds: int, first: int) -> Field:
    """Part of a row that an array holds of a world; its words begin at `first`."""
    scalar = getattr(array.dtype, "_wp_scalar_type_", array.dtype)
    shape = (array.shape[0] // worlds, *array.shape[1:], *getattr(array.dtype, "_shape_", ()))
    shape = shape[1:] if shape[0] == 1 and array.shape[0] == worlds else shape
    field = Field(name, np.dtype(wp.dtype_to_numpy(scalar)), shape, first)
    if array.shape[0] % worlds or not array.is_contiguous or field.dtype.itemsize % WORD:
        raise ValueError(f"{name} does not hold whole words of each of {worlds} worlds")
    return field
