"""From a session to a table, against the light that the simulated room really had."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from calibration.citation import exposure_text
from calibration.cli import main
from calibration.figures.figure import QUESTIONS
from calibration.pipeline.build import build, check
from calibration.report.report import summary
from calibration.table.lut import Lut, open_lut
from calibration.verdict import BuildResult
from drivers.camera import ExposureSettings
from drivers.presenter import BLACK, WHITE
from experiment.chart.model import Chart
from experiment.measures.least_squares import order_of, page_polynomial
from experiment.session.folder import Session
from experiment.session.records import SessionStep, plan_steps
from foundation.errors import FormatError, InputError, QualityError
from sim.world.world import Room
from tests.calibration.lab import LIGHTS, SETTINGS, Lab, hang, renumbered, take
from tests.calibration.whole import LIMITS, reported, told, whole, written
from tests.json_of import json_of
from tests.pinned import Pinned

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("pinned_builds", "undrawn")]


def angle_deg(one: npt.NDArray[np.float64], other: npt.NDArray[np.float64]) -> float:
    cosine = one @ other / np.linalg.norm(one) / np.linalg.norm(other)
    return float(np.degrees(np.arccos(min(1.0, float(cosine)))))


def codes(chart: Chart) -> npt.NDArray[np.uint8]:
    """Return the printed codes in the order of colour indices."""
    return chart.rgb[chart.cell_of_colour]


@pytest.fixture(scope="module")
def table(built: BuildResult) -> Lut:
    assert built.lut is not None
    return open_lut(built.lut)


def test_the_table_has_a_place_for_every_light_colour_and_sample(table: Lut, lab: Lab) -> None:
    assert table.samples.shape == (len(LIGHTS), 512, 25, 3)
    assert table.illuminations == LIGHTS
    assert table.provenance.bits == 3
    assert table.provenance.camera == "Canon CroP Test"
    assert table.provenance.chart_sha256 == lab.chart.sha256
    assert table.provenance.software.startswith("croplab ")
    assert table.provenance.white_level == pytest.approx(lab.world.body.saturation - lab.world.body.black, abs=1)


def test_the_ground_truth_is_the_light(table: Lut, lab: Lab) -> None:
    errors = [
        angle_deg(table.white[light.index], lab.world.white(light.colour, SETTINGS)) for light in table.illuminations
    ]
    assert np.median(errors) <= 0.2
    assert max(errors) <= 0.5


def test_every_colour_is_the_paper_s_under_every_light(table: Lut, lab: Lab) -> None:
    for light in table.illuminations:
        white = lab.world.white(light.colour, SETTINGS)
        true = lab.world.reflected(codes(lab.chart), light.colour, SETTINGS) / white
        mean = table.samples[light.index].mean(axis=1) / table.white[light.index]
        error = mean - true
        # Noise of the mean of 25 samples, on top of the field's half percent.
        signal = true * white
        noise = np.sqrt(signal / lab.world.body.electrons_per_dn + lab.world.body.read_noise_dn**2) / 5 / white
        assert (np.abs(error) < 5 * noise + 0.01 * true + 0.002).all()
        assert np.abs(error.mean(axis=0)).max() < 0.003


def test_samples_have_the_noise_of_the_sensor(table: Lut, lab: Lab) -> None:
    """Interpolated samples would have less."""
    light = next(light for light in LIGHTS if light.colour == WHITE)
    samples = table.samples[light.index].astype(np.float64)
    signal = samples.mean(axis=1)
    body = lab.world.body
    for channel, photosites in ((0, 1), (1, 2), (2, 1)):
        spread = samples[..., channel].var(axis=1, ddof=1)
        response = (lab.world.room.response_spread * signal[:, channel]) ** 2
        expected = (signal[:, channel] / body.electrons_per_dn + body.read_noise_dn**2 + response) / photosites
        assert np.median(spread / expected) == pytest.approx(1, abs=0.12)


def test_nothing_is_unfit_in_a_healthy_session(built: BuildResult) -> None:
    assert len(built.figures.cells.unfit) <= 2
    assert built.figures.black_drift < 1
    assert built.figures.largest_shift_px < 0.02
    assert not any(figures.reregistered for figures in built.figures.frames)


def test_the_field_can_be_undone(table: Lut, built: BuildResult, session: Session, lab: Lab) -> None:
    """Multiplied by the field of `lut.json`, the table gives the counts of the frame again."""
    done = {correction["name"]: correction for correction in table.provenance.corrections}
    assert list(done) == ["black", "half size", "saturation", "field", "rounding", "drift", "primaries"]
    assert len(done["field"]["per_light"]) == len(done["black"]["per_light"]) == len(LIGHTS)
    figures = next(f for f in built.figures.frames if f.record.illumination == 5)
    field = figures.paper.field.at(lab.chart.centres_mm[lab.chart.cell_of_colour])
    assert field.mean(axis=0) == pytest.approx(1, abs=1e-6)
    assert field.std() > 0.03
    white = lab.world.reflected(codes(lab.chart), LIGHTS[5].colour, SETTINGS)
    raw = table.samples[5].mean(axis=1) * field
    assert (
        np.corrcoef(raw[:, 1], white[:, 1])[0, 1] < np.corrcoef(table.samples[5].mean(axis=1)[:, 1], white[:, 1])[0, 1]
    )


def test_the_primaries_correction_can_be_undone(table: Lut, built: BuildResult, lab: Lab) -> None:
    """What `lut.json` records of it, and the table's own samples of the primaries, give the factor of every cell."""
    recorded = next(done for done in table.provenance.corrections if done["name"] == "primaries")
    assert built.figures.primaries is not None
    places = lab.chart.centres_mm[lab.chart.cell_of_colour]
    fields = [
        np.prod([page_polynomial(places, lab.chart.page_mm, order_of(len(f))) @ np.array(f) for f in factors], axis=0)
        for factors in recorded["field"]
    ]
    alone = [table.samples[light].mean(axis=1) for light in recorded["lights"]]
    for light, amounts in enumerate(recorded["per_light"]):
        parts = [amount * cells for amount, cells in zip(amounts, alone, strict=True)]
        paper = [amount * np.array(white) for amount, white in zip(amounts, recorded["paper"], strict=True)]
        cell = np.sum([f[:, None] * part for f, part in zip(fields, parts, strict=True)], axis=0) / np.sum(
            parts, axis=0
        )
        plain = np.sum([f[:, None] * white for f, white in zip(fields, paper, strict=True)], axis=0)
        plain /= np.sum(paper, axis=0)
        lit = np.sum(parts, axis=0) > 50
        factor = built.figures.primaries.field_ratio(table.white[light])
        assert (cell / plain)[lit] == pytest.approx(factor[lit], abs=1e-4)


def test_dark_frames_show_the_projector_s_black(built: BuildResult, lab: Lab) -> None:
    true = lab.world.white(BLACK, SETTINGS) / lab.world.white(WHITE, SETTINGS)
    white = next(figures.paper.white for figures in built.figures.frames if figures.record.kind == "white")
    dark = built.figures.dark_frames
    assert (dark.light > 2).all()
    assert (np.abs(dark.light / white - true) < 4 * dark.error / white + 0.02 * true).all()
    assert len(dark.files) >= 2
    assert not dark.hottest.any()


def test_the_simulated_projector_s_light_adds(built: BuildResult) -> None:
    assert built.figures.lights.additivity is not None
    assert np.abs(built.figures.lights.additivity.off).max() < 0.006


def test_every_level_of_grey_is_the_print_s(built: BuildResult, lab: Lab, table: Lut) -> None:
    greys = built.figures.greys
    codes = sorted({reference.rgb for reference in lab.chart.references if not reference.is_white}, reverse=True)
    assert len(codes) == len(greys.names) >= 2
    for light in table.illuminations:
        true = lab.world.reflected(codes, light.colour, SETTINGS) / lab.world.white(light.colour, SETTINGS)
        seen, error = (values[light.index] / table.white[light.index] for values in (greys.values, greys.errors))
        assert (np.abs(seen - true) < 5 * error + 0.006 * true).all()
    assert built.lut is not None
    lines = (built.lut / "references.csv").read_text().splitlines()
    assert lines[0] == "light,name,r,g,b,r_error,g_error,b_error"
    assert len(lines) == 1 + len(LIGHTS) * (1 + len(codes))


def test_the_noise_curve_is_the_sensor_s(built: BuildResult, lab: Lab) -> None:
    body = lab.world.body
    assert built.figures.sensor.transfer.gain_e == pytest.approx(body.electrons_per_dn * np.array([1, 2, 1]), rel=0.2)
    assert built.figures.sensor.transfer.noisy.sum() <= 1


@pytest.mark.usefixtures("lens_unmeasured")
def test_a_hot_and_a_dead_photosite_are_named(lab: Lab, tmp_path: Path) -> None:
    visible, chart = lab.world.body.visible, lab.chart
    rgb = codes(chart)
    hot, dead = 100, int(np.argmax((rgb.min(axis=1) > 150) & (rgb.max(axis=1) < 255)))

    def frame(step: SessionStep) -> bytes:
        def paint(counts: npt.NDArray[np.uint16]) -> None:
            places = np.rint(lab.world.project(chart.centres_mm[chart.cell_of_colour[[hot, dead]]])).astype(int)
            rows, columns = visible.top + 2 * places[:, 1], visible.left + 2 * places[:, 0]
            counts[rows[0], columns[0]] += 300
            counts[rows[1], columns[1]] = 2048

        return lab.dng(step.colour, step.number, paint=paint)

    with take(lab, tmp_path / "session", renumbered(LIGHTS[5:6]), frame=frame) as session:
        result = build(session, tmp_path / "lut")
    unfit = {cell.colour: cell.cause for cell in result.figures.cells.unfit}
    assert unfit[hot].startswith("hot: a photosite stands out by ")
    assert unfit[dead].startswith("dead: ")
    assert len(unfit) <= 4


@pytest.mark.usefixtures("lens_unmeasured")
def test_a_lamp_that_fades_is_reported_and_not_corrected(lab: Lab, tmp_path: Path) -> None:
    """3 % over the session: each light keeps its own ground truth, and the gain brings them to one lamp."""
    lights = LIGHTS[:6]
    steps = len(plan_steps(lights, 2))

    def frame(step: SessionStep) -> bytes:
        return lab.dng(step.colour, step.number, lamp=1 - 0.03 * step.number / (steps - 1))

    with take(lab, tmp_path / "session", lights, every=2, frame=frame) as session:
        result = build(session, tmp_path / "lut")
    assert result.figures.white_drift == pytest.approx(0.03, abs=0.002)
    assert "white_drift" in {row.figure.name for row in result.verdict.remarks}
    table = open_lut(tmp_path / "lut")
    drift = next(correction for correction in table.provenance.corrections if correction["name"] == "drift")
    assert drift["applied"] is False
    undone = table.white / np.array(drift["per_light"])
    true = np.array([lab.world.white(light.colour, SETTINGS) for light in lights])
    lit = true > 300
    # The table's level is that of the mean over the cells, the room's that of the brightest point.
    assert np.ptp((undone / true)[lit]) < 0.008
    assert np.ptp((table.white / true)[lit]) > 0.015


def test_the_report_stands_alone(built: BuildResult) -> None:
    assert built.lut is not None
    page = (built.lut / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 8
    # Verdict, what to do, and the four pictures to look at first stand before everything that is folded.
    heads = re.findall(r"<h2>([^<]+)</h2>", page[: page.index("<details")])
    assert [head for head in heads if head not in ("Probable causes",) and not head.startswith("Where it is")] == [
        "What to do", "The chart as registered", "The lights", "Where cells err", "The noise", "All figures",
    ]  # fmt: skip
    assert page.index("class='verdict ") < page.index("What to do")
    assert re.findall(r"<details id='(\w+)'", page) == [*QUESTIONS, "origin"]
    assert re.search(r"(src|href)='?http", page) is None
    for row in summary(built.figures):
        assert row.name in html.unescape(page)
    # A group with something beyond its limit is not folded, all others are.
    beyond = {row.figure.group for row in built.verdict.rows if row.outcome != "accept"}
    assert set(re.findall(r"<details id='(\w+)' open", page)) == beyond
    exposure = exposure_text(built.figures.origin)
    assert f"<th scope='row'>Exposure</th><td>{exposure}</td>" in html.unescape(page)
    # A figure leads to the picture that shows it.
    pictures = set(re.findall(r"<div id='(\w+)'", page))
    assert {"chart", "lights", "errors", "noise"} < pictures
    assert pictures >= set(re.findall(r"href='#(\w+)'", page)) >= {"residuals", "course", "budget"}


def test_the_summary_gives_figures_in_their_units(built: BuildResult) -> None:
    rows = {row.name: row for row in summary(built.figures)}
    # What the command prints, in this order.
    assert [name for name, row in rows.items() if row.brief] == [
        "Tags found", "Residual of cell blocks", "Correlation with the chart", "Movement of the chart",
        "Drift of white", "Uncertainty of the ground truth", "Cells unfit for use",
    ]  # fmt: skip
    figures, percent = built.figures, "{:.2f} %".format
    assert rows["Lights"].value == str(len(LIGHTS))
    assert rows["Tags found"].value == "4 of 4"
    assert rows["Shorter side of a cell"].value == f"{figures.registration.cell_px:.1f} px"
    assert rows["Movement of the chart"].value == f"{figures.largest_shift_px:.3f} px at most"
    assert rows["Drift of white"].value == percent(100 * figures.white_drift)
    black = np.mean([frame.black.mean() for frame in figures.frames])
    assert rows["Black level"].value == f"{black:.2f} counts"
    strongest = figures.lights.white.max(axis=1)
    assert rows["Darkest light"].value == f"{strongest.min():.0f} counts"
    told = rows["Light while the projector shows black"].value
    dark = [float(value) for value in re.findall(r"\d\.\d\d", told)]
    white = next(frame.paper.white for frame in figures.frames if frame.record.kind == "white")
    assert dark[:3] == pytest.approx(figures.dark_frames.light, abs=0.006)
    assert dark[3:] == pytest.approx(100 * figures.dark_frames.light / white, abs=0.006)


def test_the_whole_table_is_what_it_was(built: BuildResult, session: Session, pinned: Pinned) -> None:
    assert built.lut is not None
    pinned("table of 13 lights, measured", whole(built), **LIMITS)
    pinned("table of 13 lights, files", written(built.lut), **LIMITS)
    pinned("table of 13 lights, report", [reported(built)], **LIMITS)


def test_a_check_measures_what_it_did_and_writes_nothing(session: Session, pinned: Pinned) -> None:
    before = sorted(session.folder.rglob("*"))
    result = check(session)
    pinned("check of 13 lights", told(result), **LIMITS)
    assert result.lut is None
    assert result.figures.session.registered_file == "frames/0000_white.dng"
    assert sorted(session.folder.rglob("*")) == before


def small(lab: Lab, folder: Path, count: int = 2) -> Session:
    return take(lab, folder, LIGHTS[:count])


def test_a_light_without_an_accepted_frame_is_named(lab: Lab, tmp_path: Path) -> None:
    session = take(
        lab,
        tmp_path / "session",
        LIGHTS[:3],
        verdict=lambda step: "refused" if step.illumination == 1 else "accepted",
    )
    with session, pytest.raises(FormatError, match=r"1 of 3 lights .*: 1;"):
        build(session, tmp_path / "lut")
    assert not (tmp_path / "lut").exists()
    assert list(tmp_path.iterdir()) == [tmp_path / "session"]


@pytest.mark.parametrize(("change", "said"), [("gone", "is missing"), ("altered", "is not the file that was taken")])
def test_a_frame_that_is_not_as_taken_is_named(lab: Lab, tmp_path: Path, change: str, said: str) -> None:
    with small(lab, tmp_path / "session") as session:
        path = session.folder / "frames/0003_light_001.dng"
        data = bytearray(path.read_bytes())
        data[-1000] ^= 1
        path.unlink()
        if change == "altered":
            path.write_bytes(data)
        with pytest.raises(FormatError, match=rf"0003_light_001\.dng {said}"):
            build(session, tmp_path / "lut")
    assert not (tmp_path / "lut").exists()


@pytest.mark.usefixtures("lens_unmeasured")
def test_a_bump_in_the_night_is_followed(lab: Lab, tmp_path: Path) -> None:
    bumped = hang(room=Room(waviness_mm=0.5, roll_deg=0.7, fill=0.935))
    lights = renumbered(LIGHTS[4:8])

    def frame(step: SessionStep) -> bytes:
        return (bumped if step.number >= 4 else lab).dng(step.colour, step.number)

    with take(lab, tmp_path / "session", lights, frame=frame) as session:
        result = build(session, tmp_path / "lut")
    anew = [figures.record.illumination for figures in result.figures.frames if figures.reregistered]
    assert anew == [2]
    table = open_lut(tmp_path / "lut")
    for light in lights:
        white = lab.world.white(light.colour, SETTINGS)
        true = lab.world.reflected(codes(lab.chart), light.colour, SETTINGS) / white
        mean = table.samples[light.index].mean(axis=1) / table.white[light.index]
        # A grid that had stayed behind would read neighbours here and there.
        assert np.abs(mean - true)[:, 1].max() < 0.05


@pytest.mark.usefixtures("lens_unmeasured")
def test_a_small_movement_is_followed_without_registering_anew(lab: Lab, tmp_path: Path) -> None:
    lights = renumbered(LIGHTS[4:6])

    def frame(step: SessionStep) -> bytes:
        def move(counts: npt.NDArray[np.uint16]) -> None:
            if step.kind == "light":
                # A picture mixed with itself one half-size pixel to the right lies a share of a pixel to the right.
                counts[:] = (0.8 * counts + 0.2 * np.roll(counts, 2, axis=1)).astype(np.uint16)

        return lab.dng(step.colour, step.number, paint=move)

    with take(lab, tmp_path / "session", lights, frame=frame) as session:
        result = build(session, tmp_path / "lut")
    moved = [figures.shift.dx for figures in result.figures.frames if figures.record.kind == "light"]
    assert moved == pytest.approx([0.17, 0.17], abs=0.05)
    assert not any(figures.reregistered for figures in result.figures.frames)


def test_a_table_s_folder_that_is_taken_is_left_alone(session: Session, tmp_path: Path) -> None:
    (tmp_path / "lut").mkdir()
    (tmp_path / "lut" / "precious").write_text("x")
    with pytest.raises(InputError, match="already exists"):
        build(session, tmp_path / "lut")
    assert (tmp_path / "lut" / "precious").read_text() == "x"


def test_an_overexposed_session_builds_no_table(lab: Lab, tmp_path: Path) -> None:
    bright = ExposureSettings(100, 8.0, 1.2)
    session = take(lab, tmp_path / "session", LIGHTS[:2], frame=lambda step: lab.dng(step.colour, step.number, bright))
    with session, pytest.raises(QualityError):
        build(session, tmp_path / "lut")


@pytest.mark.usefixtures("lens_unmeasured")
def test_cells_that_cannot_be_used_are_listed_with_their_cause(lab: Lab, tmp_path: Path) -> None:
    lights = renumbered(LIGHTS[5:6])
    visible, chart = lab.world.body.visible, lab.chart
    clipped, dusty = int(chart.cell_of_colour[100]), int(chart.cell_of_colour[300])

    def frame(step: SessionStep) -> bytes:
        def paint(counts: npt.NDArray[np.uint16]) -> None:
            places = np.rint(lab.world.project(chart.centres_mm[[clipped, dusty]])).astype(int)
            rows, columns = visible.top + 2 * places[:, 1], visible.left + 2 * places[:, 0]
            if step.kind == "light":
                counts[rows[0], columns[0]] = lab.world.body.saturation
            elif step.kind == "white":
                counts[rows[1] - 4 : rows[1] - 2, columns[1] - 4 : columns[1] + 5] += 2500

        return lab.dng(step.colour, step.number, paint=paint)

    with take(lab, tmp_path / "session", lights, frame=frame) as session:
        build(session, tmp_path / "lut")
    unfit = {cell.colour: cell.cause for cell in open_lut(tmp_path / "lut").provenance.unfit}
    assert unfit[100].startswith("clipped: 13584 counts under light 0")
    assert unfit[300].startswith("uneven: rim and middle differ by")
    assert len(unfit) <= 3


@pytest.mark.usefixtures("lens_unmeasured")
def test_cells_under_a_cover_are_listed(lab: Lab, tmp_path: Path) -> None:
    visible = lab.world.body.visible
    corner = np.array([220, 130])

    def frame(step: SessionStep) -> bytes:
        def cover(counts: npt.NDArray[np.uint16]) -> None:
            top, left = visible.top + 2 * int(corner[1]), visible.left + 2 * int(corner[0])
            counts[top : top + 110, left : left + 110] = 2300

        return lab.dng(step.colour, step.number, paint=cover)

    with take(lab, tmp_path / "session", renumbered(LIGHTS[5:6]), frame=frame) as session:
        result = check(session)
    covered = [cell.colour for cell in result.figures.cells.unfit if cell.cause.startswith("covered")]
    under = lab.world.project(lab.chart.centres_mm)[lab.chart.cell_of_colour[covered]] - corner
    assert 15 <= len(covered) <= 100
    assert ((under > -45) & (under < 100)).all()


def test_the_command_builds_and_reports(session: Session, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(session.folder), str(tmp_path / "lut")]) == 0
    printed = capsys.readouterr().out
    assert "Residual of cell blocks" in printed
    assert f"{len(LIGHTS)} lights, Canon CroP Test" in printed
    assert json.loads((tmp_path / "lut" / "lut.json").read_text())["format"] == "crop.lut"
    assert (tmp_path / "lut" / "report.html").exists()


def test_the_command_checks(session: Session, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(session.folder)]) == 0
    assert "the others take all frames" in capsys.readouterr().out
    found = json_of(main, ["check", session.folder], capsys)
    assert (found["command"], found["format"]) == ("build-lut check", "crop.report")
    assert found["figures"]
