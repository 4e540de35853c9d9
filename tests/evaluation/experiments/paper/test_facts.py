"""What a table holds: its noise, and how grey its print is."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.experiments.paper.table1 import noise_table, print_colours, print_table, table_noise
from tests.evaluation.experiments.paper.conftest import LIGHTS, TableMaker


def test_noise_of_the_print_s_white(make_table: TableMaker) -> None:
    noise = table_noise(make_table("Test", noise=0.05, samples=400))
    # Of 400 samples the largest normal deviate is about three standard deviations up.
    assert noise.spread == pytest.approx([0.05] * 3, rel=0.15)
    assert noise.largest == pytest.approx([0.15] * 3, rel=0.4)
    assert noise.level == pytest.approx(float(np.median(LIGHTS.max(axis=1))) / 9000, rel=0.02)
    assert noise_table([noise]).rows[0][:2] == ("Test", len(LIGHTS))


def test_a_print_that_reflects_as_its_code_is_grey(make_table: TableMaker) -> None:
    colours = print_colours(make_table("Test"))
    # Of the black bodies of 3002 and 3003 K the second is nearer to daylight. The codes are 0, 1/7 … 1.
    assert colours.light == 3
    assert colours.mean == pytest.approx([0.5] * 3, abs=1e-3)
    assert colours.rms == pytest.approx([float(np.sqrt(np.mean((np.arange(8) / 7) ** 2)))] * 3, abs=1e-3)
    table = print_table([colours])
    assert [row[2] for row in table.rows] == ["mean", "root mean square"]
    assert table.rows[0][6] == pytest.approx(0, abs=0.1)
