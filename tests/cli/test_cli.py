"""The command line: options, exit codes, one line for a mistake, nothing left behind."""

import contextlib
import json
import os
import pickle
import shlex
import subprocess
import sys
import tomllib
import types

import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp import __version__
from synpick_warp.cli.commands import doctor
from synpick_warp.cli.main import app, main
from synpick_warp.cli.options import EXAMPLES, MAX_LINE, one_line, parse_resolution, parse_shard
from synpick_warp.codes import Ending
from synpick_warp.configs.dataset import DataLayout
from synpick_warp.configs.files.load import load_config, preset_names
from synpick_warp.errors import ConfigError, DatasetError, DeviceError, OutputError, SynpickError
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.factory.episodes import BakeSummary, EpisodeOutcome
from synpick_warp.factory.memory_plan import Term
from synpick_warp.stages import timing
from tests.builders import mistake
from tests.harness.hostile import fuzz_examples
from tests.system.test_processes import refuse  # Writer processes import its module, which imports little.


def finished(number: int) -> BakeSummary:
    rows = [EpisodeOutcome(episode, 0, Ending.FINISHED, 10, 1.0, "move", 9, 0, 0, 0, 9) for episode in range(number)]
    return BakeSummary(number, rows, views=30 * number, wall_seconds=2.0, resampled=1)


@pytest.fixture
def bakes(monkeypatch):
    """Stand-in for pipeline.py; collects the arguments of each call. `result` may be set to a summary or an error."""
    module = types.ModuleType("synpick_warp.factory.pipeline")
    calls = []

    def run_bake(config, out, progress, shard, splits, devices):
        module.devices = devices
        calls.append((config, out, shard, splits))
        progress.stage("building worlds")
        progress.update(episodes_done=0, episodes=2, worlds_active=2, views=0, views_per_s=0.0, seconds_left=None)
        progress.note("a note")
        if isinstance(module.result, BaseException):
            raise module.result
        return module.result

    module.result = finished(4)
    module.calls = calls
    module.run_bake = run_bake
    monkeypatch.setitem(sys.modules, "synpick_warp.factory.pipeline", module)
    return module


def test_bake_passes_resolved_settings_on(tmp_path, bakes, capsys):
    out = tmp_path / "new" / "data"
    given = {"config": "smoke", "worlds": 3, "episodes": 4, "seed": 7, "device": "cpu", "resolution": "64x48", "writers": 1, "mode": "move"}
    arguments = [f"--{name}={value}" for name, value in given.items()]
    assert main(["bake", "--out", str(out), *arguments, "--set", "move.speed=0.2", "--set", "bake.seed=1"]) == 0
    [(config, folder, shard, splits)] = bakes.calls
    assert (folder, shard, splits) == (out, (0, 1), ())
    expected = {"bake.worlds": 3, "bake.episodes": 4, "bake.seed": 7, "bake.device": "cpu", "bake.writers": 1}
    assert config == load_config("smoke", expected | {"cameras.resolution": [64, 48], "move.speed": 0.2})
    printed = capsys.readouterr().out
    assert "building worlds\n" in printed
    assert "episodes 0/2 · worlds 2 · views 0" in printed
    assert "4 of 4 episodes and 120 views in 0:02 (60.0 views/s); arrangements resampled: 1" in printed


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--devices", "cpu, cpu", "--worlds", "auto", "--writers", "auto"], {"worlds": 0, "writers": 0, "devices": ("cpu", "cpu")}),
        (["--device=cpu", "--formats=zarr, bop", "--shard=1/3"], {"formats": ("zarr", "bop"), "shard": (1, 3)}),
        (["--device=cpu", "--split=train, test", "--shard=1/300"], {"shard": (1, 300), "splits": ("train", "test"), "episodes": 300}),
    ],
)
def test_lists_shares_and_automatic_sizes_are_passed_on(tmp_path, bakes, options, expected):
    assert main(["bake", f"--out={tmp_path}", *options]) == 0
    [(config, _, shard, splits)] = bakes.calls
    passed = vars(config.bake) | {"shard": shard, "splits": splits, "devices": bakes.devices}
    assert {name: passed[name] for name in expected} == expected


def test_bake_says_so_by_exit_code_if_episodes_are_missing(tmp_path, bakes, capsys):
    bakes.result = finished(2)
    bakes.result.episodes[1] = bakes.result.episodes[1]._replace(arrangement=19, ending=Ending.UNSETTLED, frames=0)
    assert main(["bake", "--out", str(tmp_path / "a"), "--device", "cpu", "--episodes", "2"]) == 1
    assert "did not come to rest" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--worlds=-1"], "bake.worlds is -1 on the command line; allowed: at least 0, at most 65536"),
        (["--shard=3"], '--shard is "3"; allowed: i/n with i from 0 to n - 1, such as 0/4'),
        (["--shard=4/4"], "--shard is 4/4; allowed: i/n with i from 0 to n - 1, such as 0/4"),
        (["--shard=4/8"], "--shard 4/8 has none of 4 episodes; use fewer shards"),
        (["--resolution", "640"], '--resolution is "640"; allowed: WIDTHxHEIGHT in pixels, such as 640x360'),
        (["--device", "tpu"], 'bake.device is "tpu"; allowed: cpu, cuda:N such as cuda:0, or auto'),
        (["--models", "no-such"], "there is no models folder no-such; --models takes a folder of BOP models or of PLY, OBJ, glTF"),
        (["--lights", "no-such"], "there is no lights folder no-such; --lights takes a folder of .hdr maps and sIBL sets"),
        (["--wrlds", "3"], "Unknown option: --wrlds. Did you mean --worlds?"),
        (["extra"], '"extra" is neither an option nor the value of one; see synpick-warp bake --help'),
        (["--shard", "-1/4"], "--shard has no value; if -1/4 is one, write --shard=-1/4"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(tmp_path, bakes, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    device = [] if "--device" in arguments else ["--device", "cpu"]
    assert mistake("bake", "--out", "deep/data", *device, *arguments).startswith(said)
    assert not bakes.calls
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(wp.get_cuda_device_count() > 0, reason="this machine has a GPU")
def test_a_gpu_that_is_not_there(tmp_path, bakes):
    said = mistake("bake", "--out", str(tmp_path / "data"), "--device", "cuda:0")
    assert said == "cuda:0 was requested, but Warp finds no CUDA device here; use --device cpu"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arguments", [["bake", "--out"], ["bkae"], ["merge"], ["--frobnicate"]])
def test_incomplete_command_lines(arguments):
    mistake(*arguments)


@pytest.mark.parametrize(
    ("words", "said"), [([], ""), (["set"], ""), (["set", "a.csv"], ', and "a.csv" is neither an option nor the value of one')]
)
def test_a_missing_option_is_named_with_a_word_too_many(words, said):
    assert mistake("eval", *words) == f"eval needs --results{said}; see synpick-warp eval --help"


def test_a_profile_is_a_table_and_a_trace_beside_the_data_set(tmp_path, bakes, capsys, monkeypatch):
    run = bakes.run_bake

    def profiled(*arguments):
        for _ in range(3):
            with timing.scope("simulate"), timing.scope("inner"):
                pass
        return run(*arguments)

    monkeypatch.setattr(bakes, "run_bake", profiled)
    assert main(["bake", "--device=cpu", f"--out={tmp_path / 'set'}", "--profile"]) == 0
    lines = capsys.readouterr().out.splitlines()
    rows = {cells[1].strip(): cells[2:] for line in lines if len(cells := line.split("│")) > 5}
    assert (rows["simulate"][0].strip(), rows["inner"][0].strip()) == ("3", "3")
    assert "other" in rows
    assert lines[-1] == f"trace: {tmp_path / 'set-profile.json'}"
    events = json.loads((tmp_path / "set-profile.json").read_text())["traceEvents"]
    assert [event["name"] for event in events if event["ph"] == "X"] == ["inner", "simulate"] * 3
    assert main(["bake", "--device=cpu", f"--out={tmp_path / 'set'}", f"--profile-out={tmp_path / 'trace.json'}"]) == 0
    assert (tmp_path / "trace.json").is_file()
    assert timing.scope("a") is timing.scope("b")


def test_a_trace_is_never_written_into_the_data_set(tmp_path, bakes):
    out = tmp_path / "set"
    said = mistake("bake", "--device=cpu", f"--out={out}", f"--profile-out={out / 'trace.json'}")
    assert said == f"--profile-out is {out / 'trace.json'}, inside the data set {out}; name a file outside of it"
    said = mistake("bake", "--device=cpu", f"--out={out}", f"--profile-out={tmp_path / 'no' / 'trace.json'}")
    assert said.endswith("allowed: a file in an existing folder")
    assert not bakes.calls


def test_a_stopped_bake_says_how_to_go_on(tmp_path, bakes, capsys):
    for result, said in (
        (finished(4), ": 4 of 4 episodes are complete; the same command completes the data set"),
        (KeyboardInterrupt(), ""),
    ):
        bakes.result = result
        bakes.result.stopped = 2
        assert main(["bake", "--device=cpu", f"--out={tmp_path / 'data'}"]) == 130
        errors = capsys.readouterr().err
        assert errors.endswith(f"synpick-warp: interrupted{said}\n")
        assert said or errors == "synpick-warp: interrupted\n"


@pytest.mark.parametrize(
    ("out", "said"),
    [
        (".", "{here} is not empty; --out takes a new or an empty folder, or a data set to resume"),
        ("file", "{here}/file is a file; --out takes a new or an empty folder"),
        ("file/data", "cannot write {here}/file/data: Not a directory; "),
    ],
)
def test_output_folders_that_cannot_be_used(tmp_path, bakes, out, said):
    (tmp_path / "file").write_text("precious")
    assert mistake("bake", "--device", "cpu", "--out", tmp_path / out).startswith(said.format(here=tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert not bakes.calls


def test_output_folder_that_cannot_be_written(tmp_path, bakes):
    if os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    tmp_path.chmod(0o500)
    assert ": Permission denied; " in mistake("bake", "--device", "cpu", "--out", str(tmp_path / "data"))


def test_a_mistake_found_while_baking_takes_empty_folders_away_again(tmp_path, bakes):
    bakes.result = OutputError("the disk\nis full")
    for out in (tmp_path / "a" / "b", tmp_path):  # An empty folder that was there is kept.
        assert mistake("bake", "--device", "cpu", "--out", out) == "the disk is full"
        assert list(tmp_path.iterdir()) == []


def test_a_fault_of_ours_in_a_writer_process_shows_its_traceback(tmp_path, bakes, capsys):
    with pytest.raises(OutputError) as caught, WriterPool(1, 1) as pool:
        pool.submit(int, (), ("two\nlines",), path=tmp_path)
    bakes.result = pickle.loads(pickle.dumps(caught.value))  # As a process of a device sends it.
    assert main(["bake", "--device", "cpu", "--out", str(tmp_path / "data")]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("Traceback")
    assert lines[-1].startswith(f"synpick-warp: error: cannot write {tmp_path}: ValueError: invalid literal for int()")


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), MemoryError("x"), DatasetError("x is damaged")])
@pytest.mark.parametrize("processes", [0, 1])
def test_other_errors_in_a_writer_process_are_one_line(tmp_path, bakes, error, processes):
    with pytest.raises(SynpickError) as caught, WriterPool(processes, 1) as pool:
        pool.submit(refuse, (), (error,), path=tmp_path)
    bakes.result = caught.value
    mistake("bake", "--device", "cpu", "--out", str(tmp_path / "data"))


def test_help_shows_units_and_defaults(capsys):
    assert main(["bake", "--help"]) == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "default 1920x1080 px; cameras.resolution" in text
    assert "A GPU simulates at least 8. auto is 0. (at least 0, at most 65536; default 0; bake.worlds)" in text
    assert "Weights of mixed: --set bake.mix=[pick, target, move]" in text
    assert "(pick, target, move, mixed, cycle, still; default pick; bake.mode)" in text


def test_config_prints_what_it_would_use(capsys):
    assert main(["config", "--config", "smoke", "--set", "move.force=12"]) == 0
    document = tomllib.loads(capsys.readouterr().out)
    assert document["move"]["force"] == 12.0
    assert document["arrangement"]["volume"] == load_config("smoke", {}).arrangement.volume


@pytest.fixture
def plans(monkeypatch):
    """A memory plan of two arrays."""

    def plan_memory(config, *_):
        rows = [("Snapshot.pose", (config.bake.worlds, 24), "m", 2 * 1024**2), ("Goals.goal", (4,), "", 0)]
        return [Term("poses", tuple(rows), ("bake.worlds",), (config.bake.worlds,), on_device=False)]

    monkeypatch.setattr(doctor, "plan_memory", plan_memory)
    monkeypatch.setattr(doctor, "fit_to_device", lambda config, *_: config)


def test_doctor(capsys, plans, monkeypatch):
    command = ["doctor", "--worlds", "16", "--resolution", "640x360", "--device", "cpu"]
    assert main(command) == 0
    text = capsys.readouterr().out
    assert "Snapshot.pose" not in text
    assert text.splitlines()[-1].startswith("verdict: ready: bakes with these settings run on cpu, ")
    monkeypatch.setattr(doctor, "find_fault", lambda folder: "read-only")
    assert main([*command, "--memory"]) == 0
    text = capsys.readouterr().out
    assert text.splitlines()[-1].startswith("verdict: the kernel cache cannot be written (read-only); the shape cache")
    assert all(word in text for word in ("newton", "numpy", "warp-lang", "CPU cores", "kernel cache"))
    assert all(word in text for word in ("16 worlds, 640x360", "Snapshot.pose", "16 x 24", "2.00", "smaller arrays: 1"))
    assert "Goals.goal" not in text


def test_a_dry_run_tells_what_a_bake_takes_and_writes_nothing(tmp_path, plans, bakes, capsys, monkeypatch):
    command = ["bake", "--config", "smoke", "--episodes", "1000", "--dry-run", "--device", "cpu", "--out", str(tmp_path / "data")]
    assert main(command) == 0
    text = capsys.readouterr().out
    # Mode move at four times the speed, half the rounds: 51 frames, three cameras of 320 x 180 px; 103 kB a view in the format bop.
    assert all(words in text for words in ("1,000, of some 51 frames", "about 153,375", "about 15.8 GB", "at least 0.0 GiB"))
    disk = types.SimpleNamespace(free=12e9)
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda path: disk)
    assert main(command) == 0
    assert "the disk may run full" in capsys.readouterr().out
    disk.free = 2e9
    assert mistake(*command).startswith("1,000 episodes of some 51 frames take about 15.8 GB, and ")
    assert not bakes.calls
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_are_command_lines_that_help_shows(name, capsys):
    assert name in {command for command in app if not command.startswith("-")}
    for line in EXAMPLES[name]:
        words = shlex.split(line)
        assert words[0] == name
        app.parse_args(words, exit_on_error=False, print_error=False)
    assert main([name, "--help"]) == 0
    assert f"synpick-warp {EXAMPLES[name][0]}"[:60] in capsys.readouterr().out


def test_presets_are_listed(capsys):
    assert main(["config", "--presets"]) == 0
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert lines.keys() == set(preset_names())
    assert lines["smoke"].startswith("Small and fast, to check an installation")


def test_doctor_says_how_many_multiprocessors_can_be_reserved_or_why_none(monkeypatch):
    gpu = types.SimpleNamespace(alias="cuda:0", sm_count=132)

    class Partition:
        def __init__(self, device: types.SimpleNamespace, reserved: int) -> None:
            self.reserved = reserved

        def make_stream(self, on_reserved: bool) -> None:
            if failure:
                raise DeviceError(failure)

    monkeypatch.setattr(doctor, "SmPartition", Partition)
    failure = ""
    assert doctor._describe_partition(gpu) == "24 of which can be reserved for physics"
    failure = "cuda:0: the driver has no cuGreenCtxStreamCreate"
    assert doctor._describe_partition(gpu) == f"none of which can be reserved for physics ({failure})"


def test_version():
    result = subprocess.run([sys.executable, "-m", "synpick_warp", "--version"], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == __version__


# ---- values of options ----

WRONG = ["1.6", "2.0", "1e3", "0x10", "0b1", "1_000", " 7", "7 ", "٣", "", "many", "9" * 5000, "nan", "--7", "1\n2"]
PLACES = [
    ("--worlds", "bake --out gone/set --device cpu"),
    ("--episodes", "bake --out gone/set --device cpu"),
    ("--seed", "bake --out gone/set --device cpu"),
    ("--writers", "bake --out gone/set --device cpu"),
    ("--worlds", "doctor"),
    ("--views", "preview gone"),
    ("--episode", "explain gone"),
    ("--attempt", "explain gone --episode 0"),
]


@pytest.mark.parametrize(
    ("option", "command", "text"), [*((*PLACES[0], text) for text in WRONG), *((*place, "1.6") for place in PLACES[1:])]
)
def test_integer_options_take_decimal_digits_only(option, command, text):
    """Fault 7: `--worlds 1.6 --episodes 2.6 --seed 7.6` were rounded."""
    line = mistake(*command.split(), f"{option}={text}")
    assert line.startswith(f'{option} is "')
    assert line.endswith("allowed: a whole number in decimal digits, such as 8")


LAYOUT = DataLayout.of(load_config("smoke", {}))
TEXT = st.text(st.sampled_from("0123456789xX/.-+e_ ²٣\n")) | st.text(max_size=20)


@settings(max_examples=fuzz_examples(100))
@given(text=TEXT)
def test_any_text_is_a_resolution_or_a_shard_or_one_line(text):
    for parse in (parse_resolution, lambda shard: LAYOUT.plan_shard((), parse_shard(shard), "--shard")):
        message = "accepted"
        try:
            parse(text)
        except ConfigError as error:
            message = str(error)
        assert message.isprintable()


@settings(max_examples=fuzz_examples(100))
@given(text=st.text(st.characters()))
def test_any_message_is_one_printable_line(text):
    assert one_line(text).isprintable()
    assert len(one_line(text * 100)) <= MAX_LINE


WORDS = st.sampled_from(["bake", "config", "verify", "merge", "preview", "explain", "--out", "gone", "--set", "--config", "--help", "--"])


@settings(max_examples=fuzz_examples(50))
@given(arguments=st.lists(WORDS | st.text(st.characters(exclude_characters="\0"), max_size=6), max_size=6))
def test_any_command_line_ends_with_an_exit_code(tmp_path_factory, arguments):
    with contextlib.chdir(tmp_path_factory.mktemp("empty")), pytest.MonkeyPatch.context() as patch:
        patch.setattr("synpick_warp.cli.main._bake", lambda *_: 0)
        assert main(arguments) in (0, 1, 2)


def test_terminal_sequences_in_names_are_escaped():
    assert r"there is no file \x1b[2Jgone.toml" in mistake("config", "--config", "\x1b[2Jgone.toml")
