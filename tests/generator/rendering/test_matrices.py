"""Colour matrices: published values, files, and fitting."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivers.raw.rawfile import camera_matrix as libraw_matrix
from foundation.errors import FormatError, InputError
from generator.rendering.matrices import (
    SOURCE,
    TABLE,
    camera_matrix,
    cameras,
    choose_matrix,
    fit_matrix,
    matrix_for,
)
from generator.rendering.print_profiles import PrintProfile
from sim.world.sensors import BODIES, SENSITIVITY_BODIES, Body
from tests.generator.rendering.conftest import MakeTable


def test_matrices_keep_white() -> None:
    assert len(cameras()) == 8
    for name in cameras():
        matrix = camera_matrix(name)
        assert matrix is not None
        assert matrix.name == name
        np.testing.assert_allclose(matrix.rows.sum(axis=1), 1, rtol=0, atol=1e-12)
        # Each channel is most sensitive to its own primary.
        assert (matrix.rows.argmax(axis=1) == [0, 1, 2]).all()


@pytest.mark.parametrize("name", ["", "Canon", "EOS", "5D", "Nikon 550D", "50D"])
def test_unlisted_cameras_have_no_matrix(name: str) -> None:
    assert camera_matrix(name) is None


def test_reads_matrix_that_a_computed_lut_records(make_table: MakeTable) -> None:
    rows = [[0.5, 0.25, 0.25], [0.25, 0.5, 0.25], [0, 0.5, 1.5]]
    recorded = make_table(camera="Maker M1", computed={"by": "sim table", "matrix": {"rows": rows, "source": "fit"}})
    matrix = matrix_for(recorded)
    assert (matrix.name, matrix.source) == ("Maker M1", "fit")
    np.testing.assert_array_equal(matrix.rows, [*rows[:2], [0, 0.25, 0.75]])
    # The maker's matrix comes first, and a LUT without a record gets the fitted matrix.
    listed = make_table(name="listed", computed={"matrix": {"rows": rows, "source": "fit"}})
    assert matrix_for(listed).source == SOURCE
    assert matrix_for(make_table(name="plain", camera="Maker M1")).name == TABLE
    for number, wrong in enumerate(({"rows": rows[:2], "source": ""}, {"rows": [[1e9] * 3] * 3, "source": ""}, 3, {})):
        damaged = make_table(name=f"damaged{number}", camera="Maker M1", computed={"matrix": wrong})
        with pytest.raises(FormatError, match="expected 3 x 3 numbers"):
            matrix_for(damaged)


@pytest.mark.parametrize("body", [*SENSITIVITY_BODIES.values(), BODIES["EOS 550D"], BODIES["EOS 6D Mark II"]])
def test_simulated_bodies_have_listed_matrices(body: Body) -> None:
    assert camera_matrix(body.camera) is not None


def test_matrices_equal_those_of_libraw() -> None:
    for name in cameras():
        listed, matrix = libraw_matrix(name), camera_matrix(name)
        assert listed is not None
        assert matrix is not None
        rows = np.array(listed) @ [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
        np.testing.assert_allclose(matrix.rows, rows / rows.sum(axis=1, keepdims=True), rtol=0, atol=1e-6)


def test_matrix_of_the_550d() -> None:
    # Computed separately, with more digits of the sRGB matrix: EOS 550D to three decimals.
    matrix = camera_matrix("eos 550d")
    assert matrix is not None
    expected = [[0.578, 0.344, 0.079], [0.088, 0.674, 0.238], [0.035, 0.217, 0.748]]
    np.testing.assert_allclose(matrix.rows, expected, atol=0.0011)


def test_reads_matrix_files(tmp_path: Path) -> None:
    path = tmp_path / "matrix.txt"
    path.write_text("2 0 0\n0,1,1 # remark\n\n1;1;2\n")
    matrix = choose_matrix(str(path))
    assert matrix is not None
    np.testing.assert_array_equal(matrix.rows, [[1, 0, 0], [0, 0.5, 0.5], [0.25, 0.25, 0.5]])
    assert choose_matrix("None") is None
    for text, message in (
        ("1 2\n3 4 5\n6 7 8\n", r"rows have \[2, 3, 3\] numbers"),
        ("1 0 0\n0 nan 0\n0 0 1", "is no colour matrix"),
        # The sum is infinite, so scaled values would be 0.
        ("1e308 1e308 0\n0 1 0\n0 0 1", r"up to 1e\+06 expected"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            choose_matrix(str(path))


def test_fits_matrix_between_black_and_paper() -> None:
    rows = np.array([[0.7, 0.2, 0.1], [0.1, 0.8, 0.1], [0.05, 0.25, 0.7]])
    black, paper = np.array([0.02, 0.03, 0.04]), np.array([0.9, 0.95, 0.85])
    codes = np.array([(i >> 4, i >> 2 & 3, i & 3) for i in range(64)]) / 3
    linear = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    colours = black + (paper - black) * (linear @ rows.T)
    matrix, residual = fit_matrix(PrintProfile(colours, np.ones(64, np.bool_)))
    np.testing.assert_allclose(matrix, rows, atol=1e-9)
    assert residual == pytest.approx(0, abs=1e-5)
    # Every colour except black and paper is turned by the same angle.
    turned = colours + 0.05 * np.linalg.norm(colours, axis=1, keepdims=True) * np.array([1, 0, -1]) / np.sqrt(2)
    turned[[0, -1]] = colours[[0, -1]]
    assert 1 < fit_matrix(PrintProfile(turned, np.ones(64, np.bool_)))[1] < 4
