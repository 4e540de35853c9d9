"""The whole workflow with the commands: chart, illuminants, session, LUT, images, evaluation."""

from __future__ import annotations

import csv
import importlib
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from acquisition.run.plan import planned_steps
from acquisition.run.rig.simulated import sheet, simulated_body, simulated_room
from calibration.table.lut import Lut, open_lut
from experiment.chart.model import load_chart
from experiment.config import load_lab
from experiment.lights import load_illuminants
from experiment.session.folder import Session
from foundation.errors import FormatError
from sim.world.world import World

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("undrawn")]

Run = Callable[..., int]

LAB = """
rig = "simulated"
chart = "chart/chart.json"
illuminations = "illuminations.csv"
[judge]
response = false
[simulated]
body = "Test"
seed = 11
"""


@pytest.fixture(scope="module")
def run() -> Run:
    """Return a function that runs a command as the shell does and returns its exit code."""

    def call(module: str, *arguments: object) -> int:
        return importlib.import_module(module).main([*map(str, arguments)])

    return call


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory, run: Run) -> Path:
    """Return a folder with a chart of 512 colours, a session of seven illuminants, and its LUT."""
    folder = tmp_path_factory.mktemp("lab")
    assert run("acquisition.cli", "chart", folder / "chart", "--bits", 3, "--no-tiff") == 0
    lights = folder / "illuminations.csv"
    assert run("acquisition.cli", "illuminations", lights, "--grid", 1, "--blackbodies", "2500:10000:2500") == 0
    (folder / "LAB.toml").write_text(LAB)
    assert run("acquisition.cli", "run", folder / "LAB.toml", folder / "session") == 0
    assert run("calibration.cli", folder / "session", folder / "lut") == 0
    return folder


@pytest.fixture(scope="module")
def lut(built: Path) -> Lut:
    return open_lut(built / "lut")


@pytest.fixture(scope="module")
def pictures(built: Path) -> Path:
    """Return a folder with a plain picture, a picture with an edge, and a broken file."""
    folder = built / "pictures"
    folder.mkdir()
    plain = np.full((80, 120, 3), (200, 90, 40), dtype=np.uint8)
    halves = plain.copy()
    halves[:, 60:] = (30, 220, 130)
    cv2.imwrite(str(folder / "a_plain.png"), plain[..., ::-1])
    cv2.imwrite(str(folder / "b_halves.png"), halves[..., ::-1])
    (folder / "c_broken.png").write_bytes(b"\x89PNG\r\n\x1a\nnothing")
    return folder


def test_lut_has_documented_format(lut: Lut, built: Path) -> None:
    assert lut.samples.shape == (7, 512, 25, 3)
    assert lut.samples.dtype == np.dtype("<u2")
    assert lut.samples.flags.c_contiguous
    header = (built / "lut" / "illuminations.csv").read_text().splitlines()[0]
    assert header == "index,kind,cct_k,red,green,blue,white_r,white_g,white_b"
    assert ", taken in the simulated laboratory" in (built / "lut" / "report.html").read_text(encoding="utf-8")
    assert lut.provenance.bits == 3


def test_ground_truth_equals_white_of_room(lut: Lut, built: Path) -> None:
    settings = load_lab(built / "LAB.toml")
    with Session.open(built / "session") as session:
        world = World(sheet(session.chart), simulated_body(settings), simulated_room(settings))
    truth = np.array([world.white(light.colour, settings.camera.exposure) for light in lut.illuminations])
    cosine = (truth * lut.white).sum(1) / np.linalg.norm(truth, axis=1) / np.linalg.norm(lut.white, axis=1)
    degrees = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    assert np.median(degrees) <= 0.2
    assert degrees.max() <= 0.5


@pytest.fixture(scope="module")
def dataset(built: Path, pictures: Path, run: Run) -> Path:
    """Return a data set of the pictures under two illuminants."""
    out = built / "dataset"
    options = ("--sources", pictures, "--light", "3,5", "--seed", 4, "--rendering", "codes")
    assert run("generator.cli", built / "lut", out, *options) == 0
    return out


def test_generated_area_has_mean_of_lut(lut: Lut, dataset: Path) -> None:
    out = dataset
    with (out / "ground_truth.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 4, "two pictures under two illuminants; the broken one is skipped"
    colour = (200 >> 5) << 6 | (90 >> 5) << 3 | 40 >> 5
    for row in rows:
        image = cv2.imread(str(next((out / "images").glob(f"{row['image'].split('.')[0]}*"))), cv2.IMREAD_UNCHANGED)
        assert image is not None
        assert image.dtype == np.uint16
        patch = image[:, :60, ::-1].reshape(-1, 3).astype(np.float64)
        samples = lut.samples[int(row["illumination"]), colour].astype(np.float64)
        error = samples.std(axis=0) / np.sqrt(len(patch))
        # Six standard errors: each of the 12 comparisons fails by chance once in 5·10⁸.
        assert (np.abs(patch.mean(axis=0) - samples.mean(axis=0)) <= 6 * error + 1e-9).all()
        truth = lut.ground_truth[int(row["illumination"])]
        assert [float(row[c]) for c in "rgb"] == pytest.approx(truth.tolist(), abs=1e-6)
    assert len((out / "gt.txt").read_text().splitlines()) == 4
    assert '"seed"' in (out / "dataset.json").read_text()


def test_evaluates_data_set(dataset: Path, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("evaluation.cli", dataset) == 0
    assert "Gray-world" in capsys.readouterr().out


def test_refuses_lut_of_other_version(built: Path, lut: Lut, tmp_path: Path) -> None:
    head = json.loads((built / "lut" / "lut.json").read_text())
    head["version"] = 2
    for name in ("illuminations.csv", "samples.npy"):
        (tmp_path / name).write_bytes((built / "lut" / name).read_bytes())
    (tmp_path / "lut.json").write_text(json.dumps(head))
    with pytest.raises(FormatError):
        open_lut(tmp_path)


def test_refuses_session_without_frames(built: Path, run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    settings = load_lab(built / "LAB.toml")
    lights = load_illuminants(settings.illuminations)
    steps = planned_steps(settings, lights)
    Session.create(built / "bare", settings.to_toml(), load_chart(settings.chart), lights, steps).close()
    assert run("calibration.cli", built / "bare", built / "never") in (2, 4)
    assert "frame" in capsys.readouterr().err
    assert not (built / "never").exists()
