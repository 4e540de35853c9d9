"""What the report says of a managed and an unmanaged print, and of a body with hot photosites."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibration.pipeline.build import build
from calibration.report.report import write_report
from calibration.table.lut import open_lut
from calibration.verdict.values import judged_values
from sim.world.profile import ProfileName
from sim.world.room import Room
from sim.world.spectra import PaperName
from tests.calibration.lab import LIGHTS, SETTINGS, hang, renumbered, take

LIGHT = renumbered(LIGHTS[5:6])


@pytest.mark.parametrize(
    ("profile", "paper", "least", "most"),
    # A managed print is neutral to the eye under D50; a camera under a projector sees 1 to 2.4 degrees of it.
    [("unmanaged", "poster", 4.0, 5.0), ("unmanaged", "glossy", 6.0, 8.5), ("managed", "poster", 0.3, 2.5)],
)
def test_the_tint_of_greys_tells_a_managed_print(
    profile: ProfileName, paper: PaperName, least: float, most: float, tmp_path: Path
) -> None:
    lab = hang(room=Room(waviness_mm=0.5, profile=profile, paper=paper))
    with take(lab, tmp_path / "session", LIGHT) as session:
        result = build(session, tmp_path / "lut")
        write_report(result, session, tmp_path)
    assert result.verdict.outcome != "refuse"
    tint = judged_values(result.figures)["grey_tint_deg"]
    assert least < tint < most
    # The figure is the angle that the room's truth has, of the worst level.
    colour = LIGHT[0].colour
    codes = sorted({reference.rgb for reference in lab.chart.references if len(set(reference.rgb)) == 1} - {(255,) * 3})
    greys, white = lab.world.reflected(codes, colour, SETTINGS), lab.world.white(colour, SETTINGS)
    cosine = greys @ white / np.linalg.norm(greys, axis=1) / np.linalg.norm(white)
    assert tint == pytest.approx(float(np.degrees(np.arccos(cosine)).max()), abs=0.1)
    assert "Tint of the greys" in (tmp_path / "report.html").read_text()


def test_hot_photosites_stay_in_the_samples_and_are_told(tmp_path: Path) -> None:
    """120 a million: of 51 000 photosites in samples some six; a full chart has 3 million."""
    lab = hang(room=Room(waviness_mm=0.5, hot_per_million=120.0, hot_dn_per_s=6000.0))
    cool = hang(room=Room(waviness_mm=0.5))
    for name, one in (("hot", lab), ("cool", cool)):
        with take(one, tmp_path / f"{name}-session", LIGHT) as session:
            result = build(session, tmp_path / name)
        assert result.verdict.outcome != "refuse"
        hot_cells = [cell for cell in result.figures.cells.unfit if cell.cause.startswith("hot")]
        assert bool(hot_cells) == (name == "hot")
        assert {cell.cause.split(":")[0] for cell in result.figures.cells.unfit} <= {"hot"}
    hot, cool_samples = (np.asarray(open_lut(tmp_path / name).samples[0], dtype=np.float64) for name in ("hot", "cool"))
    apart = hot - cool_samples
    assert np.abs(apart[np.abs(apart) > 100]).size == (apart > 100).sum() > 0, "heat only adds"
    # Each excess is that of a photosite of the room; of green, half of it, as a sample is the mean of two.
    known = SETTINGS.shutter_s * lab.world.hot.dn_per_s
    known = np.concatenate([known, known / 2])
    for excess in apart[apart > 300]:
        assert np.abs(known - excess).min() < 0.15 * excess + 60
