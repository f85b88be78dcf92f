"""Worlds without a physics engine: state and constants of kernels, with bodies at fixed poses."""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.configs.cell.bins import Bins, BinSizes, Tote
from synpick_warp.configs.episodes.manipulation import Move
from synpick_warp.configs.episodes.randomize import Randomize
from synpick_warp.kernels import structs
from synpick_warp.scenes.build import WorldPart
from synpick_warp.scenes.looks import Looks
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.constants import SceneData, bin_data, fill, mode_data
from synpick_warp.stages.perception.images import Observation, Plan
from synpick_warp.stages.render.looks import build_look_table
from synpick_warp.stages.sim.worlds import CORNERS, AttemptState, SealState, WorldState, world_sizes

GROUPS = ("scene", "state", "attempts", "seals", "observation", "plan", "physics")
"""Attributes that `run` passes to a stage by parameter name."""
GRIPPER_BODIES, GRIPPER_DOFS = 2, 4
GUIDES = (6, 7, 8, 9)
BIN = BinSizes("box", "bin", Tote(), outer=(0.55, 0.35), floor=(0.8, 0.4), opening=(0.5, 0.3), height=0.2, base=-0.005)
"""Bin whose waypoints are at (±0.2, ±0.1, 0.02) m."""
SHAPES = 20

DROP: dict[str, Any] = {
    "exceed": 0,
    "volume": 1.0,
    "move_repeats": 1,
    "pick_repeats": 1,
    "clearance": 0.01,
    "spread": 0.5,
    "layers": 0,
    "gravity": 9.81,
    "gripper_home": wp.vec3(3.0, 0.0, 1.0),
    "lights": 5,
    "random_yaw": 1,
    "exposure_spread": 0.5,
}
SETTLE: dict[str, Any] = {
    "min_ticks": 3,
    "max_ticks": 100,
    "rest_ticks": 2,
    "stuck_ticks": 2,
    "late_ticks": 50,
    "rest_threshold": 1e-4,
    "relaxed_rest_threshold": 1e-3,
    "stuck_depth": 0.01,
    "max_redrops": 8,
}
MOVE: dict[str, Any] = {
    "waypoints": 8,
    "start_height": 0.3,
    "tcp_offset": 0.05,
    "mass": 2.0,
    "gravity": 9.81,
    "step": 2e-3,
    "stiffness": 1000.0,
    "damping": 60.0,
    "force": 30.0,
    "speed": 0.1,
}
"""Default members of the structs, overridden by the fields of `KernelWorlds` with the same names in lower case."""


def cup_places(cups: Sequence[tuple[float, float]], device: Any, tcp_offset: float = MOVE["tcp_offset"]) -> wp.array:
    """Places of cups in the frame of the wrist [m]."""
    return wp.array([(x, y, -tcp_offset) for x, y in cups], dtype=wp.vec3, device=device)


@dataclass
class KernelWorlds:
    """State and constants of worlds for running single stages; arrays are read and written by name."""

    device: Any
    worlds: int
    objects: int = 1
    """Number of single objects of volume 1 m³ and radius 1 m, where `volume`, `compound` and `radius` do not say otherwise."""
    instances: int = 0
    """Instance capacity of a world; 0: the number of objects. `single_slots` defaults to the number of instances."""
    single_slots: int | None = None
    compound_slots: int = 0
    volume: Any = None
    compound: Any = None
    radius: Any = None
    drop: dict[str, Any] = field(default_factory=dict)
    settle: dict[str, Any] = field(default_factory=dict)
    move: dict[str, Any] = field(default_factory=dict)
    pick: dict[str, Any] = field(default_factory=dict)
    bins: tuple[BinSizes, ...] = (BIN,)
    places: Bins = field(default_factory=Bins)
    randomize: Randomize = field(default_factory=Randomize)
    distractors: int = 0
    """Number of distractors: the last objects, without labels."""
    counts: Sequence[tuple[int, int]] = ()
    """Minimum and maximum number of each object; empty: drawn by volume."""
    cups: Sequence[tuple[float, float]] = ((0.0, 0.0),)
    """Places of the cups in the plane of the TCP [m]."""
    parts: Sequence[tuple[int, int, bool]] = tuple((shape, 0, True) for shape in GUIDES)

    def __post_init__(self) -> None:
        self.volume = np.ones(self.objects) if self.volume is None else self.volume
        self.compound = np.zeros(len(self.volume), int) if self.compound is None else self.compound
        self.radius = np.ones(len(self.volume)) if self.radius is None else self.radius
        self.instances = self.instances or len(self.volume)
        self.single_slots = self.instances if self.single_slots is None else self.single_slots
        self.slots = self.single_slots + self.compound_slots
        self.bodies, self.coords, self.dofs = GRIPPER_BODIES + self.slots, GRIPPER_DOFS + 7 * self.slots, GRIPPER_DOFS + 6 * self.slots
        move = MOVE | self.move
        layout = {"gripper_bodies": GRIPPER_BODIES, "gripper_dofs": GRIPPER_DOFS, "shapes": SHAPES, "finger_shape": 10}
        places = cup_places(self.cups, self.device, move["tcp_offset"])
        parts = [WorldPart(*part) for part in self.parts]
        self.scene = SceneData(
            fill(structs.LayoutData, self, **layout),
            self._catalog(),
            fill(structs.DropData, **(DROP | {"objects": self.instances} | self.drop)),
            fill(structs.SettleData, **(SETTLE | self.settle)),
            mode_data([(0, 0.0, 0.0, 0, 0)], self.device),
            fill(structs.MoveData, **move),
            filled(structs.PickData(), self.pick),
            structs.PerceptionData(),
            filled(structs.SuctionData(), {"tcp_offset": move["tcp_offset"]}),
            filled(structs.CupData(), {"count": len(self.cups), "place": places}),
            bin_data(self.bins, self.places, Move(corner=0.5), parts, self.device),
            build_look_table(Looks(self.randomize, (), ()), 0, self.device),
        )
        sizes = world_sizes(self.worlds, self.instances, move["waypoints"] // CORNERS, self.bodies, len(self.cups))
        self.state = allocate(WorldState, sizes, self.device)
        self.state.bin_pose.fill_(wp.transform_identity())
        self.scene.bins.chosen, self.scene.bins.pose = self.state.bin, self.state.bin_pose
        self.attempts = allocate(AttemptState, sizes, self.device)
        self.seals = allocate(SealState, sizes, self.device)
        self.observation = allocate(Observation, sizes, self.device)
        self.plan = allocate(Plan, sizes, self.device)
        self.physics = self._physics()

    def _catalog(self) -> Any:
        compound = np.asarray(self.compound, np.int32)
        # Variants as in scenes.build: position among the objects of the same slot class.
        variant = np.where(compound == 1, np.cumsum(compound), np.cumsum(1 - compound)) - 1
        limits = np.array(self.counts or np.zeros((len(compound), 2)), np.int32)
        columns = {
            "volume": (self.volume, float),
            "radius": (self.radius, float),
            "mass": (np.ones_like(self.radius), float),
            "area": (np.ones_like(self.radius), float),
            "diagonal": (self.radius, float),
            "compound": (compound, int),
            "variant": (variant, int),
            "least": (limits[:, 0], int),
            "most": (limits[:, 1], int),
        }
        arrays = {name: wp.array(np.asarray(values), dtype=dtype, device=self.device) for name, (values, dtype) in columns.items()}
        return fill(
            structs.CatalogData,
            count=len(compound) - self.distractors,
            distractors=self.distractors,
            counted=int(limits[:, 1].sum()),
            empty_single=int((compound == 0).sum()),
            empty_compound=int(compound.sum()),
            empty_mass=0.1,
            **arrays,
        )

    def _physics(self) -> Any:
        def zeros(per_world: int, dtype: Any = float) -> wp.array:
            return wp.zeros(self.worlds * per_world, dtype=dtype, device=self.device)

        body_q = zeros(self.bodies, wp.transform)
        body_q.fill_(wp.transform_identity())
        contacts = SimpleNamespace(rigid_contact_max=0)
        return SimpleNamespace(
            state=SimpleNamespace(
                joint_q=zeros(self.coords), joint_qd=zeros(self.dofs), body_q=body_q, body_qd=zeros(self.bodies, wp.spatial_vector)
            ),
            control=SimpleNamespace(joint_f=zeros(self.dofs), joint_target_q=zeros(self.coords)),
            solver=SimpleNamespace(constraint_overflow=zeros(1, wp.bool)),
            lost=zeros(1, wp.int32),
            model=SimpleNamespace(shape_transform=zeros(SHAPES, wp.transform), shape_body=zeros(SHAPES, int)),
            contacts=contacts,
            load=lambda variant, restarted: None,
        )

    def array(self, name: str) -> wp.array:
        """The array of this name in whichever group of state or physics has it."""
        physics = self.physics
        groups = (self.state, self.attempts, self.seals, self.observation, self.plan)
        owners = (*groups, physics.state, physics.control, physics.solver, physics.model, physics)
        return next(getattr(owner, name) for owner in owners if hasattr(owner, name))

    def __getitem__(self, name: str) -> np.ndarray:
        """Values of the array of this name, on the host."""
        return self.array(name).numpy()

    def row(self, *names: str, world: int = 0) -> list[Any]:
        """Rows of arrays for one world, as Python numbers and lists."""
        return [self[name][world].tolist() for name in names]

    def put(self, **values: Any) -> None:
        """Write values, broadcast, to arrays by their names."""
        for name, value in values.items():
            array = self.array(name)
            array.assign(np.broadcast_to(np.asarray(value, array.numpy().dtype), array.numpy().shape).copy())

    def run(self, stage: Callable[..., None], *others: Any) -> None:
        """Run a stage on the groups that its parameters name, and `current`, the physics' state; its other arguments are `others`."""
        given = {name: getattr(self, name) for name in GROUPS} | {"current": self.physics.state}
        rest = iter(others)
        parameters = inspect.signature(stage).parameters.values()
        stage(*(given[item.name] if item.name in given else next(rest, item.default) for item in parameters))

    def begin(self, phase: int, episodes: Any = None, arrangement: Any = 0) -> None:
        """Set the phase and arrangement of all worlds; by default world w has episode w."""
        episodes = np.arange(self.worlds) if episodes is None else episodes
        self.put(phase=phase, arrangement_id=np.stack(np.broadcast_arrays(episodes, arrangement), axis=-1))

    def coordinates(self) -> np.ndarray:
        """Poses of all slots (world, slot, 7)."""
        return self["joint_q"].reshape(self.worlds, -1)[:, GRIPPER_DOFS:].reshape(self.worlds, self.slots, 7)

    def forces(self) -> np.ndarray:
        """Joint forces of all slots (world, slot, 6)."""
        return self["joint_f"].reshape(self.worlds, -1)[:, GRIPPER_DOFS:].reshape(self.worlds, self.slots, 6)

    def place(self, world: int, instance: int, pose: Any) -> None:
        """Write the pose (7) of an instance's body."""
        body_q = self["body_q"]
        body_q[world * self.bodies + GRIPPER_BODIES + self["body_slot"][world, instance]] = pose
        self.put(body_q=body_q)


def filled(struct: Any, values: dict[str, Any]) -> Any:
    """Set members of a struct; return it."""
    for name, value in values.items():
        setattr(struct, name, value)
    return struct


def arrangement_worlds(device: Any, worlds: int, mix: tuple[float, float, float] = (0.0, 0.0, 1.0), **sizes: Any) -> KernelWorlds:
    """Worlds with three objects, whose modes are sampled with these weights of pick, target and move."""
    default = {
        "volume": np.array([0.1, 0.2, 0.3]),
        "compound": np.array([0, 1, 0]),
        "radius": np.array([0.05, 0.1, 0.2]),
        "instances": 8,
        "single_slots": 8,
        "compound_slots": 8,
    }
    result = KernelWorlds(device, worlds, **(default | sizes))
    shares = (np.cumsum(mix)[:2] / np.sum(mix)).tolist()
    result.scene = replace(result.scene, modes=mode_data([(0, *shares, 0, 0)], device))
    return result
