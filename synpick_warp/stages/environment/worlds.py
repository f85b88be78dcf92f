"""Worlds of the vector environment: attempts of different lengths, ticks of twists (Cartesian velocity control), resets from the bank of
piles; observations, images of one camera in all worlds, and state vectors.

A world whose attempt has ended is saved in that tick; when all have ended, every world is loaded as it was saved. So what a world does
depends neither on the others nor on how long these take.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.codes import Outcome
from synpick_warp.configs import schema
from synpick_warp.configs.cell.cameras import Rig
from synpick_warp.errors import StateError
from synpick_warp.kernels.environment import attempts, observations, twist
from synpick_warp.kernels.environment import attempts as kernels
from synpick_warp.stages.arrays import allocate, allocate_struct, device_array, struct_arrays
from synpick_warp.stages.buffers import Snapshot, allocate_view_buffers
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.launch import launch, launch_pixels
from synpick_warp.stages.perception.images import PerceptionImages, Plan
from synpick_warp.stages.render.view_setup import make_views
from synpick_warp.stages.sim import gripper
from synpick_warp.stages.sim.physics import Physics
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.sim.worlds import AttemptState, WorldState
from synpick_warp.stages.view_ring import CameraGroup
from synpick_warp.views.picks import MOVED


@dataclass(frozen=True, eq=False)
class SightArrays:
    """Latest images and state vectors of every world; None: not observed."""

    depth: wp.array = device_array("world", "row", "column", dtype=wp.float32, unit="m")
    """Planar depth; 0: no surface."""
    segment: wp.array = device_array("world", "row", "column", dtype=wp.uint8)
    """Segmentation id: 0 nothing, 1 + instance_id, or a `Segment`."""
    normal: wp.array = device_array("world", "row", "column", dtype=wp.vec3)
    """Unit shading normal in the world's frame, facing the camera."""
    cloud: wp.array = device_array("world", "row", "column", dtype=wp.vec3, unit="m")
    """Surface point in the camera's axes; NaN: no surface."""
    color: wp.array = device_array("world", "row", "column", dtype=wp.vec3ub)
    """sRGB, red first."""
    mask: wp.array = device_array("world", "row", "column", dtype=wp.uint8)
    """1: the pixel shows the target."""
    point: wp.array = device_array("world", dtype=wp.vec3, unit="m")
    """Grasp point that perception finds on the target; 0 without one."""
    state: wp.array = device_array("world", "value", dtype=wp.float32)
    """State vector of gripper and instances; see `write_states_kernel`."""


IMAGES = {"depth", "segment", "normal", "mask", "cloud"}
"""Arrays that follow from the G-buffer, without shading."""


class Sight:
    """Sensor suite of all worlds: renders images and writes state vectors, without copies to the host."""

    def __init__(
        self,
        settings: schema.Perception,
        rig: Rig,
        simulation: Simulation,
        group: CameraGroup,
        resolution: tuple[int, int],
        wanted: Collection[str],
        shows_gripper: bool,
    ) -> None:
        """Allocate images and vectors: `wanted` fields of `SightArrays`, of `perception.camera` or the first, whose group has the renderer,
        at a resolution (width, height) [px]. `shows_gripper`: whether images other than `color` show the gripper."""
        self.simulation, self.group, self.renderer, self.device = simulation, group, group.renderer, simulation.device
        self.camera = rig.index(settings.camera)
        width, height = resolution
        self._window = round(settings.normal_window * width / settings.resolution[0])
        worlds, instances = simulation.layout.worlds, simulation.layout.instances
        values = int(observations.GRIPPER_VALUES) + instances * int(observations.INSTANCE_VALUES)
        sizes = {"world": worlds, "row": height, "column": width, "value": values}
        only = {*wanted, *(IMAGES - {"mask", "cloud"} if IMAGES & set(wanted) else ())}
        self.arrays = allocate(SightArrays, sizes, self.device, only)
        self.images: PerceptionImages | None = None
        if IMAGES & only:
            seen = replace(settings, resolution=(width, height), views=0, contour_points=1)  # Contours are not traced.
            self.images = PerceptionImages(seen, rig, self.renderer.scene, worlds, instances)
            shown = int(shows_gripper)
            visible = [[simulation.scene.bins.visible, shown, shown]] * worlds
            self.images.fixture_visible.assign(np.array(visible, np.int32))
        self._buffers = allocate_view_buffers(self.renderer.views, width, height, instances, self.device) if "color" in only else None

    def observe(self, snapshot: Snapshot) -> SightArrays:
        """Observe all worlds; returns the arrays, which the next call overwrites."""
        simulation, arrays = self.simulation, self.arrays
        worlds = np.arange(simulation.layout.worlds)
        if self.images is not None:
            for first in range(0, len(worlds), self.images.views.count):
                self._copy_images(snapshot, worlds[first : first + self.images.views.count])
        if arrays.color is not None:
            for first in range(0, len(worlds), self.renderer.views):
                self._render(snapshot, worlds[first : first + self.renderer.views])
        if arrays.mask is not None:
            sources = {"segment": arrays.segment, "target": simulation.plan.target, "mask_out": arrays.mask}
            launch(observations.write_target_masks_kernel, arrays.mask.shape, **sources)
        if arrays.point is not None:
            plan = simulation.plan
            launch(observations.write_target_points_kernel, len(worlds), target=plan.target, planned=plan.point, point_out=arrays.point)
        if arrays.state is not None:
            sources = (simulation.scene, simulation.state, simulation.seals, simulation.plan, simulation.physics.state)
            given = {"object_id": self.renderer.scene.obj_id, "values_out": arrays.state}
            launch(observations.write_states_kernel, len(worlds), *sources, **given)
        return arrays

    def grasp_pixels(self, pixel: wp.array, point: wp.array, direction: wp.array, instance: wp.array, running: wp.array) -> None:
        """Back-project pixels (world) of the last images to surface points, with direction and instance; see `grasp_pixels_kernel`. Raises
        ValueError if there are no images."""
        if self.images is None:
            raise ValueError("pixels are no actions without images")
        given = {"window": self._window, "views": self.images.views, "pixel": pixel, "running": running}
        given |= {"point": point, "direction": direction, "instance": instance}
        launch(attempts.grasp_pixels_kernel, len(pixel), self.arrays, **given)

    def _copy_images(self, snapshot: Snapshot, worlds: np.ndarray) -> None:
        """Render the G-buffer of a batch of worlds, and copy depth, segmentation and normals to their images."""
        images, arrays = self.images, self.arrays
        padded = np.full(images.views.count, -1, np.int32)
        padded[: len(worlds)] = worlds
        images.views.world.assign(padded)
        images.render(snapshot)
        inputs = [images.scene.meshes, images.scene.surfaces, images.scene.grid, images.bodies, images.gbuffer, images.drawn]
        outputs = [arrays.depth, arrays.segment, arrays.normal, arrays.cloud]
        launch_pixels(observations.copy_images_kernel, images.pixels, inputs, outputs, self.device)

    def _render(self, snapshot: Snapshot, worlds: np.ndarray) -> None:
        renderer = self.renderer
        camera = np.full(len(worlds), self.camera, np.int32)
        rows = [wp.array(values, dtype=wp.int32, device=self.device) for values in (worlds, camera, self.group.slots(camera))]
        views = make_views(rows[0], rows[1], len(worlds), renderer.instances, slot=rows[2])
        renderer.render(snapshot, views, self._buffers)
        first, count = int(worlds[0]), len(worlds)
        wp.copy(self.arrays.color[first : first + count], self._buffers.color[:count])


RESULTS = struct_arrays(kernels.Results, "world", pose=("world", "instance"), units={"peak_force": "N", "farthest": "m", "pose": "m"})
SHOWN = ("outcome", "picked", "hits", "peak_force", "ticks", "moved", "farthest", "lost")
"""Fields of `Results` that are copied to the host."""
LONGEST = 4096
"""Timeout of an attempt [ticks], which is never reached: setpoints arrive long before."""
COLUMNS = 6
"""Columns of a command: linear velocity (3) [m/s], rates of yaw and tilt [rad/s], suction (on above 0)."""
POLL = 8
"""Polling interval for piles at rest, and for attempts that have ended [ticks]."""


class TwistLaw:
    """Twist control as a `SetpointLaw`, in all modes. `command`: velocities of each world (world, column) float32; read in every step."""

    def __init__(self, simulation: Simulation, lower: np.ndarray, upper: np.ndarray) -> None:
        """Allocate the commands; `lower` and `upper` are the corners of the box to which setpoints are clamped, each (3) [m]."""
        self.simulation = simulation
        self.lower, self.upper = wp.vec3(*lower.tolist()), wp.vec3(*upper.tolist())
        self.command = wp.zeros((simulation.layout.worlds, COLUMNS), dtype=wp.float32, device=simulation.device)

    def begin(self, scene: SceneData, state: WorldState, attempts: AttemptState, plan: Plan, physics: Physics) -> None:
        """Do nothing: `start_tick` begins attempts."""

    def start_tick(self) -> None:
        """Begin attempts, and apply the commands of the next tick to yaw, tilt and suction. Runs before the tick."""
        simulation = self.simulation
        physics, worlds = simulation.physics, simulation.layout.worlds
        sources = (simulation.scene, simulation.state, simulation.attempts, simulation.plan)
        given = {"command": self.command, "tick_time": simulation.config.physics.tick_time}
        launch(twist.begin_twists_kernel, worlds, *sources, simulation.seals, physics.state, physics.control, **given)
        physics.set_yaw(simulation.plan.yaw)

    def advance(self, scene: SceneData, state: WorldState, attempts: AttemptState, plan: Plan) -> None:
        """Integrate the setpoints over a step of physics."""
        given = {"command": self.command, "lower": self.lower, "upper": self.upper}
        launch(twist.follow_twists_kernel, len(state.phase), scene, state, self.simulation.physics.state, **given)

    def end_tick(self, scene: SceneData, state: WorldState, attempts: AttemptState, plan: Plan) -> None:
        """End attempts whose objects have been lifted to the height at which attempts begin."""
        launch(twist.end_twists_kernel, len(state.phase), scene, state, attempts, plan, self.simulation.physics.state)


class EnvironmentWorlds:
    """Simulated worlds that advance by an action at a time. The first `count` are environments; others pad the batch on a GPU, idle."""

    def __init__(self, simulation: Simulation, sight: Sight, count: int, piles: int, law: TwistLaw | None, targets: bool) -> None:
        """Take over worlds before their first tick, whose list of episodes is empty. `piles` is the capacity of the bank, raised to what
        resets need, `law` the twist control, if actions are twists, and `targets` whether perception chooses a target before each attempt.
        Raises StateError if memory is too short."""
        self.simulation, self.sight, self.count, self.law, self.targets = simulation, sight, count, law, targets
        self.device, worlds = simulation.device, simulation.layout.worlds
        simulation.tick(perceives=False)
        self.bank = PileBank(simulation, max(piles, 2 * count, worlds))
        self._held = simulation.states.allocate(worlds)
        sizes = {"world": worlds, "instance": simulation.layout.instances}
        self._results = allocate_struct(RESULTS, sizes, self.device)
        self._running, self._world, self._instance = (wp.zeros(worlds, dtype=wp.int32, device=self.device) for _ in range(3))
        self._done = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._point, self._direction = (wp.zeros(worlds, dtype=wp.vec3, device=self.device) for _ in range(2))
        self._pixel = wp.zeros(worlds, dtype=wp.vec2i, device=self.device)

    def reset(self, environments: np.ndarray, episodes: Sequence[int], ahead: Sequence[int] = ()) -> None:
        """Load the settled piles of episodes into environments; the others keep their states. `ahead`: as of `PileBank.fetch`. Raises
        StateError if a pile does not come to rest, or memory is too short."""
        states, others = self.simulation.states, np.setdiff1d(np.arange(self.count), environments)
        settles = self.bank.misses(episodes)
        if settles:
            states.save(self._held, self._table(others))
        rows = self.bank.fetch(episodes, ahead)
        if settles:
            states.load(self._held, self._table(others))
        states.load(self.bank.state, self._table(environments, rows))
        self._look()

    def attempt_pixels(self, active: np.ndarray, pixels: np.ndarray) -> dict[str, np.ndarray]:
        """Attempt to pick at pixels (environment, 2) of the last images in active environments; see `_attempt`."""
        self._running.assign(self._padded(active))
        self._pixel.assign(self._padded(pixels))
        self.sight.grasp_pixels(self._pixel, self._point, self._direction, self._instance, self._running)
        return self._attempt(active)

    def attempt_points(self, active: np.ndarray, points: np.ndarray, directions: np.ndarray) -> dict[str, np.ndarray]:
        """Attempt to pick at points (environment, 3) [m], along directions out of the surface, in active environments; see `_attempt`."""
        self._running.assign(self._padded(active))
        self._point.assign(self._padded(points).astype(np.float32))
        self._direction.assign(self._padded(directions).astype(np.float32))
        self._instance.fill_(-1)
        return self._attempt(active)

    def tick(self, active: np.ndarray, commands: np.ndarray) -> dict[str, np.ndarray]:
        """Advance active environments by a tick under commands (environment, column), see `TwistLaw`; results of the tick by name."""
        simulation, law, states = self.simulation, self.law, self.simulation.states
        if law is None:
            raise ValueError("commands are for worlds under twist control")
        law.command.assign(self._padded(commands).astype(np.float32))
        waiting = np.flatnonzero(~active)
        if len(waiting):
            states.save(self._held, self._table(waiting))
        self._running.assign(self._padded(active))
        law.start_tick()
        self._measure()
        simulation.tick(perceives=False)
        self._judge()
        if len(waiting):
            states.load(self._held, self._table(waiting))
        self._look()
        return self._read()

    def status(self) -> tuple[np.ndarray, np.ndarray]:
        """`Phase` and `Ending` of each environment."""
        state = self.simulation.state
        return state.phase.numpy()[: self.count], state.ending.numpy()[: self.count]

    def _attempt(self, active: np.ndarray) -> dict[str, np.ndarray]:
        """Simulate until every attempt has ended; returns the results: arrays (environment, ...) by the names of SHOWN.

        An environment whose pixel shows no surface keeps its state, with outcome NOTHING_SEEN.
        """
        simulation, states = self.simulation, self.simulation.states
        plan = simulation.plan
        given: dict[str, Any] = {"running": self._running, "grasp_point": self._point, "direction": self._direction}
        given |= {"instance": self._instance, "keeps_target": int(self.targets)}
        running = self._running.numpy().copy()
        states.save(self._held, self._table(np.flatnonzero(running == 0)))
        self._measure()
        launch(kernels.begin_attempts_kernel, len(running), simulation.scene, simulation.attempts, out=plan, **given)
        gripper.place_grippers(simulation.scene, simulation.state, simulation.attempts, plan, simulation.physics, simulation.behavior.law)
        ticks, count = 0, int(running.sum())
        while int(self._done.numpy()[0]) < count:
            if ticks > LONGEST:
                raise StateError(f"an attempt has not ended after {LONGEST} ticks")
            for _ in range(POLL):
                simulation.tick(perceives=False)
                self._judge()
                simulation.states.save(self._held, self._world)
            ticks += POLL
        states.load(self._held, self._table(np.arange(simulation.layout.worlds)))
        self._look()
        results = self._read()
        results["outcome"] = np.where(active & (running[: self.count] == 0), Outcome.NOTHING_SEEN, results["outcome"])
        return results

    def _measure(self) -> None:
        """Reset the results, and take the current poses as the reference from which motion is measured."""
        simulation = self.simulation
        self._done.zero_()
        sources = (simulation.scene, simulation.state, simulation.attempts, simulation.physics.state)
        launch(kernels.begin_results_kernel, simulation.layout.worlds, *sources, results=self._results)

    def _judge(self) -> None:
        simulation = self.simulation
        sources = (simulation.scene, simulation.state, simulation.attempts, simulation.seals, simulation.physics.state)
        given: dict[str, Any] = {"running": self._running, "results": self._results, "world": self._world, "done": self._done}
        launch(kernels.judge_attempts_kernel, simulation.layout.worlds, *sources, moved_distance=MOVED, **given)

    def _look(self) -> None:
        """Run perception, which chooses targets, in worlds that await an attempt."""
        simulation = self.simulation
        if self.targets and simulation.perception is not None:
            simulation.perception.perceive(simulation.record.snapshot)

    def _read(self) -> dict[str, np.ndarray]:
        return {name: getattr(self._results, name).numpy()[: self.count].copy() for name in SHOWN}

    def _table(self, worlds: np.ndarray, rows: Sequence[int] | None = None) -> wp.array:
        """Index table (world) int32: the row of each of `worlds` (None: its own index), -1 elsewhere."""
        table = np.full(self.simulation.layout.worlds, -1, np.int32)
        table[worlds] = worlds if rows is None else rows
        return wp.array(table, dtype=wp.int32, device=self.device)

    def _padded(self, values: np.ndarray) -> np.ndarray:
        """Pad values of the environments (environment, ...) with zeros for the other worlds."""
        padded = np.zeros((self.simulation.layout.worlds, *values.shape[1:]), np.int32 if values.dtype == bool else values.dtype)
        padded[: self.count] = values
        return padded


class PileBank:
    """Checkpoint bank of settled piles. Settling takes all worlds; a pile depends on its episode alone, not on world or bank.

    `rows` has the row of `state`, the checkpoints, by episode index."""

    def __init__(self, simulation: Simulation, capacity: int) -> None:
        """Allocate the bank for at most `capacity` piles of worlds after their first tick; raises StateError if memory is too short."""
        self.simulation, self.device = simulation, simulation.device
        self.state = simulation.states.allocate(capacity)
        self.rows: dict[int, int] = {}
        self._free = list(range(capacity))
        worlds = simulation.layout.worlds
        self._row, self._episode = (wp.zeros(worlds, dtype=wp.int32, device=self.device) for _ in range(2))
        self._world = wp.zeros(capacity, dtype=wp.int32, device=self.device)
        self._done = wp.zeros(2, dtype=wp.int32, device=self.device)

    def fetch(self, episodes: Sequence[int], ahead: Sequence[int] = ()) -> list[int]:
        """Look up the rows of episodes; settles the piles that the bank lacks, whereby the worlds' current states are lost. Those of
        `ahead` are prefetched by idle worlds. Raises StateError if the bank is too small, or a pile does not come to rest."""
        missing = [episode for episode in dict.fromkeys(episodes) if episode not in self.rows]
        if missing:
            worlds = self.simulation.layout.worlds
            kept = list(dict.fromkeys([*episodes, *ahead]))[: len(self.rows) + len(self._free)]
            if not set(episodes) <= set(kept):
                raise StateError(f"{len(set(episodes)):,} piles are asked for at once, but the bank keeps {len(kept):,}")
            room = -(-len(missing) // worlds) * worlds
            fill = (missing + [episode for episode in kept if episode not in self.rows and episode not in missing])[:room]
            self._make_room(len(fill), set(kept))
            for first in range(0, len(fill), worlds):
                self._settle(fill[first : first + worlds])
        return [self.rows[episode] for episode in episodes]

    def misses(self, episodes: Sequence[int]) -> bool:
        """Whether `fetch` would have to settle piles."""
        return any(episode not in self.rows for episode in episodes)

    def _make_room(self, count: int, kept: set[int]) -> None:
        """Evict piles that are not in `kept`, the oldest first, until `count` rows are free."""
        for episode in [episode for episode in self.rows if episode not in kept]:
            if len(self._free) >= count:
                break
            self._free.append(self.rows.pop(episode))

    def _settle(self, episodes: Sequence[int]) -> None:
        """Simulate piles until they rest, one in each world, and save each in the first tick at rest."""
        simulation, worlds, settle = self.simulation, self.simulation.layout.worlds, self.simulation.config.settle
        rows = [self._free.pop() for _ in episodes]
        for array, values in ((self._episode, episodes), (self._row, rows)):
            array.assign(np.append(values, np.full(worlds - len(values), -1)).astype(np.int32))
        self._done.zero_()
        launch(kernels.start_piles_kernel, worlds, simulation.state, episode=self._episode)
        rested = exhausted = 0
        while rested + exhausted < len(episodes):
            for _ in range(POLL):
                simulation.tick(perceives=False)
                self._world.fill_(-1)
                launch(kernels.list_settled_kernel, worlds, simulation.state, row=self._row, world=self._world, done=self._done)
                simulation.states.save(self.state, self._world)
            rested, exhausted = self._done.numpy().tolist()
        self._episode.fill_(-1)
        launch(kernels.start_piles_kernel, worlds, simulation.state, episode=self._episode)
        if exhausted:
            self._free += rows
            raise StateError(f"{exhausted} of {len(episodes)} piles do not come to rest in settle.tries = {settle.tries} arrangements")
        self.rows |= zip(episodes, rows, strict=True)
