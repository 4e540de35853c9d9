"""Every command reports a path without permission, or with an impossible name, in one sentence."""

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
def with_permissions() -> Generator[None]:
    """Enforce permissions in this thread, also for root."""
    if os.geteuid() != 0:
        yield
        return
    if sys.platform != "linux":
        pytest.skip("root ignores permissions, and only Linux can change that")
    libc = ctypes.CDLL(None, use_errno=True)
    header, sets = (ctypes.c_uint32 * 2)(CAPABILITIES_3, 0), (ctypes.c_uint32 * 6)()
    if libc.capget(header, sets):
        pytest.skip(f"root ignores permissions: capget: {os.strerror(ctypes.get_errno())}")
    permissions = sets[0]
    sets[0] &= ~IGNORE_PERMISSIONS
    if libc.capset(header, sets):
        pytest.skip(f"root ignores permissions: capset: {os.strerror(ctypes.get_errno())}")
    try:
        yield
    finally:
        sets[0] = permissions
        assert libc.capset(header, sets) == 0


def refusal_of(capsys: pytest.CaptureFixture[str], command: tuple[str, ...]) -> str:
    """Return the message of a command that ends with exit code 2."""
    module, *arguments = command
    assert import_module(module).main(arguments) == 2
    return " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_refuses_folder_without_permission(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    theirs = Path("theirs")
    theirs.mkdir(mode=0)
    try:
        with with_permissions():
            message = refusal_of(capsys, tuple(part.format("theirs/it") for part in command))
    finally:
        theirs.chmod(0o700)
    assert "error: cannot " in message
    assert "theirs/" in message
    assert "Permission denied; " in message


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_refuses_too_long_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    message = refusal_of(capsys, tuple(part.format("x" * 300) for part in command))
    assert "error: cannot " in message
    assert "x" * 300 in message
    assert "File name too long; " in message
    assert not list(tmp_path.iterdir())
