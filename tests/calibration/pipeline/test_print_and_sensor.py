"""What is said of a managed and an unmanaged print, of uneven primaries on a clean one, and of hot photosites."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibration.pipeline.build import build
from calibration.report.report import summary
from calibration.table.lut import open_lut
from calibration.verdict import judged_values
from drivers.presenter import WHITE, Colour
from sim.spectral import PaperName, ProfileName
from sim.world.rendering import PAPER
from sim.world.world import Room
from tests.calibration.causes.rooms import BRIGHT, Counts, taken
from tests.calibration.lab import LIGHTS, SETTINGS, hang, renumbered, take

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("pinned_builds", "lens_unmeasured")]

LIGHT = renumbered(LIGHTS[5:6])


@pytest.mark.parametrize(
    ("profile", "paper", "least", "most"),
    # A managed print is neutral to the eye under D50; a camera under a projector sees 1 to 2.4 degrees of it.
    [("unmanaged", "glossy", 6.0, 8.5), ("managed", "poster", 0.3, 2.5)],
)
def test_the_tint_of_greys_tells_a_managed_print(
    profile: ProfileName, paper: PaperName, least: float, most: float, tmp_path: Path
) -> None:
    lab = hang(room=Room(waviness_mm=0.5, profile=profile, paper=paper))
    with take(lab, tmp_path / "session", LIGHT) as session:
        result = build(session, tmp_path / "lut")
    assert result.verdict.outcome != "refuse"
    tint = judged_values(result.figures)["grey_tint_deg"]
    assert least < tint < most
    # The figure is the angle that the room's truth has, of the worst level.
    colour = LIGHT[0].colour
    codes = sorted({reference.rgb for reference in lab.chart.references if len(set(reference.rgb)) == 1} - {(255,) * 3})
    greys, white = lab.world.reflected(codes, colour, SETTINGS), lab.world.white(colour, SETTINGS)
    cosine = greys @ white / np.linalg.norm(greys, axis=1) / np.linalg.norm(white)
    assert tint == pytest.approx(float(np.degrees(np.arccos(cosine)).max()), abs=0.1)
    assert "Tint of the greys" in {row.name for row in summary(result.figures)}


def test_uneven_primaries_are_no_dirt_on_the_print(tmp_path: Path) -> None:
    """A cell's field differs from paper's by what it reflects of each primary; its colour is still its code's."""
    lab = hang(room=Room(waviness_mm=0.5, primary_difference=0.3, projector_falloff=0.3, lamp_spectrum="led"))
    with taken(lab, tmp_path / "session") as session:
        stains = build(session, tmp_path / "lut").figures.cells.stains
    codes, places = lab.chart.rgb[lab.chart.cell_of_colour], stains.places_mm
    own = lab.world.seen(codes, places, WHITE, SETTINGS) / lab.world.reflected(codes, WHITE, SETTINGS)
    of_paper = lab.world.seen([PAPER] * len(places), places, WHITE, SETTINGS) / lab.world.white(WHITE, SETTINGS)
    expected = np.log(own / of_paper)
    assert expected.std(axis=0).min() > 0.003
    for channel in range(3):
        there = np.isfinite(stains.alone[:, channel])
        # 1 where cells are evened by the field of paper.
        differs = expected[there, channel] - expected[there, channel].mean()
        assert abs(differs @ stains.alone[there, channel] / (differs @ differs)) < 0.3


def test_hot_photosites_side_by_side_are_no_object(tmp_path: Path) -> None:
    """In two cells that touch, in every frame: under lights these are as far off as what lies there makes them."""
    lab = hang()
    light = next(light for light in BRIGHT if min(light.colour) > 80)
    codes, places = lab.chart.rgb[lab.chart.cell_of_colour], lab.chart.centres_mm[lab.chart.cell_of_colour]
    dark = np.argsort(lab.world.reflected(codes, light.colour, SETTINGS).max(axis=1))[40:160]
    apart = np.linalg.norm(places[dark, None] - places[dark], axis=-1) + 1e3 * np.eye(len(dark))
    pair = dark[np.array(divmod(int(apart.argmin()), len(dark)))]
    at = np.rint(2 * lab.world.project(places[pair]) + 0.5).astype(np.int64) // 2 * 2

    def heat(counts: Counts, colour: Colour) -> None:
        visible = lab.world.body.visible
        for x, y in at:
            # The block's two corners: red and blue.
            counts[visible.top + y, visible.left + x] += 2000
            counts[visible.top + y + 1, visible.left + x + 1] += 2000

    with taken(lab, tmp_path / "session", paint=heat) as session:
        result = build(session, tmp_path / "lut")
    unfit = {cell.colour: cell.cause for cell in result.figures.cells.unfit}
    assert all(unfit[cell].startswith("hot") for cell in pair.tolist())
    assert set(unfit) == set(pair.tolist())
    assert "disturbed_cells" not in {row.figure.name for row in result.verdict.remarks}


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
