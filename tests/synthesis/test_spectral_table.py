"""Tables under spectra: the ground truth is the camera's view of bare paper, and lights keep their names in use."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from calibration.table.lut import Lut, open_lut
from evaluation.datasets.generated import open_generated
from experiment.lights import load_illuminations
from foundation.errors import FormatError, InputError
from generator.cli import main as generate
from generator.lights.choices import parse_light
from sim.spectral import print_reflectance, printed_reflectance, sensitivities
from synthesis.lamps import LightSpectra, read_lights
from synthesis.settings import parse_settings, table_task
from synthesis.table import compute_table

pytestmark = pytest.mark.slow

CAMERA = "Canon_EOS_5D_Mark_II"
SMALL = parse_settings({"chart": {"bits": 2}}, "here")


@pytest.fixture(scope="module")
def lights() -> LightSpectra:
    return read_lights("D65,FL2,A,LED-RGB1,3000K,6000K")


@pytest.fixture(scope="module")
def lut(lights: LightSpectra, tmp_path_factory: pytest.TempPathFactory) -> Lut:
    out = tmp_path_factory.mktemp("spectral") / "lut"
    compute_table(table_task(CAMERA, SMALL, "here", lights), out, threads=2)
    return open_lut(out)


def test_the_ground_truth_is_what_the_camera_sees_of_bare_paper(lut: Lut, lights: LightSpectra) -> None:
    powers = np.array([light.power for light in lights.lights])
    seen = np.einsum("lw,w,wc->lc", powers, print_reflectance([(255, 255, 255)])[0], sensitivities(CAMERA))
    truth = seen / seen.sum(axis=1, keepdims=True)
    # Some sixty white patches of 25 samples, each noisy by a percent at most.
    assert lut.ground_truth == pytest.approx(truth, rel=2e-3)


def test_every_cell_is_what_the_camera_sees_of_its_ink(lut: Lut, lights: LightSpectra) -> None:
    codes = np.stack(np.meshgrid(*[np.arange(4) * 64] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    for number, light in enumerate(lights.lights):
        curves = light.power[:, None] * sensitivities(CAMERA)
        cells = print_reflectance(codes) @ curves / (print_reflectance([(255, 255, 255)]) @ curves)
        found = lut.samples[number].astype(np.float64)
        error = found.std(axis=1, ddof=1) / 5 + 2e-3 * found.mean(axis=1)
        assert float(np.abs((found.mean(axis=1) - cells * lut.white[number]) / error).max()) < 5


def test_every_light_is_exposed_alike(lut: Lut) -> None:
    brightest = lut.white.max(axis=1)
    assert float(brightest.max() / brightest.min()) == pytest.approx(1, abs=3e-3)


def test_lights_have_names_on_disk_and_in_use(lut: Lut, lights: LightSpectra) -> None:
    assert [light.name for light in lut.illuminations] == [light.name for light in lights.lights]
    assert parse_light("FL2", lut).lights == (1,)
    assert parse_light("3000K", lut).lights == (4,)
    assert set(parse_light("4200K", lut).lights) == {4, 5}
    with pytest.raises(InputError):
        parse_light("FL3", lut)


def test_a_session_cannot_be_planned_with_spectra(lut: Lut) -> None:
    with pytest.raises(FormatError, match=r"'spectrum'.* blackbody"):
        load_illuminations(lut.folder / "illuminations.csv")


def test_another_print_gives_another_table(lights: LightSpectra, tmp_path: Path) -> None:
    task = table_task(CAMERA, SMALL, "here", lights)
    managed = replace(task, room=replace(task.room, profile="managed", paper="glossy"))
    compute_table(managed, tmp_path / "lut", threads=2)
    lut = open_lut(tmp_path / "lut")
    curves = lights.lights[0].power[:, None] * sensitivities(CAMERA)
    black, white = printed_reflectance([(0, 0, 0), (255, 255, 255)], "managed", "glossy") @ curves
    assert lut.samples[0, 0].mean(axis=0) / lut.white[0] == pytest.approx(black / white, rel=0.15)


def test_datasets_and_results_say_that_the_table_was_computed(lut: Lut, tmp_path: Path) -> None:
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    Image.fromarray(np.random.default_rng(1).integers(0, 256, (24, 32, 3), dtype=np.uint8)).save(pictures / "a.png")
    out = tmp_path / "dataset"
    assert generate([str(lut.folder), str(out), "--sources", str(pictures), "--light", "LED-RGB1"]) == 0
    description = json.loads((out / "dataset.json").read_text())
    assert description["table"]["computed"] == lut.provenance.computed
    assert [light["name"] for light in description["lights"]] == ["LED-RGB1"]
    assert open_generated(out).treatment["table"] == "computed from spectra and a model of the sensor"
