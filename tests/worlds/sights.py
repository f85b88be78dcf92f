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
from tests.worlds.small_worlds import COARSE, QUICK_PICKS, catalog, settings

LIGHTS = 1

SHORT = QUICK_PICKS | {"bake.mode": "pick", "perception.resolution": [320, 180]}
"""Settings of short attempts."""
CALM = {"pick.appear_height": 0.3, "pick.lift_height": 0.3, "pick.lift_speed": 0.6, "pick.near_speed": 0.2}
"""Changes to SHORT under which a descent takes several ticks, and what hangs at the end of a lift does not swing."""

BRIEF = COARSE | SHORT | {"arrangement.max_objects": 3, "pick.failures": 1, "perception.resolution": [160, 90]}
BRIEF |= {"physics.guide_height": 0.4, "bake.mode": "mixed", "bake.episodes": 8}
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
