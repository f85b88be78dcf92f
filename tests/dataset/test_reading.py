"""`synpick_warp.open`: what it gives, and what it does not load."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import synpick_warp
from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.errors import DatasetError
from tests.harness.environment import checkout_environment
from tests.worlds import box_views
from tests.worlds.trajectories import ATTEMPT, STEP_COUNT, UNSEEN, config, ticks, write_set

FRAMES = 5
HEAVY = ("warp", "newton", "cv2", "pxr", "trimesh", "scipy", "coacd")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = write_set(tmp_path_factory.mktemp("reading") / "set", config(), (0, 4), FRAMES)
    (folder / "config.toml").write_text(config_to_toml(load_config("smoke", {})))
    return folder


def test_episodes_by_number(folder):
    data = synpick_warp.open(folder)
    assert list(data) == [0, 4]
    assert len(data) == 2
    assert 4 in data
    assert 1 not in data
    with pytest.raises(KeyError, match="no episode 1"):
        data[1]
    assert repr(data[4]) == "Episode(4: 5 frames, emptied)"
    assert (data[4].number, len(data[4]), data[4].attributes["mode"]) == (4, FRAMES, "pick")


def test_arrays_by_name_are_those_in_memory(folder):
    episode = synpick_warp.open(str(folder))[4]
    batches = list(ticks((4,), FRAMES))
    force = episode.steps["contact_force"]
    assert force.attrs["units"] == "N"
    assert force.shape == (FRAMES * STEP_COUNT, 4, 3)
    np.testing.assert_array_equal(force[4:8], batches[1].steps["contact_force"][0, :, :4])
    np.testing.assert_array_equal(episode.ticks["peak_force"][:], [batch.tick["peak_force"][0] for batch in batches])
    assert "seal_force" in episode.steps
    assert set(episode.arrangement) == {"object_id", "mass", "drop_pose"}
    with pytest.raises(KeyError, match="speed; there are angular_velocity, attached, contact_force"):
        episode.steps["speed"]


def test_attempts_are_records(folder):
    episode = synpick_warp.open(folder)[4]
    assert episode.attempts == (ATTEMPT | {"episode": 4}, UNSEEN | {"episode": 4})
    assert episode.attempt_arrays["hits"][:].tolist() == [9, 0]


def test_objects_cameras_and_settings(folder):
    data = synpick_warp.open(folder)
    entries, lenses = box_views.catalog().entries, box_views.cameras()
    assert [(one.object_id, one.name, one.mass, one.volume) for one in data.objects] == [
        (entry.obj_id, entry.name, entry.mass, entry.volume) for entry in entries
    ]
    assert type(data.objects[0].object_id) is int
    np.testing.assert_array_equal(data.objects[1].inertia, entries[1].inertia)
    assert len(data.cameras) == len(lenses)
    np.testing.assert_array_equal(data.cameras[2].matrix, lenses[2].matrix)
    assert data.cameras[0].resolution == lenses[0].resolution
    assert data.config == load_config("smoke", {})
    assert (data.attributes["steps_per_tick"], data.attributes["units"]["step"]) == (STEP_COUNT, "s")


def test_steps_that_were_not_recorded_are_none(tmp_path):
    write_set(tmp_path, config(steps=False), (0,), 2, steps=False)
    assert dict(synpick_warp.open(tmp_path)[0].steps) == {}


def test_a_folder_that_is_not_a_data_set_is_a_clear_error(tmp_path):
    with pytest.raises(DatasetError, match=r"is not a data set: it has neither manifest\.json nor trajectory\.zarr"):
        synpick_warp.open(tmp_path)


def test_opening_reads_nothing(tmp_path, folder):
    """Names are enough until something is asked for: here an episode's files are no zarr."""
    for name in ("episodes/000003/steps", "episodes/000003/ticks"):
        (tmp_path / "trajectory.zarr" / name).mkdir(parents=True)
    for place in ("", "episodes", "episodes/000003"):
        (tmp_path / "trajectory.zarr" / place / "zarr.json").write_text("not JSON")
    data = synpick_warp.open(tmp_path)
    episode = data[3]
    assert list(data) == [3]
    assert list(episode.steps) == []
    with pytest.raises(DatasetError, match=r"000003/zarr\.json is damaged: JSON is malformed"):
        _ = episode.attributes


def test_no_simulator_is_loaded(folder):
    """To open a data set, list it and read settings takes no zarr either."""
    code = (
        "import sys, synpick_warp\n"
        "data = synpick_warp.open(sys.argv[1])\n"
        "print(len(data), data[4].attributes['frames'], data.config.bake.seed, 'zarr' in sys.modules, 'numpy' in sys.modules)\n"
        "data[4].steps['pose'][:2], data.objects, data.cameras\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(folder)], capture_output=True, text=True, check=True, env=checkout_environment())
    assert done.stdout.splitlines() == [f"2 {FRAMES} 0 False False", "[]"]
