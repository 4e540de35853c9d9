"""Figures: complete and unique, with values and outcomes at their limits."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibration.figures import all_figures, geometry, light, radiometry, truth
from calibration.figures.all_figures import FIGURES
from calibration.figures.figure import QUESTIONS
from calibration.figures.single_frames import FRAME_LIMITS, RIG_LIMITS
from calibration.figures.truth import DARKEST_COUNTS
from calibration.radiometry.superposition import NODES, Superposition
from experiment.chart.layout import design_chart


@pytest.mark.parametrize(
    "wrong",
    [
        {"why": ""},
        {"title": ""},
        {"source": ""},
        {"refuse": 301.0},
        {"name": "bleed"},
        {"lines": light.ADDITIVITY.lines},
        {"cause": replace(light.ADDITIVITY.cause, follows=("nothing",)) if light.ADDITIVITY.cause else None},
    ],
)
def test_refuses_contradictory_figures(wrong: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(light, "WRONG", replace(DARKEST_COUNTS, **{"name": "wrong", **wrong}), raising=False)  # pyrefly: ignore[bad-argument-type]
    with pytest.raises(ValueError, match=r"wrong|duplicate"):
        all_figures.collect_figures()


def test_frame_limits_have_unique_names_and_reasons() -> None:
    limits = (*RIG_LIMITS, *FRAME_LIMITS)
    names = [single_frame.name for single_frame in (*FIGURES, *limits)]
    assert len(set(names)) == len(names)
    for single_frame in limits:
        assert all((single_frame.title, single_frame.why, single_frame.source, single_frame.remedy))
        assert single_frame.outcome(single_frame.accept) == "accept"
        assert single_frame.refuse is None or single_frame.outcome(single_frame.refuse) != "refuse"


def test_lists_figures_in_order_of_definition() -> None:
    assert all_figures.collect_figures() == FIGURES
    texts = [Path(module.__file__ or "").read_text() for module in (geometry, radiometry, light, truth)]
    assert [figure.name for figure in FIGURES] == re.findall(r' = Figure\(\n    "(\w+)"', "".join(texts))
    assert {figure.group for figure in FIGURES} == QUESTIONS.keys()


def test_figures_have_required_properties() -> None:
    """Before a session, foremost, retaken frames, and shared causes."""
    assert {figure.name for figure in FIGURES if not figure.before_session} >= {
        "correction_residual", "truth_median_deg", "truth_worst_deg", "white_frames", "primaries_lacking",
    }  # fmt: skip
    first = {figure.name for figure in FIGURES if figure.foremost}
    assert first >= {"other_camera", "other_exposure", "off_codes_deg", "white_frame_deg"}
    assert {figure.name for figure in FIGURES if figure.retake is not None} >= first | {
        "frame_blur", "frame_scatter", "block_deviation", "off_brightness", "white_frame_brightness",
    }  # fmt: skip
    explained = {figure.name: figure.cause.follows for figure in FIGURES if figure.cause is not None}
    assert (
        explained.items()
        >= {
            "unfit_share": ("block_deviation",),
            "frame_scatter": ("block_deviation", "disturbed_cells"),
            "disturbed_cells": ("block_deviation",),
            "off_brightness": ("off_codes_deg", "exchanged_lights"),
        }.items()
    )


@pytest.mark.parametrize(
    ("cells", "measured", "left_in", "told"),
    [(4096, True, False, True), (4095, True, False, False), (512, True, True, True), (4096, False, True, False)],
)
def test_lens_residual_needs_enough_cells(cells: int, measured: bool, left_in: bool, told: bool) -> None:
    table: Any = SimpleNamespace(
        is_of_one_frame=False,
        registration=SimpleNamespace(mismatched_cells=np.zeros(cells)),
        lens=SimpleNamespace(measured=measured, is_uncorrected=left_in, remaining_rms=0.003, remaining_worst=0.02),
    )
    assert geometry.CORRECTION_RESIDUAL.measure(table) == (0.003 if told else None)


# What figures measure of a made-up table, where they are None, what they name, and which frames they ask for.


CHART = design_chart(3, "A7")
KINDS = ("white", "light", "light", "light", "white")
WHITE = np.array([[600.0, 900, 100], [5000, 60, 40], [50, 30, 295]])
NONE = Superposition.usual(10_000.0)


def frame(number: int, **more: object) -> Any:
    """Return one of five frames: white, three lights, white."""
    kind = KINDS[number]
    result: dict[str, Any] = {
        "record": SimpleNamespace(
            kind=kind, illumination=number - 1 if kind == "light" else None, file=f"{number}.dng", sha256=f"{number}"
        ),
        "paper": SimpleNamespace(
            white=np.array([4000.0, 9000, 2000]), references=80 - number, spread=np.array([9, 1 + number, 9]) / 1000
        ),
        "blur_px": 0.5 + 0.1 * (number == 3),
        "consistency": SimpleNamespace(
            scatter=0.01 * (number == 2), block=0.02 * (number == 1), at_mm=(3.0, 4.0), extent_mm=9.0,
            disturbed=((7, 0.1), (8, 0.1)) if number in (0, 2) else ((8, 0.1), (9, 0.1)) if number == 3 else (),
        ),
        "reregistered": number > 2,
    }  # fmt: skip
    return SimpleNamespace(**result | more)


def codes(**more: object) -> Any:
    """Return the agreement of three lights with their codes; the last deviates."""
    result: dict[str, Any] = {
        "off_deg": np.array([0.0, 1.0, 3.0]),
        "off_brightness": np.array([0.2, 0.0, 0.4]),
        "brightness": np.array([0.25, 0.01, -0.5]),
        "exchanges": (),
        "is_verified": np.array([True, True, False]),
        "exchange_deg": 1.5,
        "misfit": 0.75,
    }
    return SimpleNamespace(**result | more)


def pairs(count: int) -> tuple[Any, ...]:
    return tuple(SimpleNamespace(one=number, other=number + 1, angle_deg=2.5 - number) for number in range(count))


def table(**more: object) -> Any:
    """Return a table of five frames."""

    def lights_off_codes(limit: float) -> list[int]:
        return np.flatnonzero(result["lights"].off_codes_deg > limit).tolist()

    def added_bleed(one: Any) -> float:
        return one.blur_px - 0.5

    frames = tuple(frame(number) for number in range(5))
    lights: dict[str, Any] = {
        "codes": codes(), "off_codes_deg": np.array([0.0, 1.0, 3.0]), "white_frames": None, "drift": None,
        "subtracted": None, "additivity": None, "stray": None, "white": WHITE, "brightest": WHITE.max(axis=0),
        "lights_off_codes": lights_off_codes,
    }  # fmt: skip
    result: dict[str, Any] = {
        "is_of_one_frame": False,
        "frames": frames,
        "white_frames": [frames[0], frames[4]],
        "white_drift": 0.02,
        "white_scatter": np.array([0.001, 0.001, 0.001]),
        "origins": SimpleNamespace(other_camera=(), other_exposure=(), other_lens=(), other_iso=()),
        "sensor": SimpleNamespace(
            linearity=None, superposition=NONE, white_level=10_000, saturation_measured=True,
            transfer=SimpleNamespace(misfit=np.array([0.1, 0.2, 0]), noisy=np.arange(512) < 4, ratio=np.arange(512)),
        ),
        "dark_frames": SimpleNamespace(light=np.array([50.0, 9, 2]), lights=(), files=()),
        "dark_share": 0.01,
        "dark_change": 0.003,
        "registration": SimpleNamespace(
            mismatched_cells=np.zeros(512, np.bool_), cell_px=17.0, blur_px=2.2, marks_rms_px=0.3, lens_residual_px=1.2,
            block_rms_px=0.06, clearance=3.0, agreement=0.99, blocks=SimpleNamespace(good=np.arange(8) > 0),
            framing=SimpleNamespace(field=None, tags=(1, 2, 3), missing=(4,)),
        ),
        "lens": SimpleNamespace(uncorrected_in_worst=0.01),
        "cells": SimpleNamespace(unfit=(), window=5),
        "session": SimpleNamespace(
            lights=3, white_references=100, registered_file="0.dng", codes=((255, 0, 0), (0, 90, 0), (255, 255, 255))
        ),
        "added_bleed": added_bleed,
        "primaries": None,
        "budget": SimpleNamespace(expanded_deg=np.array([0.2, 0.9, 0.4])),
    }  # fmt: skip
    for name, value in more.items():
        if name in lights and name != "white_frames":
            lights[name] = value
        elif name == "as_whites":
            lights["white_frames"] = value
        else:
            result[name] = value
    result["lights"] = SimpleNamespace(**lights)
    return SimpleNamespace(**result)


def off(*values: float, error: float = 0.0) -> Any:
    return SimpleNamespace(off=np.array(values), error=np.full(3, error))


def unlike(frames: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return frames, the last of which has the first one's file."""
    return (*frames[:4], frame(4, record=SimpleNamespace(kind="white", illumination=None, file="4.dng", sha256="0")))


def lens_before(cells: int, **more: bool) -> dict[str, Any]:
    """Return a lens with a residual of 0.003, and the number of cells."""
    return {
        "registration": SimpleNamespace(mismatched_cells=np.zeros(cells)),
        "lens": SimpleNamespace(remaining_rms=0.003, remaining_worst=0.02, **more),
    }


TWICE = unlike(table().frames)
FOREIGN = SimpleNamespace(other_camera=("one",), other_exposure=(), other_lens=(), other_iso=())
TINTED = (table().frames[0], frame(4, paper=SimpleNamespace(white=np.array([4000.0, 9000, 2200]))))
SUBTRACTED = np.ones((3, 3))
DARK: dict[str, Any] = {"off_codes_deg": None, "subtracted": SUBTRACTED}
AS_WHITES = SimpleNamespace(off_deg=np.array([0.0, 4.0]), off_brightness=np.array([0.2, 0.1]))


@pytest.mark.parametrize(
    ("figure", "more", "value"),
    [
        (light.REPEATED_FILES, {}, 0),
        (light.REPEATED_FILES, {"frames": TWICE}, 1),
        (light.WHITE_DRIFT, {"drift": SimpleNamespace(uncertainty=0.001)}, None),
        (light.WHITE_DRIFT, {"white_frames": [TWICE[0], TWICE[4]]}, None),
        (light.DRIFT_LEFT, {}, None),
        (light.DRIFT_LEFT, {"drift": SimpleNamespace(uncertainty=0.001)}, 0.001),
        (light.DRIFT_LEFT, {"drift": SimpleNamespace(uncertainty=0.001), "white_frames": [TWICE[0]]}, None),
        (light.WHITE_DRIFT_DEG, {}, 0),
        # The angle between (4, 9, 2) and (4, 9, 2.2).
        (light.WHITE_DRIFT_DEG, {"white_frames": TINTED}, 1.1129),
        (light.WHITE_DRIFT_DEG, {"white_frames": TINTED[:1]}, None),
        (light.LEAK_SHARE, {}, 0.01),
        (light.LEAK_SHARE, {"subtracted": SUBTRACTED}, None),
        (light.LEAK_SHARE, {"dark_share": np.nan}, None),
        (light.DARK_DRIFT, {}, None),
        (light.DARK_DRIFT, {"dark_frames": SimpleNamespace(lights=(1,))}, None),
        (light.DARK_DRIFT, {"dark_frames": SimpleNamespace(lights=(1, 2))}, 0.003),
        (light.STRAY_SHARE, {}, None),
        (light.STRAY_SHARE, {"stray": SimpleNamespace(share=0.004)}, 0.004),
        (light.STRAY_SHARE, {"stray": SimpleNamespace(share=0.004), "origins": FOREIGN}, None),
        (light.STRAY_SHARE, {"stray": SimpleNamespace(share=0.004), "codes": codes(exchanges=pairs(1))}, None),
        (light.LINEARITY_KNOWN, {}, 0),
        # White has more, or less, than the sum of the primaries, in the channel that is furthest off.
        (light.ADDITIVITY, {}, None),
        (light.ADDITIVITY, {"additivity": off(-0.03, -0.01, 0.02), "off_codes_deg": None}, 0.03),
        (light.ADDITIVITY, {"additivity": off(-0.03, -0.01, 0.02)}, None),
        (light.ADDITIVITY, {"additivity": off(0.03, 0.01, 0.02), "off_codes_deg": None}, 0),
        (light.WHITE_DEFICIT, {"additivity": off(-0.03, -0.01, 0.02), "off_codes_deg": None}, 0.02),
        (light.WHITE_DEFICIT, {"additivity": off(-0.03, -0.01, 0.0), "off_codes_deg": np.zeros(3)}, 0),
        # Half of what white has beyond the primaries, less two of its scatter, as far as there was so much dark light.
        (light.TOO_DARK, {"additivity": off(-0.02, -0.016, -0.01), "off_codes_deg": None}, None),
        (light.TOO_DARK, {"additivity": off(-0.02, -0.016, -0.01)} | DARK, 0.008),
        (light.TOO_DARK, {"additivity": off(-0.02, 0.001, -0.01)} | DARK, 0),
        (light.TOO_DARK, {"additivity": off(-0.028, -0.016, -0.01)} | DARK, 0),
        (light.TOO_DARK, {"additivity": off(-0.026, -0.016, -0.01)} | DARK, 0.011),
        # What was subtracted too much is no light of the projector's.
        (light.ADDITIVITY, {"additivity": off(-0.02, -0.016, -0.01)} | DARK, None),
        (light.OFF_CODES_DEG, {}, 3),
        (light.OFF_CODES_DEG, {"off_codes_deg": None}, None),
        (light.OFF_BRIGHTNESS, {}, 0.4),
        (light.OFF_BRIGHTNESS, {"codes": None}, None),
        (light.EXCHANGED_LIGHTS, {"codes": codes(exchanges=pairs(2))}, 2),
        (light.CROSS_CHECKED_SHARE, {}, 2 / 3),
        (light.WHITE_FRAME_DEG, {}, None),
        (light.WHITE_FRAME_DEG, {"as_whites": AS_WHITES}, 4),
        (light.WHITE_FRAME_BRIGHTNESS, {"as_whites": AS_WHITES}, 0.2),
        # Red and green have a frame of their own, whatever the code.
        (light.PRIMARIES_LACKING, {}, 1),
        (light.PRIMARIES_LACKING, {"session": SimpleNamespace(codes=((9, 9, 9), (0, 0, 0)))}, 0),
        (light.PRIMARIES_LACKING, {"codes": None}, None),
        (radiometry.UNFIT_SHARE, {"cells": SimpleNamespace(unfit=(1, 2, 3, 4))}, 4 / 512),
        (radiometry.FRAME_BLUR, {}, 0.1),
        (radiometry.FRAME_SCATTER, {}, 0.01),
        (radiometry.BLOCK_DEVIATION, {}, 0.02),
        (radiometry.BLOCK_DEVIATION, {"registration": SimpleNamespace(mismatched_cells=np.zeros(69))}, None),
        (radiometry.BLOCK_DEVIATION, {"registration": SimpleNamespace(mismatched_cells=np.zeros(70))}, 0.02),
        # Cells of lights' frames, each once.
        (radiometry.DISTURBED_CELLS, {}, 3),
        (radiometry.DISTURBED_CELLS, {"registration": SimpleNamespace(mismatched_cells=np.zeros(69))}, None),
        (radiometry.REREGISTERED_FRAMES, {}, 2),
        (radiometry.WHITE_FRAMES, {}, 2),
        (radiometry.OTHER_CAMERA, {"origins": FOREIGN}, 1),
        (geometry.TAGS_FOUND, {}, 3 / 4),
        # 17 / 2 less two pixels and three quarters is 2.61 times the blur; and what the lens brings.
        (geometry.BLEED, {}, 0.00449 + 0.01),
        (geometry.BLOCKS_GOOD, {}, 7 / 8),
        # What a lens leaves is told where cells are enough to tell it.
        (geometry.CORRECTION_RESIDUAL, lens_before(4096, measured=True, is_uncorrected=False), 0.003),
        (geometry.CORRECTION_RESIDUAL, lens_before(4095, measured=True, is_uncorrected=False), None),
        (geometry.CORRECTION_RESIDUAL, lens_before(512, measured=True, is_uncorrected=True), 0.003),
        (geometry.CORRECTION_RESIDUAL, lens_before(4096, measured=False, is_uncorrected=True), None),
        (truth.NOISE_MISFIT, {}, 0.2),
        (truth.NOISY_SHARE, {}, 4 / 512),
        (truth.REFERENCES_USED, {}, 0.76),
        # Of the strongest channel, green.
        (truth.REFERENCE_SPREAD, {}, 0.005),
        (truth.BRIGHTEST_SHARE, {}, 0.5),
        (truth.DARKEST_COUNTS, {}, 295),
    ],
)
def test_figure_measures_value(figure: Any, more: dict[str, Any], value: float | None) -> None:
    assert figure.measure(table(**more)) == (None if value is None else pytest.approx(value, rel=1e-3))


def of_one_frame(**more: object) -> Any:
    """Return a check of a healthy frame."""
    origins = SimpleNamespace(other_camera=(), other_exposure=(), other_lens=(), other_iso=(), exposure_difference=0.0)
    paper = SimpleNamespace(white=np.array([4000.0, 9000, 2000]), references=100, spread=np.full(3, 0.001))
    calm = SimpleNamespace(scatter=0.0, block=0.0, disturbed=())
    single_frame = frame(0, paper=paper, consistency=calm)
    usual = {
        "frames": (single_frame,),
        "white_frames": (single_frame,),
        "white": WHITE[1:2],
        "origins": origins,
        "black_drift": 0.1,
    }
    return table(is_of_one_frame=True, **{**usual, **more})


@pytest.mark.parametrize(
    ("figure", "beyond"),
    [
        (radiometry.OTHER_CAMERA, {"origins": FOREIGN}),
        (radiometry.UNFIT_SHARE, {"cells": SimpleNamespace(unfit=(1, 2, 3, 4))}),
        (radiometry.BLACK_DRIFT_COUNTS, {"black_drift": 20.0}),
        (truth.DARKEST_COUNTS, {"white": np.array([[60.0, 243, 30]])}),
        (truth.BRIGHTEST_SHARE, {"white": np.array([[60.0, 9900, 30]])}),
        (truth.REFERENCES_USED, {"session": SimpleNamespace(white_references=200)}),
    ],
)
def test_check_judges_bounded_figures_only_beyond_limit(figure: Any, beyond: dict[str, Any]) -> None:
    fine, bad = of_one_frame(), of_one_frame(**beyond)
    assert figure.outcome(figure.measure(fine)) == "accept"
    assert figure.outcome(figure.measure(bad)) != "accept"
    assert (figure.judged_value(fine), figure.judged_value(bad)) == (None, figure.measure(bad))
    fine.is_of_one_frame = False
    assert figure.judged_value(fine) == figure.measure(fine)


def test_check_skips_figures_of_all_frames() -> None:
    result = of_one_frame(**lens_before(4096, measured=True, is_uncorrected=False))
    for figure in (geometry.CORRECTION_RESIDUAL, light.LINEARITY_KNOWN, radiometry.WHITE_FRAMES, truth.TRUTH_WORST_DEG):
        assert figure.measure(result) is not None
        assert figure.judged_value(result) is None


def test_leak_and_tint_need_white_frame() -> None:
    def tints_deg(white: object) -> Any:
        return np.array([2.0])

    greys = SimpleNamespace(tints_deg=tints_deg)
    for figure in (light.LEAK_SHARE, light.GREY_TINT_DEG):
        assert figure.judged_value(of_one_frame(greys=greys)) is not None
        assert figure.judged_value(of_one_frame(greys=greys, white_frames=())) is None
        assert figure.judged_value(table(greys=greys, white_frames=())) is not None


def test_bend_is_significant_deviation_over_paper_levels() -> None:
    nodes = np.array(NODES)
    for lack, error in ((0.03, 0.0), (0.03, 0.002)):
        result = Superposition(
            10_000.0, -lack * nodes**2 * 10_000, (error * nodes * 10_000) ** 2 * np.eye(len(nodes)), None
        )
        sensor = SimpleNamespace(linearity=None, superposition=result)
        figures_table = table(sensor=sensor, off_codes_deg=None)
        level = np.geomspace(10_000 * NODES[1], 5000, 30)
        relative = result.relative(level)[0]
        bend = np.abs(relative - relative[-1])
        doubt = 2 * np.sqrt(result.difference(level, np.full(30, 5000.0))[1])
        assert light.LINEARITY.measure(figures_table) == pytest.approx(np.maximum(bend - doubt, 0).max(), abs=1e-9)
        assert bend.max() == pytest.approx(lack * (0.5 - NODES[1]), rel=0.05)
        assert light.LINEARITY_KNOWN.measure(figures_table) == 1
        # Lights that are not what they are called tell nothing.
        assert light.LINEARITY.measure(table(sensor=sensor)) is None
    assert light.LINEARITY.measure(table(off_codes_deg=None)) is None
    series = SimpleNamespace(worst=0.02, range=(0.1, 0.9), files=("a",))
    assert light.LINEARITY.measure(table(sensor=SimpleNamespace(linearity=series, superposition=NONE))) == 0.02


@pytest.mark.parametrize(
    ("figure", "limit", "files"),
    [
        (light.OFF_CODES_DEG, 1.0, ["3"]),
        (light.OFF_CODES_DEG, 0.9, ["2", "3"]),
        (light.OFF_BRIGHTNESS, 0.2, ["3"]),
        (light.OFF_BRIGHTNESS, 0.1, ["1", "3"]),
        (light.WHITE_FRAME_DEG, 1.0, ["4"]),
        (light.WHITE_FRAME_BRIGHTNESS, 0.1, ["0"]),
        (radiometry.FRAME_BLUR, 0.05, ["3"]),
        (radiometry.FRAME_SCATTER, 0.01, []),
        (radiometry.FRAME_SCATTER, 0.009, ["2"]),
        (radiometry.BLOCK_DEVIATION, 0.01, ["1"]),
        # Where every frame is beyond, it is none of single ones.
        (radiometry.BLOCK_DEVIATION, -1.0, None),
        (radiometry.OTHER_EXPOSURE, 0.1, ["1", "2"]),
        (radiometry.OTHER_EXPOSURE, 0.01, ["1", "2", "3"]),
    ],
)
def test_selects_frames_beyond_limit(figure: Any, limit: float, files: list[str] | None) -> None:
    figures_table = table(as_whites=AS_WHITES)
    ratios = {1: 1.2, 2: 1 / 1.2, 3: 1 / 1.05}
    figures_table.origins.other_exposure = tuple(
        SimpleNamespace(record=figures_table.frames[number].record, ratio=ratio) for number, ratio in ratios.items()
    )
    result = figure.retake(figures_table, limit)
    assert (None if result is None else [record.file.removesuffix(".dng") for record in result]) == files


def worst(figure: Any, made: Any) -> Any:
    return figure.worst(made, CHART)


def where(figure: Any, made: Any, accepted: float) -> Any:
    return figure.where(made, accepted)


def test_figure_names_lights_beyond_limit() -> None:
    figures_table = table(codes=codes(exchanges=pairs(6)))
    # Four pairs are named of six, white frames after the lights.
    message = where(light.EXCHANGED_LIGHTS, figures_table, 0.0)
    assert "illuminant 2 and white frame 0" in message
    assert message.endswith("(and 2 more pairs); angle of the first pair 2.5°")
    assert "more" not in where(light.EXCHANGED_LIGHTS, table(codes=codes(exchanges=pairs(4))), 0.0)
    assert where(light.OFF_BRIGHTNESS, figures_table, 0.1) == "illuminant 2 by -50 %, illuminant 0 by +25 %"
    assert where(light.REPEATED_FILES, table(frames=TWICE), 0.0) == "4.dng is 0.dng"
    assert where(light.CROSS_CHECKED_SHARE, figures_table, 0.0) == "2 of 3"
