"""Randomized appearance of a cell: its distributions, and textures from folders and procedural ones."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from synpick_warp.codes import LookPart
from synpick_warp.configs.episodes.randomize import Randomize
from synpick_warp.configs.fields import PATH_RULE
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import MAX_TEXTURE_FILE, decode_texture
from synpick_warp.scenes.assets.asset_files import check_file_name, read_isolated
from synpick_warp.scenes.embedded.textures import surface_textures
from synpick_warp.system.inputs.files import read_file
from synpick_warp.system.processes.isolation import Limits

LIMITS = Limits(60.0, 2**31)
"""Limits of the process that decodes a texture: 1 min and 2 GiB."""
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
MAX_TEXTURES = 256
"""Maximum number of textures of a folder, as many as a distribution has choices."""
MAX_SIDE = 1024
"""Larger textures are downsampled to this many texels along their longer side [px]: 256 of them then take 1.4 GB with mip levels."""

Textures = tuple[np.ndarray, ...]
"""Base colour textures (H, W, 3) uint8, sRGB, top row first, sorted by their file names."""


@dataclass(frozen=True, eq=False)
class Looks:
    """Randomized appearance: the distributions, and the loaded textures of bin, table and background; empty: none."""

    randomize: Randomize
    bin_textures: Textures
    table_textures: Textures
    background_textures: Textures = ()

    @property
    def textures(self) -> dict[LookPart, Textures]:
        """Textures by the part that draws one of them, in the order of their materials."""
        parts = (LookPart.BIN, self.bin_textures), (LookPart.TABLE, self.table_textures), (LookPart.BACKGROUND, self.background_textures)
        return dict(parts)

    @property
    def all_textures(self) -> Textures:
        """Textures of all parts in the order of their materials."""
        return self.bin_textures + self.table_textures + self.background_textures


def load_looks(randomize: Randomize, report: Callable[[str], None], strict: bool = False) -> Looks | None:
    """Load the textures that settings name, and make the procedural ones; None: nothing is randomized.

    Arguments and errors as of `load_textures`.
    """
    if randomize == Randomize():
        return None
    names = ("bin_textures", "table_textures", "background_textures")
    bins, table, floor = (load_textures(f"randomize.{name}", getattr(randomize, name), report, strict) for name in names)
    surfaces = surface_textures(randomize.surfaces)
    return Looks(randomize, bins, table + surfaces, floor + surfaces)


def load_textures(key: str, folder: str, report: Callable[[str], None], strict: bool = False) -> Textures:
    """Load the images of a folder, in isolated processes; empty: none. Those that cannot be used are left out with a line each. `key`: the
    setting that names the folder. `strict`: whether the first image that cannot be used is an error. Raises CatalogError: the folder does
    not exist, or has no image that can be used, or too many, or time or memory of this machine does not suffice for one."""
    if not folder:
        return ()
    try:
        files = sorted(path for path in Path(folder).iterdir() if path.suffix.lower() in SUFFIXES)
    except OSError as error:
        raise CatalogError(f"{key}: the folder {folder} cannot be read: {error.strerror}; {PATH_RULE}") from error
    if not 0 < len(files) <= MAX_TEXTURES:
        raise CatalogError(f"{key}: the folder {folder} has {len(files)} images ({', '.join(SUFFIXES)}); allowed: 1 to {MAX_TEXTURES}")
    textures, faults = [], []
    smaller = "scale the image down, or remove it"
    for result in read_isolated(_read, [(path,) for path in files], LIMITS, CatalogError, smaller, "replace it"):
        (faults if isinstance(result, CatalogError) else textures).append(result)
        if faults and strict:
            raise faults[0]
    if not textures:
        raise CatalogError(f"{key}: none of the {len(files)} images of {folder} can be used; the first: {faults[0]}")
    for fault in faults:
        report(f"left out: {fault}")
    return tuple(textures)


def _read(path: Path) -> np.ndarray:
    """Decode an image, with at most MAX_SIDE texels along its longer side."""
    check_file_name(path, CatalogError)
    image = decode_texture(read_file(path, MAX_TEXTURE_FILE, CatalogError), str(path))
    scale = MAX_SIDE / max(image.shape[:2])
    if scale >= 1.0:
        return image
    height, width = (max(1, round(scale * side)) for side in image.shape[:2])
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
