"""Real clients: other people's readers open a small data set of ours, and what they have read is compared with what we have in memory.

Each client runs in a process of its own, in our interpreter or in the one that `--python NAME=PATH` names (more than once to try several
versions). Prints a table; a client that is not installed, or whose format the data set lacks, is listed as such. Exits with 1 if a client
disagrees or fails, with 2 if the data set cannot be opened. Nothing is fetched.

    python -m tools.clients DATA --python blender=BPY/bin/python --bop-toolkit DIR
"""

import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import synpick_warp
from synpick_warp.errors import SynpickError
from tools.clients.base import PICTURE, PSNR, Client, Result, Values, finish, interpreters, run_module
from tools.clients.reader import CLIENTS
from tools.options import fail, make_names_parser, make_parser

EQUAL, NO_FORMAT = "equal", "not in this data set"


def run_client(name: str, python: str, data: Path, data_set: Any, toolkit: str) -> Result:
    """Let one client read in its interpreter, and compare with the expected values; returns its row."""
    client = CLIENTS[name]
    place = client.find(data)
    if place is None:
        return Result(name, agreement=NO_FORMAT)
    with tempfile.TemporaryDirectory() as folder:
        result, _ = run_module(name, python, "tools.clients.reader", str(place), str(data), folder, toolkit)
        if result.agreement:
            return replace(result, read=place.name)
        report = json.loads((Path(folder) / "report.json").read_text())
        with np.load(Path(folder) / "values.npz") as values:
            agreement, holds = compare(client, dict(values), client.expect(data_set))
    version = ", ".join(f"{package} {number}".strip() for package, number in report["versions"].items() if number)
    return Result(name, version, report["what"], agreement, "; ".join(report["remarks"]), holds)


def compare(client: Client, read: Values, expected: Values) -> tuple[str, bool]:
    """Compare what was read with what was expected, as text and verdict; only names that both have."""
    common = sorted(read.keys() & expected.keys())
    if not common:
        return "NOTHING TO COMPARE", False
    wrong, ratios, largest = [], [], 0.0
    for name in common:
        if name.startswith(PICTURE):
            ratios.append(psnr(client.tone_map(read[name]), expected[name]))
            wrong += [name] if ratios[-1] < PSNR else []
            continue
        error = difference(read[name], expected[name])
        largest = max(largest, error)
        if not error <= client.bounds.get(name.partition(" ")[0], 0.0):
            wrong.append(f"{name} by {error:.3g}")
    texts = [f"{len(common) - len(ratios)} values " + (EQUAL if largest == 0.0 else f"within {largest:.1g}")]
    texts += [f"picture {min(ratios):.1f} dB"] if ratios else []
    return (f"DIFFERS: {', '.join(wrong[:3])}", False) if wrong else ("; ".join(texts), True)


def difference(first: np.ndarray, second: np.ndarray) -> float:
    """Largest absolute difference; infinite if shapes differ, 0 where both are NaN."""
    if first.shape != second.shape:
        return float("inf")
    numbers = [np.asarray(array, np.float64) for array in (first, second)]
    both = np.isnan(numbers[0]) & np.isnan(numbers[1])
    return float(np.where(both, 0.0, np.nan_to_num(np.abs(numbers[0] - numbers[1]), nan=np.inf)).max(initial=0.0))


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    """Peak signal-to-noise ratio of pictures from 0 to 1 [dB]; minus infinity if their sizes differ."""
    if first.shape != second.shape:
        return float("-inf")
    return float(-10.0 * np.log10(max(np.mean((first - second) ** 2), 1e-12)))


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser, names = make_parser(__doc__, "json"), tuple(CLIENTS)
    formats = "folder of the data set; all formats: --formats bop,shards,usd,zarr,lerobot,coco,yolo"
    parser.add_argument("data", type=Path, metavar="DATA", help=formats)
    parser.add_argument("--clients", type=make_names_parser(names, "client"), default=names, help=f"of {','.join(names)} (default: all)")
    parser.add_argument("--python", action="append", default=[], metavar="NAME=PATH", help="interpreter of a client; may be repeated")
    parser.add_argument("--bop-toolkit", default="", metavar="DIR", help="folder of a copy of the BOP toolkit")
    given = parser.parse_args(arguments)
    try:
        chosen = list(interpreters(given.clients, names, given.python))
        data_set = synpick_warp.open(given.data)
        if not data_set:
            raise SynpickError(f"{given.data} has no episode")
    except (SynpickError, ValueError) as error:
        return fail("clients", str(error))
    toolkit = str(Path(given.bop_toolkit).resolve()) if given.bop_toolkit else ""
    results = [run_client(name, python, given.data.resolve(), data_set, toolkit) for name, python in chosen]
    return finish("tools.clients", given.json, results)


if __name__ == "__main__":
    sys.exit(main())
