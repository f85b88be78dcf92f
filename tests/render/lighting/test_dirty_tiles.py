"""Tiles that are kept from frame to frame: pictures have the bytes of those that are shaded whole, whatever moves, in any batches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from synpick_warp.configs.schema import FAST, UNOCCLUDED
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.kernels.render.visibility.gbuffer import SHADE_PASS
from synpick_warp.stages.buffers import ViewBuffers, allocate_view_buffers
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.view_setup import make_views
from tests.render.lighting.test_history import LIGHT, link
from tests.render.lighting.test_shadows import LAMPS
from tests.worlds.shapes import UPRIGHT, ball, box, camera, entry, sheet
from tests.worlds.toy_scene import ToyScene, build_scene, snapshot, with_render

FRAMES = 16
CAMERAS = (camera(90, 61, 200.0, (0.0, 0.0, 1.2)), camera(90, 61, 240.0, (0.05, 0.0, 1.5)))
ENTRIES = [entry(sheet(0.5, 0.4)), entry(box(0.04, 0.04, 0.06)), entry(ball(0.03, 3)), entry(box(0.08, 0.01, 0.03))]
ROOM = 6
KEPT = ((True, 0), (True, 1), (False, 0))
"""`render.reuse` and `render.reuse_worlds`: tiles are kept in both worlds, in the first only, in none."""


def scripts(seed: int) -> list[ToyScene]:
    """Two worlds over the frames: bodies rest, creep, jump, turn, appear and disappear at random."""
    random = np.random.default_rng(seed)
    worlds = [
        [[0, (0.0, 0.0, 0.0, *UPRIGHT)]]
        + [[int(random.integers(1, 4)), (*random.uniform(-0.15, 0.15, 2), random.uniform(0.03, 0.15), *UPRIGHT)] for _ in range(4)]
        for _ in range(2)
    ]
    frames = []
    for _ in range(FRAMES):
        for world in worlds:
            kind, which = random.integers(0, 8), int(random.integers(1, 5))
            position = np.array(world[which][1][:3])
            if kind < 3:
                position += random.normal(0.0, (1e-5, 1e-3, 3e-2)[kind], 3)
            turn = random.uniform(0.0, 1.0) if kind == 3 else 0.0
            pose = (*position, *UPRIGHT) if kind != 3 else (*position, 0.0, 0.0, np.sin(turn), np.cos(turn))
            if kind < 4:
                world[which][1] = pose
            elif kind == 4:
                world[which][0] = int(random.integers(1, 4)) if world[which][0] < 0 else -1
        frames.append([[(entry_index, pose) for entry_index, pose in world] for world in worlds])
    return frames  # type: ignore[return-value]


def labels_of(out: ViewBuffers, view: int) -> dict[str, np.ndarray]:
    """Images, masks, counts and boxes of a view."""
    arrays = {name: getattr(out, name).numpy()[view] for name in ("color", "depth", "instance", "pixels", "boxes")}
    box, first, words = (getattr(out, name).numpy()[view] for name in ("mask_box", "mask_first", "mask_words"))
    used = int(out.mask_length.numpy()[view])
    assert 0 < used <= len(words)
    return arrays | {"mask_box": box, "mask_first": first, "mask_words": np.pad(words[:used], (0, len(words) - used))}


def play(renderer: Renderer, frames: list, toy: ToyScene, seed: int) -> tuple[list[dict[str, np.ndarray]], list[float]]:
    """Render the views of all frames, in random order and batches: by frame, the outputs of each world and camera (view, ...); and the
    fraction of tiles that were shaded, by batch."""
    random, device = np.random.default_rng(seed), renderer.scene.device
    before, pictures, shares = None, [], []
    for frame, placed in enumerate(frames):
        state = snapshot(replace(toy, placed=placed), device)
        state.frame.fill_(frame)
        link(state, before or state)
        views = [{} for _ in range(4)]
        for part in np.split(random.permutation(4), np.flatnonzero(random.random(3) < 0.4) + 1):
            world, which = (wp.array(values.astype(np.int32), dtype=wp.int32, device=device) for values in (part // 2, part % 2))
            out = allocate_view_buffers(len(part), 90, 61, ROOM, device)
            renderer.render(state, make_views(world, which, len(part), ROOM), out)
            for place, view in enumerate(part):
                views[view] = labels_of(out, place)
            shares.append(((renderer.image.passes.numpy()[: len(part)] & int(SHADE_PASS)) != 0).mean())
        pictures.append({name: np.stack([view[name] for view in views]) for name in views[0]})
        before = state
    return pictures, shares


@pytest.mark.parametrize(
    ("size", "lights", "mode"),
    [(1, LAMPS, FAST), (2, LAMPS, FAST), (3, LAMPS, FAST), (2, LIGHT, FAST), (2, LAMPS, UNOCCLUDED)],
    ids=["1", "2", "3", "gradient", "unoccluded"],
)
def test_kept_tiles_have_the_bytes_of_whole_pictures(device, size, lights, mode):
    frames, pictures, shares = scripts(size), {}, {}
    for seed, (reuse, worlds) in enumerate(KEPT):
        config = with_render(coarse_pixel=size, coarse_paths=1, reuse=reuse, reuse_worlds=worlds, mode=mode)
        toy = ToyScene(ENTRIES, frames[0], CAMERAS, lights=(lights,), instances=ROOM, config=config)
        renderer = make_renderer(toy.settings(), build_scene(toy, device), ROOM, 4, histories=4)
        pictures[seed], shares[seed] = play(renderer, frames, toy, seed=seed)
    for frame, (kept, part, whole) in enumerate(zip(*pictures.values(), strict=True)):
        for name in whole:
            np.testing.assert_array_equal(kept[name], whole[name], err_msg=f"{name} of frame {frame}")
            np.testing.assert_array_equal(part[name], whole[name], err_msg=f"{name} of frame {frame}, one world kept")
    assert np.mean(shares[0]) < np.mean(shares[1]) < np.mean(shares[2]) == 1.0
    assert np.mean(shares[0]) < 0.9


def test_a_still_scene_is_shaded_when_its_light_is_due(device):
    toy = ToyScene(ENTRIES, scripts(0)[0], CAMERAS, lights=(LAMPS,), instances=ROOM, config=with_render(coarse_pixel=2, coarse_paths=1))
    renderer = make_renderer(toy.settings(), build_scene(toy, device), ROOM, 4, histories=4)
    _, shares = play(renderer, [toy.placed] * 120, toy, seed=0)
    due = np.array(shares)[-60:]
    assert set(np.unique(due.round(6)).tolist()) <= {0.0, 0.25, 0.333333, 0.5, 0.666667, 0.75, 1.0}
    assert due.mean() < 0.2 < shares[0] == 1.0
