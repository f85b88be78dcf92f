"""Compile the modules of Newton's narrow phase that outlast all others, for common GPUs, and write the archive that is shipped.

    python -m tools.narrow_phase  # in some minutes, without a GPU

Run it when Warp or Newton has another version, or the package's archive lacks a module for another reason.
"""

import os
import tempfile
from pathlib import Path
from types import SimpleNamespace
from zipfile import ZIP_LZMA, ZipFile, ZipInfo

import warp as wp

from synpick_warp.newton_patches.narrow_phase import SHIPPED, slow_builds
from synpick_warp.system.hardware.device import start_warp
from synpick_warp.system.hardware.kernels import ModuleBuild
from tools.options import make_parser

ARCHITECTURES = (80, 86, 89, 90, 100, 120)
"""Compute capabilities times ten: A100, RTX 30, L40 and RTX 40, H100 and H200, B200, RTX 50."""


def main() -> None:
    """Compile, and write the archive."""
    make_parser(__doc__).parse_args()
    start_warp()
    with tempfile.TemporaryDirectory() as folder, ZipFile(SHIPPED, "w", ZIP_LZMA) as archive:
        for build in shipped_builds():
            options = build.module.resolve_options(wp.config, block_dim=build.block)
            for architecture in ARCHITECTURES:
                names = build.names(architecture)
                build.module._compile(None, Path(folder, names[0]), output_arch=architecture, use_ptx=False, options=options)
                for name in set(names) - set(map(os.path.basename, archive.namelist())):
                    archive.writestr(ZipInfo(f"{build.shipped_key()}/{name}"), Path(folder, names[0], name).read_bytes(), ZIP_LZMA)


def shipped_builds() -> list[ModuleBuild]:
    """Modules that are shipped, those of no device: the next one takes 4 s, these 24 and 8 s (H100, 16 cores)."""
    return slow_builds(SimpleNamespace(alias="", is_cuda=True))[:2]  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
