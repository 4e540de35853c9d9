"""What is computed without a room: tilt, noise, supplies, stains of few references, and the light of few."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt
import pytest

from acquisition.check import check
from acquisition.check.camera import (
    BlurMap,
    fit_transfer,
    judge_clipping,
    judge_disk,
    judge_hot,
    judge_noise_reduction,
    judge_sharpness,
    judge_supplies,
    judge_tilt,
    judge_turn,
    pair_noise,
    series_times,
)
from acquisition.check.findings import Finding
from acquisition.check.frames import stated_focal_px
from acquisition.check.light_and_print import AREAS, area_name, areas_of, judge_flicker, judge_primaries, measure_light
from acquisition.check.places import ChartMap, Levels
from calibration.sampling import bleed
from drivers.camera import CameraIdentity, CapturedFrame, ExposureSettings, Supplies
from drivers.raw.rawfile import Mosaic, Plane
from drivers.raw.storage import Area
from drivers.tiff import TiffTag, ValueType, head, rationals
from experiment.chart.layout import design_chart
from experiment.framing.finding import Framing
from foundation.errors import LinkTimeout

WIDTH, HEIGHT = 420, 280
"""Of a made-up frame, half-size pixels; its chart is a page of as many half millimetres, square to it."""
PAGE = design_chart(2, (210.0, 140.0))
SQUARE = np.diag([2.0, 2.0, 1.0])


def framing(homography: npt.NDArray[np.float64] = SQUARE, rotation_deg: float = 0.0) -> Framing:
    plane = Plane("G", np.zeros((HEIGHT, WIDTH), dtype=np.float32), (0.0, 0.0))
    return Framing(plane, (), (), homography, 0.0, 6.0, 1.0, True, rotation_deg)


def mosaic(counts: npt.NDArray[np.uint16]) -> Mosaic:
    area = Area(0, 0, *counts.shape)
    return Mosaic(counts, "RGGB", np.full((2, 2), 2048.0), 15831, "a camera", counts, area, ())


@pytest.mark.parametrize(
    ("pan", "tilt", "nearer"),
    [(0.0, 0.0, ""), (8.0, 0.0, "right nearer"), (0.0, -6.0, "top nearer"), (-9.0, 5.0, "left and bottom nearer")],
)
def test_tilt_is_read_from_a_homography_about_the_middle_of_the_frame(pan: float, tilt: float, nearer: str) -> None:
    focal, centre = 600.0, ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    normal = np.array([np.tan(np.radians(pan)), np.tan(np.radians(tilt)), 1.0])
    z = normal / np.linalg.norm(normal)
    x = np.cross([0, 1, 0], z)
    x /= np.linalg.norm(x)
    camera = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
    homography = camera @ np.column_stack([x, np.cross(z, x), [-105.0, -70.0, 600.0]])
    found = judge_tilt(framing(homography / homography[2, 2]), PAGE, focal)
    assert (found.details["pan_deg"], found.details["tilt_deg"]) == pytest.approx((pan, tilt), abs=1e-6)
    assert nearer in found.said


@pytest.mark.parametrize(
    ("rotation_deg", "said", "off", "grade"),
    [(-5.0, "upright", -5.0, "good"), (5.1, "upright", 5.1, "remark"), (91.0, "90° clockwise", 1.0, "remark"),
     (-92.0, "90° counter-clockwise", -2.0, "remark"), (180.0, "upside down", 0.0, "remark")],
)  # fmt: skip
def test_quarter_turns_are_named(rotation_deg: float, said: str, off: float, grade: str) -> None:
    found = judge_turn(framing(rotation_deg=rotation_deg))
    assert (found.value, found.grade) == (pytest.approx(off), grade)
    assert said in found.said


def test_blur_is_judged_by_what_it_does_to_cells_of_their_size() -> None:
    def seen(sigma_px: float, cell_px: float) -> Finding:
        # One corner is softer by a third of a pixel.
        places = PAGE.centres_mm
        corner = (places > np.array([0.8, 2 / 3]) * PAGE.page_mm).all(axis=1)
        return judge_sharpness(BlurMap(places, np.where(corner, sigma_px + 0.33, sigma_px)), PAGE, 4.0, cell_px)

    soft, same, corner = seen(1.05, 10.0), seen(1.05, 15.0), seen(0.75, 10.0)
    assert (soft.grade, same.grade, corner.grade) == ("fault", "good", "remark")
    assert soft.value == pytest.approx(bleed(10.0, 1.38))
    assert soft.details["median_bleed"] == pytest.approx(bleed(10.0, 1.05))
    assert "the bottom far right is farther out of focus" in soft.remedy
    assert judge_sharpness(BlurMap(PAGE.centres_mm, np.ones(64)), PAGE, 1.0, 10.0).grade == "not checked"


@pytest.mark.slow
def test_the_place_of_clipped_photosites_is_named_and_the_run_s_limit_is_the_fault_s() -> None:
    place = ChartMap(PAGE.page_mm, SQUARE, np.zeros((1, 2)), np.zeros((1, 1, 2)), 1.0)
    rows, columns = AREAS
    counts = np.full((2 * HEIGHT, 2 * WIDTH), 9000, dtype=np.uint16)
    for number in range(rows * columns):
        counts[:] = 9000
        row, column = divmod(number, columns)
        # Near the area's last corner, and a few photosites near the frame's first.
        bottom, right = 2 * HEIGHT * (row + 1) // rows, 2 * WIDTH * (column + 1) // columns
        counts[bottom - 20 : bottom - 8, right - 20 : right - 8] = 13584
        counts[8:10, 8:10] = 13584
        found = judge_clipping(mosaic(counts), 0.5, 13584.0, 0.1, place)
        assert f"most of them at {area_name(number)} of the chart" in found.said
        assert found.value == pytest.approx(148 / counts.size)
    share = 100 * 148 / (4 * WIDTH * HEIGHT)
    grades = [judge_clipping(mosaic(counts), 0.5, 13584.0, limit, None).grade for limit in (0.99 * share, 1.01 * share)]
    assert grades == ["fault", "remark"]


def test_hot_photosites_are_counted() -> None:
    random = np.random.default_rng(2)
    dark = np.rint(2048 + 4 * random.standard_normal((600, 800))).astype(np.uint16)
    dark[25::50, 30::80] += 60
    # Lit unevenly: what leaks of it is taken off before anything stands out.
    white = np.full_like(dark, 9000)
    white[:, ::4] = white[:, 1::4] = 1000
    for share in (0.0, 0.01):
        lit = np.rint(dark + share * white).astype(np.uint16)
        found = judge_hot(mosaic(lit), share, mosaic(white))
        assert found.details["count"] == 12 * 10
        assert found.value == pytest.approx(120e6 / dark.size)


def test_the_noise_of_a_pair_is_that_of_single_photosites() -> None:
    random = np.random.default_rng(6)
    one, other = (
        mosaic(np.rint(6048 + 20 * random.standard_normal((2 * HEIGHT, 2 * WIDTH))).astype(np.uint16)) for _ in range(2)
    )
    place = ChartMap(PAGE.page_mm, SQUARE, np.zeros((1, 2)), np.zeros((1, 1, 2)), 1.0)
    points = np.stack(np.meshgrid(np.arange(3.0, 207, 2.5), np.arange(3.0, 137, 2.5)), axis=-1).reshape(-1, 2)
    level, variance = pair_noise(one, other, place, points)
    np.testing.assert_allclose(level.mean(axis=0), 4000, atol=1)
    # 25 samples of each of 4 400 windows; rounding adds a twelfth.
    np.testing.assert_allclose(variance.mean(axis=0), 400 + 1 / 12, rtol=0.02)


def test_the_run_s_own_limit_makes_the_room_s_light_a_fault() -> None:
    refuses = check._as_the_run_refuses
    seen = Finding("room light", "remark", "seen", 0.03)
    assert [refuses(seen, percent).grade for percent in (2.9, 3.1)] == ["fault", "remark"]
    assert refuses(seen, 2.9).tolerable == (None, pytest.approx(0.029))
    assert refuses(replace(seen, grade="good"), 2.9).grade == "good"
    unknown = replace(seen, value=None, grade="not checked")
    assert refuses(unknown, 2.9) == unknown


@pytest.mark.parametrize(
    ("mm", "unit", "density", "focal_px"),
    [
        (35.0, 2, 5728.1, 5728.1 * 35 / 25.4 / 2),
        (35.0, 3, 2255.2, 2255.2 * 35 / 10 / 2),
        (35.0, 4, 225.5, 225.5 * 35 / 2),
        (0.0, 2, 5728.1, None),
        (5000.0, 2, 5728.1, None),
    ],
    ids=["inch", "centimetre", "millimetre", "without contacts", "no lens is so long"],
)
def test_the_focal_length_is_read_from_exif(
    tmp_path: Path, mm: float, unit: int, density: float, focal_px: float | None
) -> None:
    exif = {
        TiffTag.FOCAL_LENGTH: rationals(mm),
        TiffTag.FOCAL_PLANE_X_RESOLUTION: rationals(density),
        TiffTag.FOCAL_PLANE_RESOLUTION_UNIT: (ValueType.SHORT, [unit]),
    }
    path = tmp_path / "frame.dng"
    path.write_bytes(head({TiffTag.IMAGE_WIDTH: (ValueType.LONG, [5184])}, 0, exif))
    assert stated_focal_px(path, 5184) == (None if focal_px is None else pytest.approx(focal_px))


def test_the_transfer_of_a_sensor_is_read_from_variances() -> None:
    random = np.random.default_rng(3)
    level = random.uniform(50, 10_000, (4000, 3))
    expected = 6.0**2 + level / 1.8
    variance = expected * random.chisquare(24, level.shape) / 24
    # Hot photosites and dust spoil a few windows.
    variance[:40] *= 50
    found = fit_transfer(level, variance)
    assert found.gain_e == pytest.approx(1.8, rel=0.05)
    assert found.read_noise == pytest.approx(6.0, rel=0.25)
    assert np.isnan(fit_transfer(np.zeros((0, 3)), np.zeros((0, 3))).gain_e).all()


def test_a_series_goes_from_dim_to_nearly_saturated() -> None:
    times = series_times([0.01 * k for k in range(1, 200)], 0.5, 0.7)
    assert len(times) == 8
    assert 0.7 * times[0] / 0.5 == pytest.approx(0.06, abs=0.02)
    assert 0.7 * times[-1] / 0.5 == pytest.approx(0.94, abs=0.02)
    assert series_times([10.0], 0.5, 0.7) == []


def test_a_body_that_takes_dark_frames_of_its_own_is_told() -> None:
    def found(longest: float, took: float) -> Finding:
        return judge_noise_reduction([(0.5, 2.5), (longest, took), (0.5, 2.7), (0.5, 2.6), (2.0, 9.0)])

    # Beside 0.5 s, 2.1 s more; beside 4 s the same, or 4 s more than that; half of it is let pass.
    assert found(4.0, 6.1).value == pytest.approx(0.0)
    doubled = found(4.0, 10.1)
    assert (doubled.value, doubled.grade) == (pytest.approx(4.0 / 3.5), "remark")
    assert [found(4.0, 6.1 + 3.5 * share).grade for share in (0.49, 0.51)] == ["good", "remark"]
    for few in ([], [(0.1, 2.0), (0.99, 4.0)], [(0.51, 2.0), (2.0, 4.0)]):
        assert judge_noise_reduction(few).grade == "not checked"
    assert judge_noise_reduction([(0.25, 2.0), (1.0, 4.0)]).grade == "remark"


def test_a_full_picture_that_is_dimmed_is_told() -> None:
    white = np.array([3000.0, 7000.0, 4000.0])
    black = np.array([3.0, 7.0, 4.0])
    levels = {"white": white, "black": black, "red": np.array([2400.0, 700, 40]), "green": np.array([500.0, 6000, 400])}
    good = judge_primaries({**levels, "blue": white + 2 * black - levels["red"] - levels["green"]}, plan_has=True)
    assert [found.grade for found in good] == ["good", "good"]
    bright = judge_primaries({**levels, "blue": np.array([100.0, 300.0, 4400.0])}, plan_has=True)
    assert [found.grade for found in bright] == ["remark", "remark"]
    assert "blue comes nearest to white, with 110 %" in bright[0].said


def test_flicker_has_limits() -> None:
    white = np.array([3000.0, 7000.0, 4000.0])
    random = np.random.default_rng(4)

    def grade(spread: float) -> str:
        ratios = random.standard_normal(6)
        ratios = (ratios - ratios.mean()) / ratios.std(ddof=1) * spread
        return judge_flicker([white * (1 + ratio, 1, 1) for ratio in ratios], 0.5)[0].grade

    assert [grade(spread) for spread in (0.0015, 0.0024, 0.02, 0.2)] == ["good", "good", "remark", "fault"]


def test_the_disk_is_asked_where_the_session_will_be(tmp_path: Path) -> None:
    there = judge_disk(tmp_path / "not" / "yet", 10, 1000)
    assert there.grade == "good"
    assert str(tmp_path) in there.said
    assert judge_disk(tmp_path, 10**9, 25_000_000).grade == "fault"


@dataclass
class Body:
    """A camera of which only the supplies are asked."""

    left: Supplies | None

    def identity(self) -> CameraIdentity:
        return CameraIdentity("A", "B", "1")

    def configure(self, settings: ExposureSettings) -> None:
        raise NotImplementedError

    def shutter_speeds(self) -> tuple[float, ...]:
        return ()

    def expose(self) -> datetime:
        return datetime.now(UTC)

    def download(self, into: BinaryIO) -> CapturedFrame:
        raise NotImplementedError

    def close(self) -> None:
        pass

    def supplies(self) -> Supplies:
        if self.left is None:
            raise LinkTimeout("the camera does not answer")
        return self.left


@pytest.mark.parametrize(
    ("left", "frames", "battery", "card"),
    [
        (Supplies(), 767, "not checked", "good"),
        (Supplies(battery=1.0), 767, "not checked", "good"),
        (Supplies(battery=1.0, mains=False), 767, "remark", "good"),
        (Supplies(battery=0.75), 767, "remark", "good"),
        (Supplies(battery=0.25, mains=False), 767, "fault", "good"),
        (Supplies(battery=0.25, mains=True), 767, "good", "good"),
        (Supplies(saves_to_host=False), 767, "not checked", "not checked"),
        (Supplies(saves_to_host=False, card_free_bytes=10**11), 767, "not checked", "good"),
        (Supplies(saves_to_host=False, card_free_bytes=1000 * 10**6), 767, "not checked", "fault"),
        (Supplies(battery=0.75), 100, "good", "good"),
        (None, 767, "not checked", "not checked"),
    ],
)
def test_battery_and_card_are_judged_as_far_as_the_body_tells(
    left: Supplies | None, frames: int, battery: str, card: str
) -> None:
    assert [found.grade for found in judge_supplies(Body(left), frames, 25 * 10**6)] == [battery, card]


@pytest.mark.slow
@pytest.mark.parametrize(("bits", "few"), [(2, True), (5, False)])
def test_light_is_read_from_few_references_and_from_many(bits: int, few: bool) -> None:
    chart = design_chart(bits)
    places = np.array([reference.centre_mm for reference in chart.references])
    codes = np.array([reference.rgb[0] for reference in chart.references]) / 255
    half = np.hypot(*chart.page_mm) / 2

    def light(
        points: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
    ) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        r = np.linalg.norm(points - np.array(chart.page_mm) / 2, axis=-1) / half
        return np.asarray((1 - 0.4 * r**2)[..., None] * np.ones(3))

    seen = 7000 * codes[:, None] ** 2.2 * light(places)
    # A stain on two references moves nothing.
    seen[3:5] *= 0.5
    found = measure_light(chart, Levels(seen, np.zeros(len(seen), dtype=np.bool_)))
    assert found is not None
    expected = light(chart.centres_mm)
    error = found.at(chart.centres_mm) / (expected / expected.mean(axis=0)) - 1
    assert np.abs(error).max() < (0.04 if few else 0.005)
    without = replace(chart, references=chart.references[:3])
    assert measure_light(without, Levels(seen[:3], np.zeros(3, dtype=np.bool_))) is None


def test_areas_are_numbered_row_by_row_and_each_has_a_name_of_its_own() -> None:
    chart = design_chart(3, "A7")
    rows, columns = AREAS
    down, across = np.divmod(np.arange(rows * columns), columns)
    middles = np.stack([(across + 0.5) / columns, (down + 0.5) / rows], axis=-1) * chart.page_mm
    assert areas_of(middles, chart).tolist() == list(range(rows * columns))
    assert areas_of(np.array([(-1.0, -1.0), chart.page_mm]), chart).tolist() == [0, rows * columns - 1]
    names = [area_name(number) for number in range(rows * columns)]
    assert len(set(names)) == len(names)
    assert [names[number] for number in (0, 7, 14)] == ["the top far left", "the middle", "the bottom far right"]
