"""What the paper's figures show is what was measured: lines, dots and axes as Matplotlib is given them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from evaluation.experiments.paper import reporting
from evaluation.experiments.paper.reporting import coverage_table
from tests.evaluation.experiments.paper.conftest import LIGHTS, TableMaker

RB = LIGHTS[:, [0, 2]] / LIGHTS.sum(axis=1, keepdims=True)


def drawn(draw: Any, *arguments: Any) -> list[Any]:
    """Return the axes of a figure that is drawn."""
    figure: Any = Figure()
    draw(figure, *arguments)
    return figure.axes


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


def test_the_distance_of_ground_truths(make_table: TableMaker) -> None:
    lut = make_table("Test")
    turned = LIGHTS[:2].copy()
    turned[0, 2] += 100
    table = coverage_table([lut], {"near": LIGHTS[:2], "off": turned})
    off = np.degrees(np.arccos(LIGHTS[0] @ turned[0] / np.linalg.norm(LIGHTS[0]) / np.linalg.norm(turned[0])))
    assert [row[:4] for row in table.rows] == [("Test", "near", 2, 2), ("Test", "off", 2, 2)]
    assert table.rows[0][4:] == pytest.approx([0, 0, 0], abs=1e-5)
    assert table.rows[1][4:] == pytest.approx([off / 2, off, off], abs=1e-5)
