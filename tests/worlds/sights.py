"""Small simulations with perception."""

from __future__ import annotations

from typing import Any

from synpick_warp.configs.schema import Config
from synpick_warp.scenes.bins import make_bins, make_fixtures
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.lights import load_lights
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.render.scene import RenderScene, build_render_scene
from synpick_warp.stages.sim.physics import MIN_GPU_WORLDS
from synpick_warp.stages.sim.simulate import Simulation
from tests.worlds.small_worlds import COARSE, catalog, settings

LIGHTS = 1

SHORT = {
    "bake__mode": "pick",
    "perception__resolution": [320, 180],
    "pick__appear_height": 0.2,
    "pick__lift_height": 0.2,
    "pick__lift_speed": 1.2,
    "pick__near_speed": 0.5,
}
"""Settings under which an attempt takes about 10 ticks instead of 55."""
CALM = {"pick__appear_height": 0.3, "pick__lift_height": 0.3, "pick__lift_speed": 0.6, "pick__near_speed": 0.2}
"""Changes to SHORT under which a descent takes several ticks, and what hangs at the end of a lift does not swing."""

BRIEF = (
    COARSE | SHORT | {"arrangement__max_objects": 3, "pick__failures": 1, "perception__resolution": [160, 90], "physics__guide_height": 0.4}
)
BRIEF |= {"bake__mode": "mixed", "bake__episodes": 8}
"""Settings under which an attempt takes few and short ticks."""


def render_scene(config: Config, objects: Catalog, device: Any) -> RenderScene:
    """The scene of a bake, under one light."""
    fixtures, lights = make_fixtures(make_bins(config.cell.bins), config.gripper), load_lights("")[:LIGHTS]
    return build_render_scene(config.render, -config.tote.wall, objects, fixtures, make_cameras(config.rig), lights, device)


def brief(device: Any, worlds: int, **changed: Any) -> Simulation:
    """Small worlds of BRIEF, with changes; on a GPU as many as agree with larger numbers to the bit."""
    worlds = max(worlds, MIN_GPU_WORLDS) if device.is_cuda else worlds
    return picking(settings(**BRIEF | {"bake__worlds": worlds} | changed), catalog(), device)


def picking(config: Config, objects: Catalog, device: Any, **other: Any) -> Simulation:
    """Worlds that can see; `other` goes to the simulation."""
    return Simulation(config, objects, LIGHTS, device, render_scene(config, objects, device), **other)
