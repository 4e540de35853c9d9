"""The tint of a print's greys is found where there is one, and told by `generate` unless a rendering was chosen."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.table.lut import Lut
from generator.cli import main
from generator.rendering.colorimetric import grey_tint_deg
from tests.generator.conftest import MakeLut


def tinted(lut: Lut, red: float) -> Lut:
    """Return the table with greys, of equal codes between black and white, that reflect another share of red."""
    samples = np.array(lut.samples)
    greys = np.array([1, 2]) * 21
    samples[:, greys, :, 0] = np.rint(samples[:, greys, :, 0] * red)
    object.__setattr__(lut, "samples", samples)
    return lut


def test_the_angle_is_that_of_the_greys(make_lut: MakeLut) -> None:
    plain, light = grey_tint_deg(make_lut()) or (np.nan, -1)
    # A veil of 200 counts in each channel under a light that is not white: darkest grey 1/3, by hand.
    white = 200 + 3000 * np.array([1 + 0.2 * light, 1.0, 1.4 - 0.2 * light])
    grey = 200 + (white - 200) / 3
    cosine = grey @ white / np.linalg.norm(grey) / np.linalg.norm(white)
    assert plain == pytest.approx(np.degrees(np.arccos(cosine)), abs=0.3)
    red, _ = grey_tint_deg(tinted(make_lut(name="red"), 1.2)) or (np.nan, -1)
    assert red > plain + 3


def test_greys_that_are_unfit_do_not_count(make_lut: MakeLut) -> None:
    found = grey_tint_deg(tinted(make_lut(unfit=(21, 42)), 1.2))
    assert found is None


@pytest.mark.parametrize(("more", "told"), [((), True), (("--rendering", "codes"), False)])
def test_generate_tells_a_tint(
    make_lut: MakeLut,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    more: tuple[str, ...],
    told: bool,
) -> None:
    make_lut()
    monkeypatch.chdir(tmp_path)
    assert cv2.imwrite("grey.png", np.full((8, 8, 3), 128, np.uint8))

    def found(_: Lut) -> tuple[float, int]:
        return 4.72, 3

    monkeypatch.setattr("generator.rendering.colorimetric.grey_tint_deg", found)
    assert main(["lut", "out", "--sources", "grey.png", "--no-preview", *more]) == 0
    line = "greys of this print are up to 4.7 degrees off the light (under light 3)"
    assert (line in capsys.readouterr().out) is told
