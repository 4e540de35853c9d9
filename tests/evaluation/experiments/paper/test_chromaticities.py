"""Chromaticities of tables' lights, and ground truths beside them."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.experiments.paper.reporting import (
    chromaticities_figure,
    chromaticity_rows,
    coverage_table,
    standalone,
)
from tests.evaluation.experiments.paper.conftest import LIGHTS, TableMaker


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


def test_the_figure_has_every_light(make_table: TableMaker) -> None:
    lut = make_table("Canon EOS 550D")
    drawn = chromaticities_figure([lut], {"Cube+": LIGHTS}).decode()
    for text in ("Canon EOS 550D", "uniform (2)", "black bodies (2)", "Cube+"):
        assert text in drawn
    assert b"@media (prefers-color-scheme: dark)" in standalone(drawn.encode())
