"""Materials, textures and light maps as users bring them: what reaches the renderer, and what the command line refuses in one line."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
import warp as wp
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.schema import Config
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.scenes.assets.appearance import decode_texture
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.lights import MAX_RADIANCE
from synpick_warp.scenes.types import Material
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import LayerBuffers, ViewBuffers, view_buffer_sizes
from synpick_warp.stages.render.scene import build_render_scene, pack_texels
from synpick_warp.stages.render.view_setup import make_views
from tests.builders import mistake
from tests.worlds.toy_scene import UPRIGHT, ToyScene, build_scene, camera, entry, even_light, render, sheet, snapshot, sun

TEXEL, PIXELS = 0.01, 5
"""Width of a texel on a sheet [m], and in the picture: an odd number, so that some pixel's centre is a texel's."""
BAKE = ("bake", "--config", "smoke", "--device", "cpu", "--mode", "move")
IBL = "[Header]\nName = Room\n[Reflection]\nREFfile = room.hdr\n"


def glb(file: Path, **material) -> Path:
    """A box with texture coordinates and a glTF material."""
    box = trimesh.creation.box((0.1, 0.08, 0.06))
    box.visual = TextureVisuals(uv=np.random.default_rng(0).random((8, 2)), material=PBRMaterial(**material))
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(trimesh.Scene([box]).export(file_type="glb"))
    return file


def test_a_gltf_material_reaches_the_renderer(tmp_path, device):
    """Factors times the mean of the picture that glTF keeps roughness (green) and metalness (blue) in."""
    rough = np.zeros((4, 6, 3), np.uint8)
    rough[:, :3], rough[:, 3:] = (9, 100, 200), (9, 200, 240)
    glb(
        tmp_path / "models" / "box.glb",
        baseColorFactor=(255, 128, 0, 255),
        baseColorTexture=Image.new("RGB", (5, 3), (200, 100, 50)),
        metallicFactor=0.5,
        roughnessFactor=0.8,
        metallicRoughnessTexture=Image.fromarray(rough),
    )
    config = load_config(None, {"bake.models": str(tmp_path / "models")})
    catalog = load_catalog(config, tmp_path / "cache")
    toy = ToyScene([], [], (camera(8, 8, 8.0, (0.0, 0.0, 1.0)),))
    scene = build_render_scene(config.render, -config.tote.wall, catalog, toy.fixtures, toy.cameras, (even_light(),), device)
    surfaces = scene.surfaces
    assert surfaces.metallic.numpy()[0] == pytest.approx(0.5 * 220 / 255, abs=1e-3)
    assert surfaces.roughness.numpy()[0] == pytest.approx(0.8 * 150 / 255, abs=1e-3)
    # glTF's factor is linear, as are the renderer's colours.
    assert surfaces.color.numpy()[0] == pytest.approx((1.0, 128 / 255, 0.0), abs=2e-3)
    assert surfaces.texture_size.numpy()[0].tolist() == [5, 3]
    assert surfaces.texel.numpy()[0] == pack_texels(np.array([[[200, 100, 50]]], np.uint8))[0]


def albedo(material: Material, rows: int, columns: int, device) -> np.ndarray:
    """Base colour of a sheet of rows x columns texels, as the renderer looks it up (rows x PIXELS, columns x PIXELS, 3) uint8."""
    view = camera(PIXELS * columns, PIXELS * rows, PIXELS / TEXEL, (0.0, 0.0, 1.0))
    toy = ToyScene([entry(sheet(TEXEL * columns, TEXEL * rows), material)], [[(0, (0.0, 0.0, 0.0, *UPRIGHT))]], (view,))
    config = replace(Config(), render=replace(Config().render, table=False, layers=("albedo",)))
    scene = build_scene(toy, device)
    sizes = view_buffer_sizes(1, scene.width, scene.height, toy.instances)
    layers = allocate(LayerBuffers, sizes, device, ("albedo",))
    zero = wp.zeros(1, dtype=wp.int32, device=device)
    make_renderer(config, scene, toy.instances, 1).render(
        snapshot(toy, device), make_views(zero, zero, 1, toy.instances), allocate(ViewBuffers, sizes, device), layers
    )
    return layers.albedo.numpy()[0]


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (13, 5)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_textures_of_any_size_and_depth_are_looked_up_where_they_are(tmp_path, device, size, dtype):
    """At the centre of a texel filtering gives that texel, to a grey level."""
    largest = np.iinfo(dtype).max
    pixels = np.random.default_rng(1).integers(0, largest + 1, (*size, 3)).astype(dtype)
    assert cv2.imwrite(str(tmp_path / "t.png"), pixels)
    seen = albedo(Material((1.0, 1.0, 1.0), decode_texture((tmp_path / "t.png").read_bytes(), "t.png"), 0.0, 0.5), *size, device)
    middle = seen[PIXELS // 2 :: PIXELS, PIXELS // 2 :: PIXELS]
    assert middle.shape == pixels.shape
    assert np.abs(middle - pixels[..., ::-1] / largest * 255.0).max() <= 2.0


def test_a_mesh_without_texture_coordinates_shows_its_base_colour(device):
    color = (0.2, 0.4, 0.6)
    material = Material(color, None, 0.0, 0.5)
    assert np.abs(albedo(material, 3, 3, device) - 255.0 * np.array(color)).max() <= 1.0


def radiance(value: float = 0.5) -> np.ndarray:
    image = np.full((8, 16, 3), 0.5, np.float32)
    image[3, 5, 1] = value
    return image


def float_picture(file: Path, value: float) -> None:
    """A picture of floats whose name says that it is a radiance map: unlike those, it can hold any number."""
    file.write_bytes(cv2.imencode(".tiff", radiance(value))[1].tobytes())


def truncated(file: Path) -> None:
    data = cv2.imencode(".hdr", np.random.default_rng(0).random((32, 64, 3)).astype(np.float32))[1].tobytes()
    file.write_bytes(data[: len(data) // 2])


def box_models(folder: Path) -> Path:
    folder.mkdir()
    (folder / "box.obj").write_bytes(trimesh.creation.box((0.08, 0.06, 0.05)).export(file_type="obj").encode())
    return folder


def test_a_picture_does_not_depend_on_the_unit_of_its_light_map(device):
    """Up to the largest radiance that is allowed: exposure is automatic, and nothing overflows."""
    dim = sun((0.3, 0.2, 1.0))
    pictures = []
    for gain in (1.0, 0.99 * MAX_RADIANCE / dim.radiance.max()):
        light = replace(dim, radiance=(dim.radiance * np.float32(gain)))
        view = camera(24, 24, 60.0, (0.0, 0.0, 1.0))
        body = entry(sheet(0.2, 0.2), Material((0.6, 0.5, 0.4), None, 0.0, 0.5))
        toy = ToyScene([body], [[(0, (0.0, 0.0, 0.0, *UPRIGHT))]], (view,), lights=(light,))
        pictures.append(render(toy, device).color.astype(int))
    assert pictures[0].mean() > 50
    assert np.abs(pictures[0] - pictures[1]).max() <= 2


@pytest.mark.parametrize(
    ("write", "said"),
    [
        (lambda folder: truncated(folder / "a.hdr"), "{folder}/a.hdr cannot be read as an image: it is empty, cut short or of another "),
        (lambda folder: (folder / "a.hdr").write_text("no picture"), "{folder}/a.hdr cannot be read as an image"),
        (
            lambda folder: (folder / "room.ibl").write_text(IBL),
            "{folder}/room.ibl names REFfile = room.hdr, but there is no such file beside it; ",
        ),
        (lambda folder: float_picture(folder / "a.hdr", np.nan), "{folder}/a.hdr has radiance that is infinite or not a number"),
        (lambda folder: float_picture(folder / "a.hdr", np.inf), "{folder}/a.hdr has radiance that is infinite or not a number"),
        (lambda folder: float_picture(folder / "a.hdr", -1.0), "{folder}/a.hdr has negative radiance (-1); replace the map"),
        (lambda folder: float_picture(folder / "a.hdr", 8e37), "{folder}/a.hdr has radiance 8e+37; allowed: up to 1e+11; "),
        (lambda folder: os.mkfifo(folder / "a.hdr"), "{folder}/a.hdr is not a regular file"),
        (lambda folder: None, "lights folder {folder} contains no environment map; "),
    ],
    ids=["truncated", "text", "set without map", "nan", "inf", "negative", "overflow", "fifo", "empty folder"],
)
def test_lights_that_cannot_be_used_are_one_line(tmp_path, write, said):
    models, folder, out = box_models(tmp_path / "models"), tmp_path / "lights", tmp_path / "deep" / "data"
    folder.mkdir()
    write(folder)
    heard = mistake(*BAKE, "--models", models, "--lights", folder, "--out", out)
    assert heard.startswith(said.format(folder=folder))
    assert not out.parent.exists()


def cut_texture(models: Path) -> None:
    models.mkdir(parents=True)
    (models / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nvt 0 0\nvt 1 0\nvt 1 1\nusemtl skin\n"
        "f 1/1 3/2 2/3\nf 1/1 2/2 4/3\nf 1/1 4/2 3/3\nf 2/1 3/2 4/3\n"
    )
    (models / "a.mtl").write_text("newmtl skin\nmap_Kd t.png\n")
    data = cv2.imencode(".png", np.random.default_rng(0).integers(0, 256, (33, 21, 3)).astype(np.uint8))[1].tobytes()
    (models / "t.png").write_bytes(data[: len(data) // 2])


def black_material(models: Path) -> None:
    models.parent.mkdir(parents=True)
    data = glb(models / "a.glb", metallicFactor=0.25).read_bytes()
    (models / "a.glb").write_bytes(data.replace(b'"metallicFactor":0.25', b'"metallicFactor":NaN '))


def outer_texture(models: Path) -> None:
    models.mkdir(parents=True)
    text = trimesh.creation.box((80, 60, 50)).export(file_type="ply", encoding="ascii").decode()
    (models / "obj_000001.ply").write_text(text.replace("element vertex", "comment TextureFile ../../evil.png\nelement vertex", 1))
    Image.new("RGB", (2, 2)).save(models.parents[1] / "evil.png")


@pytest.mark.parametrize(
    ("write", "said"),
    [
        (cut_texture, r"{models}/t\.png: not readable as an image \("),
        (black_material, r"{models}/a\.glb: its JSON chunk is damaged: .*malformed"),
        (
            outer_texture,
            r'{models}/obj_000001\.ply names the file "\.\./\.\./evil\.png"; allowed: a relative name without \.\. inside {models}$',
        ),
    ],
)
def test_models_whose_appearance_cannot_be_used_are_one_line(tmp_path, write, said):
    models, out = tmp_path / "a" / "b" / "models", tmp_path / "deep" / "data"
    write(models)
    heard = mistake(*BAKE, "--models", models, "--out", out)
    assert re.match(said.format(models=models), heard)
    assert not out.parent.exists()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"randomize.bin_textures": "missing"}, "missing cannot be read"),
        ({"randomize.table_textures": "empty"}, "empty has 0 images"),
        (
            {"randomize.background_textures": "damaged", "render.table_size": [1, 1]},
            "randomize.background_textures: none of the 2 images of",
        ),
        ({"randomize.table_textures": "half", "objects.strict": True}, "half/b.jpg"),
        ({"randomize.background_textures": "half"}, "render.table_size"),
        ({"randomize.distractors": 1, "randomize.distractor_models": "wide"}, "too large for the tote"),
        (
            {"randomize.distractors": 1, "bake.models": "wide", "randomize.distractor_models": "empty/../wide"},
            "another folder than bake.models",
        ),
    ],
)
def test_what_cannot_be_randomized_is_one_line_before_anything_is_baked(tmp_path, given, said):
    for name in ("empty", "damaged", "half", "wide"):
        (tmp_path / name).mkdir()
    (tmp_path / "damaged" / "a.png").write_bytes(b"no picture")
    (tmp_path / "damaged" / "b.webp").write_bytes(b"")
    cv2.imwrite(str(tmp_path / "half" / "a.png"), np.zeros((4, 4, 3), np.uint8))
    (tmp_path / "half" / "b.jpg").write_bytes((tmp_path / "half" / "a.png").read_bytes()[:40])
    trimesh.creation.box((3, 3, 3)).export(tmp_path / "wide" / "box.stl")
    # As TOML has it: a table's keys are joined by "=".
    given = {key: str(tmp_path / value) if isinstance(value, str) else value for key, value in given.items()}
    values = [key + "=" + json.dumps(value).replace('": ', '" = ') for key, value in given.items()]
    out = tmp_path / "new" / "set"
    line = mistake(*BAKE, "--out", out, *(part for value in values for part in ("--set", value)))
    assert said in line
    assert not out.parent.exists()
