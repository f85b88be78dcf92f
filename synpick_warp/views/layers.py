"""Annotation layers (AOVs, "annotators"): one table of the per-pixel ground truth beside colour, depth and masks.

The choices of `render.layers`, the device buffers, the PNG codec and the notes in a data set derive from this table. Layers of other
packages are rows as well (`system/plugins.py`): of these, `kernel` is the kernel, as "module:name". Imports little.
To add a layer:

1. add a row to `LAYER_TABLE`, and an encoding to `layer_codec.CODECS` if none fits: "raw" is for integers, which files hold as they are;
   files of all others are RGB with 16 bits. A constant that kernel and encoding share stands in `codes.py`;
2. write its value at a pixel in `kernels/render/images/layers.py`, and name its kernel in `KERNELS` (`stages/render/layers.py`);
3. state the tolerance between CPU and GPU in `tools/compare/pictures.py`, and a sample value in `tests/dataset/test_layers.py`;
   tests fail until both are there. Known answers belong in `tests/render/images/test_layers.py`, a row in the table of
   `exporters/README.md`; the former bakes it by itself. A drawing in `apps/viz/drawing.py` is optional.
"""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields

from synpick_warp.errors import ConfigError
from synpick_warp.system.plugins import load_plugin, plugin_names

ZERO_CODE = 32768
"""Code of 0 in a signed layer."""
MAX_CODE = 65535
"""Largest code: PNG images have 16 bits a channel."""
NORMAL_STEPS = 32767
"""Steps from 0 to 1 of a normal's component."""
FLOW_STEPS = 64
"""Steps per pixel of optical flow, as in KITTI's flow images; they reach 512 px."""
SCENE_FLOW_STEP = 2e-5
"""One step of scene flow [m]; 16 bits reach 0.655 m, in a tick of 1/15 s a speed of 9.8 m/s."""


@dataclass(frozen=True)
class Layer:
    """Annotation layer (AOV)."""

    dtype: str
    """Type of the values, in device buffers, in `FrameBatch.layers` and as decoded: a NumPy name."""
    values: str
    """Meaning of the values, and of the value that stands for none."""
    encoding: str
    """Key of `layer_codec.CODECS`."""
    note: str
    """Meaning of the file's codes, for the notes of a data set."""
    components: int = 1
    """Components of a pixel's value (C): the values have shape (H, W, C), or (H, W) if 1."""
    unit: str = ""
    kernel: str = ""
    """Kernel of a layer of another package, as "module:name", made by `kernel_of_layer` (`kernels/render/images/layers.py`)."""


_OWN = {
    "normals": Layer(
        dtype="float32",
        components=3,
        values="Unit shading normal in the camera's axes, towards the camera; zero: no surface.",
        encoding="unit_vector",
        note=f"unit normals towards the camera, in its axes; red, green and blue are {ZERO_CODE} + {NORMAL_STEPS} times x, y and z; "
        "0, 0, 0: no surface. They are interpolated between vertices, as those of the picture.",
    ),
    "albedo": Layer(
        dtype="uint8",
        components=3,
        values="Base colour, sRGB, red first; zero: no surface.",
        encoding="raw",
        note="base colour without light, sRGB; black where no surface is.",
    ),
    "nocs": Layer(
        dtype="float32",
        components=3,
        values="Normalized object coordinates: (p - centre of the bounding box) / its diagonal + 0.5, in the model's axes; "
        "zero: no instance.",
        encoding="fraction",
        note=f"where on its object the pixel lies: {MAX_CODE} times ((p - c) / d + 0.5), with p in the model's axes, c = min + size / 2 "
        "and d = |size| from models_info.json; so p = c + d (value - 0.5). 0, 0, 0: no instance.",
    ),
    "classes": Layer(
        dtype="uint16",
        values="Class id: obj_id of the visible instance; 0: no instance.",
        encoding="raw",
        note="obj_id; 0: no instance.",
    ),
    "flow": Layer(
        dtype="float32",
        components=2,
        unit="px",
        values="Backward optical flow: from the pixel to its surface point's position in the previous frame, columns and rows; "
        "NaN: unknown.",
        encoding="flow",
        note="optical flow to the image before this one, in KITTI's format: the pixel's surface point was then (red - "
        f"{ZERO_CODE}) / {FLOW_STEPS} columns to the right and (green - {ZERO_CODE}) / {FLOW_STEPS} rows down, hidden or not. Blue 0: "
        f"unknown: no surface, the scene's first image, what was not in the scene then, or {ZERO_CODE // FLOW_STEPS} pixels and more.",
    ),
    "scene_flow": Layer(
        dtype="float32",
        components=3,
        unit="m",
        values="Backward scene flow: from the pixel's surface point to its position in the previous frame, in the camera's axes; "
        "NaN: unknown.",
        encoding="displacement",
        note=f"the same as displacement in the camera's axes: red, green and blue minus {ZERO_CODE}, times {1e3 * SCENE_FLOW_STEP:g} mm; "
        f"0, 0, 0: unknown, or {ZERO_CODE * SCENE_FLOW_STEP:.3f} m and more.",
    ),
    "depth_sensor": Layer(
        dtype="uint16",
        unit="depth_scale",
        values="Planar depth as a structured-light depth sensor measures it, in counts of the depth scale; 0: hole.",
        encoding="raw",
        note="what a depth camera might measure (`depth_sensor` in config.toml): noise, steps and holes, which are 0; "
        "counts as in `depth/`.",
    ),
    "ir_left": Layer(
        dtype="uint8",
        values="Infrared image of the left camera of a stereo pair, which is the view's own; linear.",
        encoding="raw",
        note="infrared image at this camera, the left one of a rectified stereo pair (`depth_sensor` in config.toml); linear.",
    ),
    "ir_right": Layer(
        dtype="uint8",
        values="Infrared image of the right camera, with the same intrinsics and rotation; linear.",
        encoding="raw",
        note="infrared image at the right camera: this one, moved by `depth_sensor.baseline` along its x axis; linear.",
    ),
    "depth_stereo": Layer(
        dtype="uint16",
        unit="depth_scale",
        values="Planar depth by stereo matching of the infrared pair, in counts of the depth scale; 0: hole.",
        encoding="raw",
        note="depth matched from `ir_left` and `ir_right`, whether these are stored or not: holes, which are 0, where nothing matches; "
        "counts as in `depth/`.",
    ),
    "suction_seal": Layer(
        dtype="float32",
        values="Seal score of a suction cup set on the pixel along its normal, 0 to 1; 0: no seal, something in the way, or no instance.",
        encoding="fraction",
        note=f"analytic seal score of a cup of `suction.radius` on the pixel, {MAX_CODE} times, as SuctionNet-1Billion defines it: how "
        "little the surface below the cup's rim deforms it; 0 where the rim meets no surface, or something stands in the cup's way.",
    ),
    "suction_wrench": Layer(
        dtype="float32",
        values="Wrench score of a suction cup set on the pixel along its normal, 0 to 1; 0: too long a lever, or no instance.",
        encoding="fraction",
        note=f"analytic wrench score of the same cup, {MAX_CODE} times: 1 if the object's centre of mass hangs on its axis, 0 where 1 kg "
        "at that centre would bend the cup off. The product of both is SuctionNet's score.",
    ),
}


class LayerTable(Mapping[str, Layer]):
    """Layers by name, in the order of files, buffers and notes: ours, then those of other packages, each loaded when it is first used."""

    def __init__(self) -> None:
        self._names = (*_OWN, *plugin_names("layers", tuple(_OWN)))

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __getitem__(self, name: str) -> Layer:
        """Raises a ConfigError if the package of a layer is broken."""
        if name in _OWN:
            return _OWN[name]
        if name not in self._names:
            raise KeyError(name)
        members = [field.name for field in fields(Layer)]
        plugin = load_plugin("layers", name, *members)
        return Layer(*(getattr(plugin, member) for member in members))

    def loadable(self) -> Iterator[tuple[str, Layer]]:
        """Name and row of all layers but those of packages that are broken: bakes without these must not suffer."""
        for name in self:
            with suppress(ConfigError):
                yield name, self[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


LAYER_TABLE = LayerTable()
