"""Proofs by replication: the episodes that a seed draws are baked again; what differs is named, and so is what cannot be compared."""

import hashlib
import shutil
from pathlib import Path

import pytest

from synpick_warp.apps.validation import proof
from synpick_warp.dataset.commit import manifest
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.system.progress import SilentProgress
from tests.builders import boxes, mistake, run
from tests.worlds.small_worlds import CUBE, catalog


@pytest.fixture
def copy(picked_set, tmp_path) -> Path:
    """A copy of the shared data set, which a test may change."""
    return shutil.copytree(picked_set, tmp_path / "set")


@pytest.fixture
def copied(picked_set, monkeypatch) -> None:
    """What is baked again is a copy of the shared data set."""

    def bake(_config, out: Path, *_arguments, **_named) -> BakeSummary:
        shutil.copytree(picked_set, out, dirs_exist_ok=True)
        return BakeSummary()

    monkeypatch.setattr(proof, "bake_episodes", bake)


def test_a_data_set_proves_itself_and_says_so(copy):
    with boxes():
        found = run("prove", copy, "--share", 1.0)
    assert found.code == 0
    last = found.out.splitlines()[-1]
    assert last.startswith("2 episodes baked again, ")
    assert last.endswith(" files compared: all are equal")
    (line,) = (copy / proof.PROOFS_FILE).read_text().splitlines()
    assert line.endswith(f"{last.split(', ')[1].split(' files')[0]} files are those of a new bake of episodes 0, 1")
    assert run("verify", copy).code == 0


def test_proofs_are_listed_where_the_folder_can_be_written(copy, copied):
    (copy / proof.PROOFS_FILE).mkdir()
    assert "not recorded: cannot write" in run("prove", copy).out.splitlines()[-1]
    (copy / proof.PROOFS_FILE).rmdir()
    for _ in range(2):
        assert run("prove", copy).code == 0
    assert len((copy / proof.PROOFS_FILE).read_text().splitlines()) == 2


def test_a_seed_draws_at_least_one_episode(picked_set, copied):
    drawn = {tuple(proof.prove(picked_set, 0.01, seed, SilentProgress()).episodes) for seed in range(3)}
    assert all(len(episodes) == 1 for episodes in drawn)
    assert len(drawn) == 2


def _replace(path: Path, data: bytes, record: Path) -> None:
    """Replace a file, and its SHA-256 in the record."""
    digests = [hashlib.sha256(content).hexdigest().encode() for content in (path.read_bytes(), data)]
    path.write_bytes(data)
    record.write_bytes(record.read_bytes().replace(*digests))


def _recorded(path: Path, folder: Path) -> None:
    """Change the last byte of a file of the first episode, as if the bake had written so."""
    lines, entry = folder / "manifest/000000.sha256", folder / "manifest/000000.json"
    before = lines.read_bytes()
    _replace(path, path.read_bytes()[:-1] + b"x", lines)
    after = lines.read_bytes()
    lines.write_bytes(before)
    _replace(lines, after, entry)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda path, folder: path.unlink(), "is missing"),
        (lambda path, folder: path.write_bytes(path.read_bytes()[:-1] + b"x"), "has changed since it was written"),
        (_recorded, "differs from byte "),
    ],
)
def test_a_difference_is_named(copy, copied, change, said):
    path = next(iter(sorted((copy / "train").rglob("rgb/*"))))
    change(path, copy)
    found = run("prove", copy, "--share", 1.0)
    assert found.code == 1
    assert found.out.splitlines()[-1].startswith(f"{path} {said}")


def test_what_cannot_be_compared_is_one_line(copy, tmp_path, monkeypatch):
    for share in (0.0, 1.5):
        assert "allowed: above 0, to 1" in mistake("prove", copy, "--share", share)
    with boxes(lambda: catalog(CUBE)):
        assert f"{copy} was started with other objects" in mistake("prove", copy)
    monkeypatch.setattr(manifest, "_version", lambda name: "0.0")
    assert "only the same versions bake the same bytes" in mistake("prove", copy)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["set"]
