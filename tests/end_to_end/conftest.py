"""A small laboratory on disk: a chart of 64 colours, four illuminants, the small simulated body."""

from __future__ import annotations

import csv
import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from acquisition.cli import main
from drivers.presenter import Colour
from experiment.chart.layout import design_chart
from experiment.lights import Illuminant, save_illuminants
from tests.calibration.lab import rendered_once

__all__ = ["frame_hashes", "lab", "rendered_once", "session", "undisturbed"]

LIGHTS = (
    Illuminant(0, "uniform", None, Colour(255, 0, 0)),
    Illuminant(1, "uniform", None, Colour(120, 255, 180)),
    Illuminant(2, "blackbody", 2500.0, Colour(255, 159, 70)),
    Illuminant(3, "blackbody", 6500.0, Colour(255, 254, 250)),
)

LAB = """
rig = "simulated"
chart = "chart.json"
illuminations = "illuminations.csv"
[judge]
response = false
[sequence]
reference_every = 2
warm_up_s = 0
[simulated]
body = "Test"
seed = 7
"""


def make_lab(folder: Path) -> Path:
    """Write a LAB.toml with its chart and illuminants, and return its path."""
    design_chart(bits=2, seed=3).save(folder / "chart.json")
    save_illuminants(LIGHTS, folder / "illuminations.csv")
    path = folder / "LAB.toml"
    path.write_text(LAB)
    return path


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    return make_lab(tmp_path)


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the session that `acquire run` takes in this lab; do not change it."""
    lab = make_lab(tmp_path_factory.mktemp("undisturbed"))
    session = lab.parent / "session"
    assert main(["run", str(lab), str(session)]) == 0
    return session


@pytest.fixture
def session(lab: Path, undisturbed: Path) -> Path:
    """Return a copy of the complete session, which may be changed."""
    return shutil.copytree(undisturbed, lab.parent / "session")


@pytest.fixture
def frame_hashes() -> Callable[[Path], dict[tuple[str, str], list[str]]]:
    """Return a function that hashes the accepted frames of a session on disk, by kind and illuminant."""

    def hashes(session: Path) -> dict[tuple[str, str], list[str]]:
        digests: dict[tuple[str, str], list[str]] = {}
        with (session / "frames.csv").open() as stream:
            for row in csv.DictReader(stream):
                digest = hashlib.sha256((session / row["file"]).read_bytes()).hexdigest()
                assert digest == row["sha256"]
                if row["verdict"] == "accepted":
                    digests.setdefault((row["kind"], row["illumination"]), []).append(digest)
        return digests

    return hashes
