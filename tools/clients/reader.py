"""Process of one client: reads, and leaves values in an .npz file and a report in JSON. Started by `python -m tools.clients`."""

from __future__ import annotations

import importlib
import json
import sys
from importlib import metadata
from pathlib import Path

import numpy as np

from tools.clients.base import MISSING, Sources


def version_of(package: str) -> str:
    """Version of a distribution, or "" if it is not installed but can be imported from a folder."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def main() -> int:
    """Run one client in this process; arguments: NAME PLACE DATA OUT SOURCES. Returns MISSING if its package is not installed."""
    name, place, data, out, sources = sys.argv[1:]
    try:
        module = importlib.import_module(f"tools.clients.{name}")
        reading = module.read(Path(place), Path(data), Sources(**json.loads(sources)))
    except ImportError as error:
        print(error.name or error, file=sys.stderr)
        return MISSING
    folder = Path(out)
    np.savez(folder / "values.npz", **reading.values)
    versions = {package: version_of(package) for package in module.PACKAGES} | reading.versions
    (folder / "report.json").write_text(json.dumps({"what": reading.what, "remarks": reading.remarks, "versions": versions}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
