"""Benchmark of a bake's parts: physics, perception, rendering, encoders, the online stream, and of bakes in steady state.

Measurements follow a warm-up and are medians of synchronised repetitions. Physics, perception and rendering use the same worlds, in
mode pick; with `--set bake.mode=move`, piles are stirred instead. Files are written to the
system's temporary folder (TMPDIR) and removed. The part render renders one tick repeatedly; the part pictures renders successive ticks,
with light histories as in a bake. `--compare` measures other simulators and renderers on the same piles.

    python -m tools.bench --device cuda:0 --worlds 512 --models DIR --lights DIR --json bench.json
"""

import argparse
import itertools
import sys
from collections.abc import Callable, Iterator, Mapping

from rich.console import Console

from synpick_warp.cli.commands.doctor import describe_machine
from synpick_warp.cli.options import parse_resolution
from synpick_warp.configs.schema import Config
from synpick_warp.errors import SynpickError
from synpick_warp.stages.sim.physics import with_enough_worlds
from synpick_warp.system.hardware.device import pick_device
from tools import options as command_line
from tools.bench.bakes import measure_steady, measure_trajectories
from tools.bench.online import measure_environment, measure_pictures
from tools.bench.peers import PEERS, check_installed, measure_peers
from tools.bench.run import Bench
from tools.bench.worlds import measure_growth, measure_patches, measure_worlds
from tools.figures import describe_run, write_run

SHARED_PARTS = ("physics", "perception", "render", "encode", "stream")
"""Parts in the same worlds."""
OWN_PARTS: Mapping[str, Callable[[Bench], Iterator[command_line.MeasuredRow]]] = {
    "pictures": measure_pictures,
    "steady": measure_steady,
    "trajectories": measure_trajectories,
    "growth": measure_growth,
    "patches": measure_patches,
    "environment": measure_environment,
}
"""Parts that build worlds of their own, in the order in which they are measured."""
DEFAULT_PARTS = (*SHARED_PARTS, "steady")
PARTS = (*DEFAULT_PARTS, *(name for name in OWN_PARTS if name != "steady"))
OWNERS = (("devices", "steady", "several"), ("after", "pictures", "it"), ("instances", "growth", "it"))
"""Options that only one part uses: option, part, and what of."""
WORLDS = 512
"""Default number of worlds."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code. Rows measured before an interruption are written."""
    options = _parse(arguments)
    console = Console(highlight=False)
    rows: list[command_line.MeasuredRow] = []
    machine: dict[str, str] = {}
    code = 0
    try:
        config = _config(options)
        check_installed(options.compare)
        device = pick_device(config.bake.device)
        config = with_enough_worlds(config, device)
        width, height = config.cameras.resolution
        setup = f"{config.bake.worlds} worlds, {len(config.cameras.positions)} cameras, {width}x{height}"
        machine = dict([*describe_machine(device), ("measured", setup)])
        for name, value in machine.items():
            console.print(f"{name:20} {value}")
        given = {name: getattr(options, name) for name in ("seconds", "devices", "after", "instances")}
        bench = Bench(config, **given)
        for row in measure(bench, options.parts, options.compare):
            rows.append(row)
            console.print(f"{row.part:11} {row.name:52} {row.value:14,.3f} {row.unit}", soft_wrap=True)
    except SynpickError as error:
        return command_line.fail("bench", error)
    except KeyboardInterrupt:
        print("bench: interrupted", file=sys.stderr)
        code = command_line.INTERRUPTED
    if rows:
        write_run(options.json, describe_run("tools.bench", machine.items(), rows))
    return code


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = command_line.make_parser(__doc__, "config", "device", "models", "lights", "set", "json")
    worlds_help = f"worlds simulated in parallel (default: {WORLDS})"
    parser.add_argument("--worlds", type=command_line.positive_count, default=WORLDS, help=worlds_help)
    parser.add_argument("--resolution", default="1920x1080", help="WIDTHxHEIGHT [px] (default: 1920x1080)")
    more = ",".join(PARTS[len(DEFAULT_PARTS) :])
    parts_help = f"parts to measure, comma-separated (default: {','.join(DEFAULT_PARTS)}; and {more})"
    parser.add_argument("--parts", type=command_line.make_names_parser(PARTS, "part"), help=parts_help)
    peers_help = f"peers to measure beside ours, comma-separated, of {', '.join(PEERS)}; then no parts unless --parts names some"
    parser.add_argument("--compare", type=command_line.make_names_parser(PEERS, "peer"), default=(), metavar="PEERS", help=peers_help)
    after_help = "ticks simulated before the part pictures, in which little moves just after the drop (default: 0)"
    parser.add_argument("--after", type=command_line.positive_count, default=0, metavar="TICKS", help=after_help)
    devices_help = "several devices of the part steady, as of bake: cuda:0,cuda:1 or all; --worlds is the number of each"
    parser.add_argument("--devices", default="", help=devices_help)
    instances_help = "numbers of like parts, of which the part growth measures physics alone: 10,32,64,128,251"
    parser.add_argument("--instances", type=command_line.counts, default=(), metavar="NUMBERS", help=instances_help)
    parser.add_argument("--seconds", type=command_line.finite_amount, default=2.0, help="minimum time of a measurement [s] (default: 2)")
    options = parser.parse_args(arguments)
    if options.parts is None:
        options.parts = () if options.compare else DEFAULT_PARTS
    options.devices = tuple(name.strip() for name in options.devices.split(",")) if options.devices else ()
    for name, part, use in OWNERS:
        if getattr(options, name) and part not in options.parts:
            parser.error(f"--{name} needs the part {part}, the only one that uses {use}")
    if options.devices and options.device != parser.get_default("device"):
        parser.error("--device and --devices are both given; name one device by --device, or several by --devices")
    return options


def _config(options: argparse.Namespace) -> Config:
    worlds, resolution = options.worlds, parse_resolution(options.resolution)
    return command_line.configure(options, {"bake.worlds": worlds, "bake.episodes": worlds, "cameras.resolution": resolution})


def measure(bench: Bench, parts: tuple[str, ...], peers: tuple[str, ...] = ()) -> Iterator[command_line.MeasuredRow]:
    """Measure the parts, which may be in any order, then the peers; rows come as they are measured."""
    runs: list[Iterator[command_line.MeasuredRow]] = [measure_worlds(bench, parts)] if set(parts) & set(SHARED_PARTS) else []
    runs += [command_line.of_part(part, make(bench)) for part, make in OWN_PARTS.items() if part in parts]
    runs += [measure_peers(bench, peers)] if peers else []
    return itertools.chain.from_iterable(runs)


if __name__ == "__main__":
    sys.exit(main())
