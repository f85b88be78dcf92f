"""The command line: options, exit codes, one line for a mistake, nothing left behind."""

from __future__ import annotations

import json
import os
import pickle
import shlex
import subprocess
import sys
import tomllib
import types
from pathlib import Path

import pytest
import trimesh
import warp as wp

from synpick_warp import __version__
from synpick_warp.cli.commands import doctor, forecast
from synpick_warp.cli.main import app, main
from synpick_warp.cli.options import EXAMPLES
from synpick_warp.codes import Ending
from synpick_warp.configs.files.load import load_config, preset_names
from synpick_warp.errors import DatasetError, DeviceError, OutputError, SynpickError
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.factory.episodes import BakeSummary, EpisodeOutcome
from synpick_warp.factory.memory_plan import Term
from synpick_warp.stages import timing
from tests.builders import mistake
from tests.system.test_pool import refuse  # Writer processes import its module, which imports little.


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


def test_bake_passes_devices_and_automatic_sizes_on(tmp_path, bakes):
    assert main(["bake", "--out", str(tmp_path), "--devices", "cpu, cpu", "--worlds", "auto", "--writers", "auto"]) == 0
    [(config, *_)] = bakes.calls
    assert (config.bake.worlds, config.bake.writers, bakes.devices) == (0, 0, ("cpu", "cpu"))


def test_bake_says_so_by_exit_code_if_episodes_are_missing(tmp_path, bakes, capsys):
    bakes.result = finished(2)
    bakes.result.episodes[1] = bakes.result.episodes[1]._replace(arrangement=19, ending=Ending.UNSETTLED, frames=0)
    assert main(["bake", "--out", str(tmp_path / "a"), "--device", "cpu", "--episodes", "2"]) == 1
    assert "did not come to rest" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--worlds=-1"], "bake.worlds is -1 on the command line; allowed: at least 0, at most 65536"),
        (["--worlds", "many"], '--worlds is "many"; allowed: a whole number in decimal digits, such as 8'),
        (["--resolution", "0x0"], "cameras.resolution is [0, 0] on the command line; allowed: each at least 1, at most 8192 [px]"),
        (["--resolution", "640"], '--resolution is "640"; allowed: WIDTHxHEIGHT in pixels, such as 640x360'),
        (["--resolution", "640x-1"], '--resolution is "640x-1"; allowed: WIDTHxHEIGHT in pixels, such as 640x360'),
        (["--mode", "juggle"], 'bake.mode is "juggle" on the command line; allowed: pick, target, move, mixed'),
        (["--mode", "mixed", "--set", "bake.mix=pick"], 'bake.mix is "pick" on the command line; allowed: 3 numbers in a list'),
        (["--device", "tpu"], 'bake.device is "tpu"; allowed: cpu, cuda:N such as cuda:0, or auto'),
        (
            ["--models", "no-such"],
            "there is no models folder no-such; --models takes a folder of BOP models or of PLY, OBJ, glTF",
        ),
        (["--lights", "no-such"], "there is no lights folder no-such; --lights takes a folder of .hdr maps and sIBL sets"),
        (
            ["--config", "no-such.toml"],
            "there is no file no-such.toml; give a .toml file or a preset: full-bin, randomized, smoke, synpick, synpick-hard, ",
        ),
        (["--config", "smook"], 'there is no preset "smook"; presets: full-bin, randomized, smoke, synpick, synpick-hard, '),
        (["--set", "physics.step"], "--set physics.step has no value; "),
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


def test_formats_and_share_are_passed_on(tmp_path, bakes):
    assert main(["bake", "--device=cpu", f"--out={tmp_path}", "--formats=zarr, bop", "--shard=1/3"]) == 0
    [(config, _, shard, _)] = bakes.calls
    assert config.bake.formats == ("zarr", "bop")
    assert shard == (1, 3)


def test_splits_are_passed_on(bakes, tmp_path):
    assert main(["bake", "--device=cpu", f"--out={tmp_path}", "--split=train, test", "--shard=1/300"]) == 0
    [(config, _, shard, splits)] = bakes.calls
    assert (shard, splits, config.bake.episodes) == ((1, 300), ("train", "test"), 300)


@pytest.mark.parametrize(
    ("option", "said"),
    [
        (
            "--formats=bop,obj",
            'bake.formats is ["bop", "obj"] on the command line; allowed: any of bop, shards, usd, zarr, picks, lerobot, coco, yolo',
        ),
        ("--shard=3", '--shard is "3"; allowed: i/n with i from 0 to n - 1, such as 0/4'),
        ("--shard=4/4", "--shard is 4/4; allowed: i/n with i from 0 to n - 1, such as 0/4"),
        ("--shard=4/8", "--shard 4/8 has none of 4 episodes; use fewer shards"),
    ],
)
def test_formats_and_shares_that_are_not_there(tmp_path, bakes, option, said):
    assert mistake("bake", "--device=cpu", f"--out={tmp_path}", option) == said


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
    bakes.result = finished(4)
    bakes.result.stopped = 2
    assert main(["bake", "--device=cpu", f"--out={tmp_path}"]) == 130
    assert capsys.readouterr().err.endswith("interrupted: 4 of 4 episodes are complete; the same command completes the data set\n")


def test_output_folder_that_is_not_empty(tmp_path, bakes):
    (tmp_path / "mine.txt").write_text("precious")
    said = mistake("bake", "--device", "cpu", "--out", str(tmp_path))
    assert said == f"{tmp_path} is not empty; --out takes a new or an empty folder, or a data set to resume"
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    assert not bakes.calls


def test_output_folder_that_is_a_file(tmp_path, bakes):
    (tmp_path / "file").write_text("precious")
    said = mistake("bake", "--device", "cpu", "--out", str(tmp_path / "file"))
    assert said == f"{tmp_path / 'file'} is a file; --out takes a new or an empty folder"
    said = mistake("bake", "--device", "cpu", "--out", str(tmp_path / "file" / "data"))
    assert said.startswith(f"cannot write {tmp_path / 'file' / 'data'}: Not a directory; ")


def test_output_folder_that_cannot_be_written(tmp_path, bakes):
    if os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    tmp_path.chmod(0o500)
    assert ": Permission denied; " in mistake("bake", "--device", "cpu", "--out", str(tmp_path / "data"))


def test_a_mistake_found_while_baking_takes_empty_folders_away_again(tmp_path, bakes):
    bakes.result = OutputError("the disk\nis full")
    assert mistake("bake", "--device", "cpu", "--out", str(tmp_path / "a" / "b")) == "the disk is full"
    assert list(tmp_path.iterdir()) == []


def test_an_existing_empty_folder_is_used_and_kept(tmp_path, bakes):
    bakes.result = OutputError("no")
    mistake("bake", "--device", "cpu", "--out", str(tmp_path))
    assert tmp_path.is_dir()


def test_interrupt(tmp_path, bakes, capsys):
    bakes.result = KeyboardInterrupt()
    assert main(["bake", "--device", "cpu", "--out", str(tmp_path / "data")]) == 130
    assert capsys.readouterr().err == "synpick-warp: interrupted\n"


def test_a_fault_of_ours_keeps_its_traceback(tmp_path, bakes):
    bakes.result = ZeroDivisionError()
    with pytest.raises(ZeroDivisionError):
        main(["bake", "--device", "cpu", "--out", str(tmp_path / "data")])


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
    assert "(pick, target, move, mixed, cycle; default pick; bake.mode)" in text


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

    for command in (doctor, forecast):
        monkeypatch.setattr(command, "plan_memory", plan_memory)
        monkeypatch.setattr(command, "fit_to_device", lambda config, *_: config)


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
    monkeypatch.setattr(forecast.shutil, "disk_usage", lambda path: disk)
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


COMMAND = [sys.executable, "-m", "synpick_warp"]


def test_version():
    result = subprocess.run([*COMMAND, "--version"], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == __version__


PLY_HEAD = "ply\nformat ascii 1.0\n{comment}element vertex 3\nproperty float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize(
    "ply",
    [
        PLY_HEAD.format(comment="") + "end_header\n0 0 0\n9 0 0\n0 9 0\n",
        PLY_HEAD.format(comment="comment TextureFile gone.png\n")
        + "property float texture_u\nproperty float texture_v\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        + "0 0 0 0 0\n9 0 0 1 0\n0 9 0 0 1\n3 0 1 2\n",
    ],
    ids=["no faces", "no texture file"],
)
def test_models_that_cannot_be_used(tmp_path, ply):
    models = tmp_path / "models"
    models.mkdir()
    (models / "models_info.json").write_text('{"1": {"diameter": 12.7}}')
    (models / "obj_000001.ply").write_text(ply)
    said = mistake("bake", "--config", "smoke", "--device", "cpu", "--models", str(models), "--out", str(tmp_path / "data"))
    assert "obj_000001.ply" in said
    assert not (tmp_path / "data").exists()


def boxes(folder: Path, *sides: float) -> None:
    """A folder of cubes with these sides [m], as OBJ files."""
    folder.mkdir()
    for number, side in enumerate(sides):
        (folder / f"cube_{number}.obj").write_bytes(trimesh.creation.box((side, side, side)).export(file_type="obj").encode())


STRICT = "[objects]\nstrict = true\n"
"""Objects that cannot be used end a bake; by default they are left out."""


@pytest.mark.parametrize(
    ("sides", "settings", "said"),
    [
        ((), "", "models folder {models}: it contains no models; "),
        ((0.05, 0.6), STRICT, "cube_1: too large for the tote: 0.6 x 0.6 x 0.6 m, diameter 1.039 m, but the tote's opening is "),
        ((0.05, 50.0), STRICT, "cube_1: too large for the tote: 50 x 50 x 50 m, "),
        ((0.25, 0.2), "", "arrangement.volume is 0.003 m³, but the smallest object, cube_1, takes 0.008 m³; make it larger"),
        ((0.05,), '[[object_rows]]\nid = 1\nname = "cube_0"\ndiameter = 0.0866\nmass = 0\n', "object_rows[0].mass is 0 in {file}; "),
        ((0.05,), '[[object_rows]]\nid = 1\nname = "cube_0"\ndiameter = 0.0866\nmass = 1e-30\n', "cube_0: mass 1e-30 kg in its row "),
        ((0.05,), "[objects]\ndensity = 1e-12\n", "cube_0: mass 1.25e-16 kg by objects.density; "),
    ],
    ids=["empty", "too large", "millimetres", "over budget", "no mass", "hardly a mass", "hardly a density"],
)
def test_objects_that_cannot_be_baked(tmp_path, sides, settings, said):
    """One line, before anything is simulated, and nothing in the data set's place."""
    models, file, out = tmp_path / "models", tmp_path / "my.toml", tmp_path / "deep" / "data"
    boxes(models, *sides)
    file.write_text(f'preset = "smoke"\n{settings}')
    heard = mistake("bake", "--config", str(file), "--device", "cpu", "--models", str(models), "--out", str(out))
    assert heard.startswith(said.format(models=models, file=file))
    assert not out.parent.exists()
