"""Cache folders: a home that is a file, missing, read-only or full is replaced, with a note that names folder and variable."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from synpick_warp.scenes.collision.shapes import default_cache_dir
from synpick_warp.system.hardware import caches
from synpick_warp.system.hardware.caches import CacheError, find_fault, kernel_cache, usable_kernel_cache, user_cache

HANG = 60.0


@pytest.fixture
def home(tmp_path, monkeypatch) -> Path:
    """A home, and no variable that moves a cache."""
    for variable in ("WARP_CACHE_PATH", "XDG_CACHE_HOME"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return tmp_path / "home"


def test_a_home_that_can_be_written_is_used(home, capsys):
    assert usable_kernel_cache("1.0") is None
    assert kernel_cache("1.0") == home / ".cache" / "warp" / "1.0"
    assert default_cache_dir() == home / ".cache" / "synpick-warp" / "collision"
    assert capsys.readouterr().err == ""


def check_note(capsys, folder: Path | None, reason: str) -> None:
    """Check the temporary folder and the note on it."""
    assert folder is not None
    assert find_fault(folder) is None
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("synpick-warp: note: the kernel cache ")
    assert f"cannot be used ({reason}); kernels are compiled into {folder}, " in line
    assert line.endswith("set WARP_CACHE_PATH to a folder that can be written")


def no_home() -> Path:
    raise RuntimeError("Could not determine home directory.")


@pytest.mark.parametrize("kind", ["a file", "like a read-only file system", "missing"])
def test_a_home_that_cannot_be_used_is_replaced(home, capsys, monkeypatch, kind):
    """Fault 6: /proc refuses even root; a container's user has no entry in the password file."""
    if kind == "missing":
        monkeypatch.setattr(Path, "home", no_home)
        assert user_cache() is None
        assert find_fault(default_cache_dir()) == "Not a directory"
    elif kind == "a file":
        home.write_text("")
    else:
        monkeypatch.setenv("HOME", "/proc")
    reason = {"a file": "Not a directory", "missing": "the user has no home"}.get(kind, "No such file or directory")
    check_note(capsys, usable_kernel_cache("1.0"), reason)


def test_a_full_disk_is_replaced_and_its_kernels_are_linked(home, capsys, monkeypatch):
    """Fault 6."""
    monkeypatch.setattr(caches, "MIN_FREE", 2**70)
    module = home / ".cache" / "warp" / "1.0" / "wp_a"
    module.mkdir(parents=True)
    (module / "a.o").write_text("code")
    folder = usable_kernel_cache("1.0")
    assert folder is not None
    assert (folder / "1.0" / "wp_a" / "a.o").read_text() == "code"
    (folder / "1.0" / "wp_a" / "b.o").write_text("new")
    assert not (module / "b.o").exists()
    assert re.search(r"\(only \d+ MiB are free\)", capsys.readouterr().err)


def test_a_variable_moves_the_kernel_cache(home, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "kernels"))
    home.write_text("")
    assert usable_kernel_cache("1.0") is None
    assert kernel_cache("1.0") == tmp_path / "kernels" / "1.0"
    monkeypatch.setenv("WARP_CACHE_PATH", str(home / "kernels"))
    check_note(capsys, usable_kernel_cache("1.0"), "Not a directory")


def test_no_temporary_folder_either_is_one_line(home, monkeypatch):
    def full(**_: str) -> str:
        raise OSError(28, "No space left on device")

    home.write_text("")
    monkeypatch.setattr("synpick_warp.system.hardware.caches.tempfile.mkdtemp", full)
    with pytest.raises(CacheError, match=r"^the kernel cache cannot be used \([^\n]*; set WARP_CACHE_PATH to a folder [^\n]*$"):
        usable_kernel_cache("1.0")


def test_warp_starts_without_a_home_and_its_cache_is_removed(home):
    """Fault 6, in a real process: a traceback before."""
    home.write_text("")
    code = "from synpick_warp.system.hardware.device import start_warp; import warp as wp; start_warp(); print(wp.config.kernel_cache_dir)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=HANG, check=False, env=dict(os.environ))
    assert (result.returncode, len(result.stderr.splitlines())) == (0, 1), result.stderr
    folder = Path(result.stdout.strip())
    assert str(folder.parent) in result.stderr
    assert not folder.parent.exists()
