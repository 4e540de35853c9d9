"""Figures of two sets are told apart where they differ, and not where they do not.

What is said of two descriptions before they are compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from evaluation.experiments.describing import report
from evaluation.experiments.describing.description import (
    QUANTITIES,
    DataDescription,
    NoiseCurve,
    NoiseLevel,
    describe,
    figures,
    read_statistics,
    statistics_to_json,
)
from evaluation.experiments.describing.report import (
    FigureCompared,
    Verdict,
    compare_figures,
    compared_tables,
    seen_notes,
    sentence,
)
from generator.likeness.real_data import TITLES
from tests.evaluation.experiments.describing.scenes import random_set

pytestmark = pytest.mark.slow


@cache
def seen(name: str, count: int, seed: int = 0) -> DataDescription:
    """Return the description of random images, made once for all tests."""
    return describe(random_set(name, count, seed=seed))


def compared(one: DataDescription, other: DataDescription) -> dict[str, FigureCompared]:
    return {made.quantity.name: made for made in compare_figures(one, other)}


def test_a_set_beside_itself_and_beside_one_of_its_kind() -> None:
    first = seen("a", 60)
    for made in compare_figures(first, first):
        assert made.verdict in ("yes", "yes?")
        assert made.distance == 0
        assert made.change[0] == pytest.approx(0 if made.quantity.signed else 1)
    again = compared(first, seen("real", 80, 1))
    assert {made.verdict for made in again.values()} <= {"yes", "yes?", "no?"}
    assert again["chroma_spread"].verdict == "yes"
    assert "exposure" not in again


def test_pale_images_are_told() -> None:
    pale, real = describe(random_set("pale", 60, chroma=0.1)), seen("real", 80, 1)
    found = compared(pale, real)
    assert found["chroma_spread"].verdict == "no"
    assert found["chroma_spread"].change[0] == pytest.approx(0.5, abs=0.05)
    assert found["chroma_spread"].distance == 1
    assert found["luminance_50"].verdict in ("yes", "yes?")
    assert figures(pale)["log_red_spread"] == pytest.approx(0.1 * np.sqrt(2), rel=0.05)
    told = sentence(found["chroma_spread"], ("pale", "real"))
    assert "in pale" in told
    assert told.endswith("not within 25%.")


def test_offsets_are_measured_by_the_others_spread() -> None:
    redder = describe(random_set("redder", 80, light=(0.6, 1, 0.7)))
    found = compared(redder, seen("real", 80, 1))["light_red"]
    assert found.change[0] == pytest.approx(np.log(0.6 / 0.5), abs=0.15)
    assert found.scale == pytest.approx(0.2 * np.sqrt(2), rel=0.25)
    assert found.verdict in ("no", "no?")
    assert "of its spread there" in sentence(found, ("redder", "real"))


def test_a_ratio_to_nothing_is_none() -> None:
    real = seen("real", 20)
    values = {**real.values, "clipped": np.zeros(20)}
    none = replace(real, values=values)
    some = replace(real, values={**values, "clipped": np.full(20, 0.01)})
    found = compared(some, none)["clipped"]
    assert found.verdict is None
    assert np.isnan(found.change[0])
    assert sentence(found, ("a", "b")).endswith("no ratio to a figure that is 0.")


def test_intervals_of_spreads_are_those_of_normal_distributions() -> None:
    random = np.random.default_rng(5)
    real = seen("real", 3)
    one, other = random.normal(0, 1.5, 500), random.normal(0, 1, 500)
    sets = [
        replace(real, values={**dict.fromkeys(real.values, np.full(500, np.nan)), "grey_red": values})
        for values in (one, other)
    ]
    # The logarithm of a standard deviation of N values has a variance of 1 / 2N.
    half = 1.96 * np.sqrt(1 / 1000 + 1 / 1000)
    expected = one.std() / other.std() * np.exp([0, -half, half])
    np.testing.assert_allclose(compared(*sets)["grey_spread_red"].change, expected, rtol=0.02)


def test_generate_calls_figures_by_the_same_names() -> None:
    titles = {quantity.name: quantity.title for quantity in QUANTITIES}
    assert {name: titles[name] for name in TITLES} == TITLES


def test_only_images_that_share_a_picture_make_intervals_too_narrow(tmp_path: Path) -> None:
    alone = replace(seen("alone", 4), layout="generated")
    assert alone.groups == len(alone.images)
    shared = replace(alone, name="shared", groups=2)
    (tmp_path / "shared.json").write_text(statistics_to_json(shared))
    read = read_statistics(str(tmp_path / "shared.json"))
    assert read.groups == 2
    (told,) = [note for note in seen_notes(alone, read) if "too narrow" in note]
    assert told.startswith(f"The {len(alone.images)} images of shared are of 2 pictures or places")


QUANTITY = {quantity.name: quantity for quantity in QUANTITIES}


@pytest.mark.parametrize(
    ("name", "scale", "change", "verdict"),
    [
        # A ratio of 1/1.25 to 1.25, both ends included; the interval says whether it is sure.
        ("edges", 1, (1.0, 0.8, 1.25), "yes"),
        ("edges", 1, (0.8, 0.8, 1.0), "yes"),
        ("edges", 1, (1.25, 1.0, 1.25), "yes"),
        ("edges", 1, (1.0, 0.79, 1.1), "yes?"),
        ("edges", 1, (1.0, 0.9, 1.26), "yes?"),
        ("edges", 1, (0.79, 0.7, 0.8), "no?"),
        ("edges", 1, (0.79, 0.7, 0.799), "no"),
        ("edges", 1, (1.26, 1.25, 1.3), "no?"),
        ("edges", 1, (1.26, 1.251, 1.3), "no"),
        ("edges", 1, (np.nan, np.nan, np.nan), None),
        # A difference of a quarter of the scale.
        ("light_red", 2, (0.5, -0.5, 0.5), "yes"),
        ("light_red", 2, (-0.5, -0.51, 0.4), "yes?"),
        ("light_red", 2, (0.51, 0.5, 0.6), "no?"),
        ("light_red", 2, (-0.51, -0.6, -0.501), "no"),
    ],
)
def test_a_figure_is_alike_within_a_quarter(
    name: str, scale: float, change: tuple[float, float, float], verdict: Verdict | None
) -> None:
    assert report._verdict(QUANTITY[name], change, scale) == verdict
    made = FigureCompared(QUANTITY[name], 3.0, 4.0, change, scale, 0.1, 0.5, verdict)
    told = sentence(made, ("a", "b"))
    ends = {
        "yes": "within 25%.",
        "yes?": "within 25%, but other images might not be.",
        "no?": "not within 25%, but other images might be.",
        "no": "not within 25%.",
        None: "no ratio to a figure that is 0.",
    }
    assert told.endswith(f", {ends[verdict]}" if verdict else f": {ends[verdict]}")
    if name == "light_red":
        assert f"{abs(change[0]) / 2:.0%} of its spread there" in told
    (table,) = compared_tables([made], ("a", "b"))
    assert table.columns[4] == ("Difference" if name == "light_red" else "Ratio")
    row = dict(zip(table.columns, table.rows[0], strict=True))
    assert (row["a"], row["b"], row["Within 25%"], row["KS"], row["p"]) == (3, 4, verdict, 0.1, 0.5)


def test_three_images_make_a_figure() -> None:
    real = seen("real", 20)
    for count, is_there in ((2, False), (3, True)):
        rare = {**real.values, "edges": np.array([*np.linspace(0.1, 0.2, count), *[np.nan] * (20 - count)])}
        assert ("edges" in compared(replace(real, values=rare), real)) is is_there


def drawn_by(draw: Callable[[], object], monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return the axes that a figure of the report consists of."""
    kept: list[Any] = []

    def keep(draw: Callable[[Any], None], *, inches: tuple[float, float]) -> bytes:
        figure = Figure(figsize=inches)
        draw(figure)
        kept.append(figure)
        return b"<svg></svg>"

    monkeypatch.setattr(report, "svg_of", keep)
    draw()
    return kept[0].axes


def test_of_many_lights_a_part_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = seen("a", 3), seen("b", 3)
    lights = np.random.default_rng(0).dirichlet((9, 9, 9), 3001)
    one = replace(one, lights=lights)
    other = replace(other, lights=lights[:3000])
    (axes,) = drawn_by(lambda: report._lights((one, other)), monkeypatch)
    few, all_ = (np.asarray(points.get_offsets()) for points in axes.collections)
    np.testing.assert_allclose(few, lights[::2, [0, 2]])
    np.testing.assert_allclose(all_, lights[:3000, [0, 2]])


def test_noise_in_another_unit_is_not_drawn_beside(monkeypatch: pytest.MonkeyPatch) -> None:
    levels = tuple(NoiseLevel(signal, 0.1 * signal, 40) for signal in (0.01, 0.1, 1.0))
    none = NoiseCurve(())
    one = replace(seen("a", 3), noise=(none, NoiseCurve(levels, 0.03, 0.16, 0.1), none))
    (axes,) = drawn_by(lambda: report._noise((one, replace(one, noise_unit="another"))), monkeypatch)
    points, curve = axes.lines
    np.testing.assert_allclose(points.get_xydata(), [[0.01, 0.001], [0.1, 0.01], [1, 0.1]])
    signal, sigma = curve.get_xydata().T
    np.testing.assert_allclose(sigma**2, 0.03**2 + 0.16 * signal)
    assert report._noise((replace(one, noise=(none,) * 3),)) == []


def test_what_makes_descriptions_less_comparable_is_said() -> None:
    made = seen("a", 3)
    small = replace(made, name="small", sizes=((100, 64, 1), (100, 63, 2)), side=64)
    enough = replace(made, name="enough", sizes=((64, 64, 3),), side=64)
    assert [note[:28] for note in seen_notes(small, enough)] == ["Images of small have fewer t"]
    assert (
        "enough was seen at 64 x 64 cells at most, full at full size"
        in seen_notes(enough, replace(enough, name="full", side=0))[0]
    )
    known = {**made.values, "edges": np.full(3, np.nan)}
    assert seen_notes(replace(enough, values=known), enough) == (
        "Known of one of the two only, and left out: Mean edge.",
    )
