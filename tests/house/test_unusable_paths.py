"""Every command tells of a path that it may not look at, or that no disk can hold, in one sentence."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Generator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

import pytest

COMMANDS = (
    ("evaluation.cli", "{}"),
    ("acquisition.cli", "status", "{}"),
    ("acquisition.cli", "chart", "{}"),
    ("acquisition.cli", "illuminations", "{}"),
    ("acquisition.cli", "check", "{}"),
    ("acquisition.cli", "import", "frames.csv", "chart.json", "{}"),
    ("calibration.cli", "{}", "lut"),
    ("calibration.cli", "info", "{}"),
    ("generator.cli", "{}", "dataset", "--random-scenes", "1"),
    ("generator.cli", "--verify", "{}"),
)
CAPABILITIES_3 = 0x20080522
# Linux's CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH.
IGNORE_PERMISSIONS = 1 << 1 | 1 << 2


@contextmanager
def as_anybody() -> Generator[None]:
    """Let permissions hold in this thread, for root too."""
    if os.geteuid() != 0:
        yield
        return
    if sys.platform != "linux":
        pytest.skip("root may look everywhere, and only Linux lets it do without")
    libc = ctypes.CDLL(None, use_errno=True)
    header, sets = (ctypes.c_uint32 * 2)(CAPABILITIES_3, 0), (ctypes.c_uint32 * 6)()
    if libc.capget(header, sets):
        pytest.skip(f"root may look everywhere: capget: {os.strerror(ctypes.get_errno())}")
    before = sets[0]
    sets[0] &= ~IGNORE_PERMISSIONS
    if libc.capset(header, sets):
        pytest.skip(f"root may look everywhere: capset: {os.strerror(ctypes.get_errno())}")
    try:
        yield
    finally:
        sets[0] = before
        assert libc.capset(header, sets) == 0


def failed(capsys: pytest.CaptureFixture[str], command: tuple[str, ...]) -> str:
    """Return the last line that a command says, which ends with 2."""
    module, *arguments = command
    assert import_module(module).main(arguments) == 2
    return " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_a_folder_that_may_not_be_searched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    theirs = Path("theirs")
    theirs.mkdir(mode=0)
    try:
        with as_anybody():
            said = failed(capsys, tuple(part.format("theirs/it") for part in command))
    finally:
        theirs.chmod(0o700)
    assert "error: cannot " in said
    assert "theirs/" in said
    assert "Permission denied; " in said


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_a_name_that_is_too_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    said = failed(capsys, tuple(part.format("x" * 300) for part in command))
    assert "error: cannot " in said
    assert "x" * 300 in said
    assert "File name too long; " in said
    assert not list(tmp_path.iterdir())
