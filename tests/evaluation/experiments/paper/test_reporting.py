"""What the paper's figures show is what was measured: lines, dots and axes as Matplotlib is given them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from evaluation.experiments.paper import reporting
from evaluation.experiments.paper.colour_reduction import bits_methods, bits_removed
from evaluation.experiments.paper.reporting import chromaticity_rows, coverage_table, standalone
from evaluation.experiments.paper.table1 import SizeRow
from tests.evaluation.experiments.paper.conftest import LIGHTS, TableMaker
from tests.evaluation.experiments.paper.test_colour_reduction import Photo, photo

RB = LIGHTS[:, [0, 2]] / LIGHTS.sum(axis=1, keepdims=True)


def drawn(draw: Any, *arguments: Any) -> list[Any]:
    """Return the axes of a figure that is drawn."""
    figure: Any = Figure()
    draw(figure, *arguments)
    return figure.axes


@pytest.mark.slow
def test_each_method_has_its_medians_and_that_of_the_images_as_they_are() -> None:
    found = bits_removed([Photo(photo(seed)) for seed in range(3)], bits_methods(sigma=2), (0, 5))
    (axes,) = drawn(reporting._draw_bits, found, "recovery")
    lines = axes.lines
    assert len(lines) == 2 * len(found.raw)
    for place, raw in enumerate(found.raw):
        line, level = lines[2 * place : 2 * place + 2]
        assert list(line.get_xdata()) == [0, 5]
        assert list(line.get_ydata()) == [
            results[place].summary("recovery").median for results in found.reduced.values()
        ]
        assert list(level.get_ydata()) == [raw.summary("recovery").median] * 2
        assert line.get_label() == raw.method
        assert line.get_color() == level.get_color()
    assert len({line.get_marker() for line in lines[::2]}) == len(found.raw)
    assert axes.get_ylim()[0] == 0
    assert "recovery" in axes.get_ylabel()


def test_each_data_set_has_its_medians_by_the_side_of_its_images() -> None:
    cells = ("C1", "6D", "Random"), ("C1", "550D", "Random")
    rows = [SizeRow(cell, side, {"M": number + side / 100}) for number, cell in enumerate(cells) for side in (12, 48)]
    (axes,) = drawn(reporting._draw_sizes, rows, "M")
    shown = {line.get_label(): (list(line.get_xdata()), list(line.get_ydata())) for line in axes.lines}
    assert shown == {
        "C1 scenes, 6D sensor, random illuminations": ([12, 48], [0.12, 0.48]),
        "C1 scenes, 550D sensor, random illuminations": ([12, 48], [1.12, 1.48]),
    }
    assert [label.get_text() for label in axes.get_xticklabels()] == ["12", "48"]
    assert (axes.get_xscale(), axes.get_ylim()[0]) == ("log", 0)


def test_lights_and_ground_truths_lie_at_their_chromaticities(make_table: TableMaker) -> None:
    luts = [make_table("Canon EOS 550D"), make_table("Test")]
    # Two of three that no eye tells apart are one dot.
    truths = np.concatenate([LIGHTS[:2], LIGHTS[:1] * 1.0001])
    left, right = drawn(reporting._draw_chromaticities, luts, {"Mine": truths})
    assert (left.get_title(), right.get_title()) == ("Canon EOS 550D", "Test")
    assert left.get_position().x1 < right.get_position().x0
    for axes in (left, right):
        uniform, mine, bodies = axes.collections
        assert [one.get_label() for one in (uniform, bodies)] == ["uniform (2)", "black bodies (2)"]
        np.testing.assert_allclose(uniform.get_offsets(), RB[:2], atol=1e-6)
        np.testing.assert_allclose(bodies.get_offsets(), RB[2:], atol=1e-6)
        np.testing.assert_allclose(sorted(mine.get_offsets().tolist()), sorted(RB[:2].tolist()), atol=1e-4)
        # Both axes alike, and all that a table has is on them.
        low, high = axes.get_xlim()
        assert (low, high) == axes.get_ylim()
        assert (low, high) == pytest.approx((0, 1.04 * RB.max()))


def test_they_are_the_lights_of_the_table(make_table: TableMaker) -> None:
    lut = make_table("Canon EOS 550D")
    rows = chromaticity_rows([lut]).rows
    for row, (red, green, blue) in zip(rows, LIGHTS.tolist(), strict=True):
        assert row[4:] == pytest.approx((red / (red + green + blue), blue / (red + green + blue)), abs=1e-6)
    assert [row[2] for row in rows] == ["uniform", "uniform", "blackbody", "blackbody"]
    assert rows[2][:4] == ("Canon EOS 550D", 2, "blackbody", 3002.0)


def test_the_distance_of_ground_truths(make_table: TableMaker) -> None:
    lut = make_table("Test")
    turned = LIGHTS[:2].copy()
    turned[0, 2] += 100
    table = coverage_table([lut], {"near": LIGHTS[:2], "off": turned})
    off = np.degrees(np.arccos(LIGHTS[0] @ turned[0] / np.linalg.norm(LIGHTS[0]) / np.linalg.norm(turned[0])))
    assert [row[:4] for row in table.rows] == [("Test", "near", 2, 2), ("Test", "off", 2, 2)]
    assert table.rows[0][4:] == pytest.approx([0, 0, 0], abs=1e-5)
    assert table.rows[1][4:] == pytest.approx([off / 2, off, off], abs=1e-5)


def test_places_of_dots_are_cut_to_what_can_be_seen() -> None:
    svg = b'<svg><use xlink:href="#m" x="12.3456" y="7.89" style=""/><path d="M 1.2345 2"/></svg>'
    made = standalone(svg)
    assert b'<use xlink:href="#m" x="12.3" y="7.8" style=""/><path d="M 1.2345 2"/>' in made
    assert b"@media (prefers-color-scheme: dark)" in made
