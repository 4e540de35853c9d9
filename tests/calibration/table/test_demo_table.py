"""The demonstration LUT: made once, cached, and used by commands."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from calibration.cli import main as build_lut
from calibration.table import demo_table
from calibration.table.demo_table import table_folder
from calibration.table.lut import open_lut
from evaluation.cli import main as evaluate
from foundation.errors import InputError
from generator.cli import main
from synthesis.cli import main as sim


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("kept")


def run_here(command: list[str], **_: object) -> subprocess.CompletedProcess[bytes]:
    """Run `sim` in this process: starting Python takes longer than making the LUT."""
    assert command[:3] == [sys.executable, "-m", "synthesis.cli"]
    return subprocess.CompletedProcess(command, sim(command[3:]))


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Make the LUT small, and cache it for all tests."""
    program = SimpleNamespace(run=run_here, DEVNULL=subprocess.DEVNULL)
    monkeypatch.setattr(demo_table, "subprocess", program)
    monkeypatch.setattr(demo_table, "BITS", 1)
    monkeypatch.setattr(demo_table, "LIGHTS", "D65,A")
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))


@pytest.mark.slow
def test_makes_lut_once(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = table_folder(Path("demo:"))
    assert first.is_relative_to(folder)
    assert "computed LUT" in capsys.readouterr().out
    time_ns = (first / "lut.json").stat().st_mtime_ns
    assert table_folder(Path("demo:")) == first
    assert (first / "lut.json").stat().st_mtime_ns == time_ns
    assert [light.name for light in open_lut(first).illuminations] == ["D65", "A"]


def test_returns_other_folders(tmp_path: Path) -> None:
    assert table_folder(tmp_path) == tmp_path


def test_names_remedy_without_cache_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calibration.table.demo_table.cache_folder", lambda: None)
    with pytest.raises(InputError, match="XDG_CACHE_HOME"):
        table_folder(Path("demo:"))


@pytest.mark.slow
def test_generates_images_in_one_command(tmp_path: Path) -> None:
    picture = tmp_path / "cat.png"
    cv2.imwrite(str(picture), np.random.default_rng(1).integers(0, 255, (20, 30, 3), dtype=np.uint8))
    assert main(["demo:", str(tmp_path / "out"), "--sources", str(picture), "--light", "0-1"]) == 0
    assert json.loads((tmp_path / "out" / "dataset.json").read_text("utf-8"))["images"]


@pytest.mark.slow
def test_other_commands_accept_demo(capsys: pytest.CaptureFixture[str]) -> None:
    assert build_lut(["info", "demo:"]) == 0
    assert "computed by sim table" in capsys.readouterr().out
    assert build_lut(["match", "demo:", "demo:"]) == 0
    assert evaluate(["paper", "chromaticities", "demo:"]) == 0
