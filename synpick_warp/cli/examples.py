"""Example command lines of each command, which `--help` prints below the options. Apart from `main`, which registers the commands."""

from __future__ import annotations

EXAMPLES = {
    "bake": (
        "bake --config smoke --episodes 1 --out DATA",
        "bake --worlds 512 --mode mixed --models YCB --lights HDRI",
        "bake --config cell/cell.toml --formats bop,zarr --set 'render.layers=[normals]'",
        "bake --worlds 512 --dry-run",
        "bake --devices all --out DATA",
    ),
    "merge": ("merge PART0 PART1 --out DATA",),
    "doctor": ("doctor", "doctor --config cell/cell.toml --memory"),
    "warmup": ("warmup --mode mixed --models YCB",),
    "config": ("config --presets", "config --config smoke", "config --config smoke --set move.force=12"),
    "new-cell": (
        "new-cell cell --calibration left.yaml --bin 600x400x220mm --part bracket.stl --unit mm",
        "new-cell cell --bin bin.stl --bin-unit mm",
    ),
    "preview": ("preview DATA --out sheet.png", "preview --cell cell/cell.toml --out cell.png"),
    "explain": ("explain DATA --episode 3", "explain DATA --state 0"),
    "eval": ("eval DATA --results results.csv",),
    "estimate": ("estimate DATA --method refine --out results.csv",),
    "convert": ("convert DATA --to usd,coco --out MORE",),
    "stats": ("stats DATA", "stats DATA --paper"),
    "validate": ("validate DATA", "validate REAL --tolerance 5,2"),
    "verify": ("verify DATA",),
    "report": ("report DATA",),
}
"""By name of the command, without the program's name."""
