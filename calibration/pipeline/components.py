"""The components of a table's uncertainty budget: what each cause may leave, from what a session shows of it.

What it does not show is what is usual, and says so; nothing is taken to be 0.

L lights, C cells in the order of colour indices.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from calibration.budget import Budget, Component
from calibration.measurements import TableMeasurements
from calibration.sampling import mean_bleed
from calibration.spread.added_light import LEAST_LEVEL

_Array = npt.NDArray[np.float64]

_BLACK_COUNTS = 0.05
"""Standard uncertainty of a frame's black level, counts, beyond what its frames' scatter shows (judgement: masked
photosites give .03)."""

_RESPONSE = 0.003
"""Standard deviation of photosites' response that is not seen beside their noise (usual of cameras: 0.3 to 1 %)."""

_SINGLE_DARK = 0.2
"""Relative change of dark light over a session, where one dark frame does not show it (judgement)."""

_USUAL_TOO_DARK = 0.2
"""Share of the dark light by which dark frames differ from what is there in the lights', where no light shows it
(judgement)."""

_FLICKER = 5e-5
"""Relative: a lamp that flickers, or a wheel that is cut, within an exposure (judgement: half-second exposures; Heinz
et al. 2018)."""

_STRAY = 1e-4
"""Relative: light from beside the print where no figure shows it (judgement)."""

_COMMON = 0.75
"""Share of the mean square of these two that all channels have in common: a lamp flickers as a whole, a wheel is cut in
one primary; walls send back the light that is shown, in their own colour (judgement)."""


def budget_of(table: TableMeasurements) -> Budget:
    """Return the budget of what was measured."""
    white = np.maximum(table.lights.white, 1e-9)
    cells = np.maximum(table.cells.levels, LEAST_LEVEL)
    return Budget(
        (
            _noise(table, white, cells),
            _lens(table, white, cells),
            _darkness(table, white, cells),
            _linearity(table, white, cells),
            _added_light(table, white, cells),
            _flicker(white, cells),
            _geometry(table, white, cells),
        ),
        white,
    )


def _diagonal(squares: _Array) -> _Array:
    """Return errors that are independent in each channel, (L, 3, 3), of mean squares (L, 3)."""
    return squares[:, :, None] * np.eye(3)


def _partly_common(size: float, lights: int) -> _Array:
    """Return mean square relative errors (L, 3, 3) of a size that `_COMMON` of is in all channels alike."""
    square = size**2 * (_COMMON * np.ones((3, 3)) + (1 - _COMMON) * np.eye(3))
    return np.broadcast_to(square, (lights, 3, 3))


def _noise(table: TableMeasurements, white: _Array, cells: _Array) -> Component:
    """Return the noise of white and, of cells, that of the field there and their own photosites' response.

    The field has as much of the references' noise as it has terms, white that of one.
    """
    square = (table.lights.white_error / white) ** 2
    field = max(len(factor) for frame in table.frames for factor in frame.paper.field.coefficients[0])
    response = (table.sensor.transfer.response**2 + _RESPONSE**2) / table.cells.window**2
    return Component(
        "noise", "noise of the white references", False,
        "scatter of the white references about each frame's field, and the photosites' response within a cell; its "
        "noise from frame to frame is the camera's and no error",
        _diagonal(square), np.broadcast_to(field * square.min(axis=0) + response, cells.shape),
    )  # fmt: skip


def _lens(table: TableMeasurements, white: _Array, cells: _Array) -> Component:
    lens = table.lens
    source = "what the light about each cell says of the lens, and cannot say" if lens.measured else lens.why_not
    return Component(
        "lens", "spread and veil of the lens", not lens.measured, source,
        np.broadcast_to(lens.white_covariance, (len(white), 3, 3)), lens.cells_error**2,
    )  # fmt: skip


def _darkness(table: TableMeasurements, white: _Array, cells: _Array) -> Component:
    """Return the errors of black level and, where dark light was subtracted, of what was.

    Without that, a light's ground truth is that of all light that was there.
    """
    lights, dark = table.lights, table.dark_frames
    black = np.array([frame.black.mean() for frame in table.frames])
    error = np.full(3, _BLACK_COUNTS**2 + float(np.var(black)) / max(len(black), 1))
    source, assumed = "the black level of masked photosites", False
    if lights.subtracted is not None and dark.lights:
        light = np.maximum(dark.light, 0)
        changes = np.var(dark.lights, axis=0, ddof=1) if len(dark.lights) > 1 else (_SINGLE_DARK * light) ** 2
        error = error + dark.error**2 + changes + _too_dark(table, light) ** 2
        source = "scatter of the dark frames; what lights of several primaries have beyond the primaries' sum"
        assumed = lights.additivity is None or len(dark.lights) < 2
    at_cells = error / np.maximum(lights.brightest, 1e-9) ** 2
    return Component(
        "darkness", "black level and dark light", assumed, source, _diagonal(error / white**2), at_cells / cells**2 * (
            1.0 if lights.subtracted is None else np.minimum(cells, 1.0) ** 2
        ),
    )  # fmt: skip


def _too_dark(table: TableMeasurements, dark: _Array) -> _Array:
    """Return how much too much dark light (3,) counts was perhaps subtracted, of `dark` (3,) counts that was.

    White then has twice as much beyond the sum of the primaries, each of which lacks it; a projector that adds light of
    its own to white looks the same.
    """
    found = table.lights.additivity
    if found is None:
        return _USUAL_TOO_DARK * dark
    beyond = np.sqrt(found.off**2 + found.error**2 + table.white_scatter**2) * table.lights.brightest
    return np.minimum(beyond / 2, dark)


def _linearity(table: TableMeasurements, white: _Array, cells: _Array) -> Component:
    found = table.sensor.superposition
    paper = np.maximum(table.lights.brightest, 1e-9)
    level = np.maximum(cells, LEAST_LEVEL) * paper
    source = (
        "red, green and blue alone against a light that is made of them"
        if found.unmeasured is None
        else f"usual of cameras: 1 % at saturation, 0.05 % of it near black; {found.unmeasured.why}"
    )
    return Component(
        "linearity", "deviation of counts from proportion", not found.measured, source,
        found.white_covariance(white), found.errors(level, np.broadcast_to(paper, level.shape)),
    )  # fmt: skip


def _added_light(table: TableMeasurements, white: _Array, cells: _Array) -> Component:
    shown = 0.0 if table.lights.stray is None else table.lights.stray.share
    lights = _partly_common(_STRAY, len(white)) + shown**2 * np.eye(3)
    at_cells = (_STRAY**2 + shown**2 + table.cells.added.mean_square) / cells**2
    return Component(
        "added light", "reflections and light of single frames", table.lights.stray is None,
        "light that lies on dark and bright cells alike; codes of 0, and white against the primaries", lights, at_cells,
    )  # fmt: skip


def _flicker(white: _Array, cells: _Array) -> Component:
    return Component(
        "flicker", "flicker within an exposure", True,
        "usual of lamps and wheels; a drift from frame to frame is in each light's own ground truth",
        _partly_common(_FLICKER, len(white)), np.broadcast_to(_FLICKER**2, cells.shape),
    )  # fmt: skip


def _geometry(table: TableMeasurements, white: _Array, cells: _Array) -> Component:
    """Return what reaches a cell's mean from its neighbours by the sharp core, and by where the cell was found.

    A place that is known to some error blurs the cell's rim by as much, in the mean.
    """
    registration, window = table.registration, table.cells.window
    blur_px = np.hypot(registration.blur_px, registration.uncertainty_px(table.cells.stains.places_mm))
    of_neighbours = mean_bleed(registration.cell_px, blur_px, window)[:, None]
    contrast = np.sqrt(((cells - cells.mean(axis=0)) ** 2 + cells.var(axis=0)) / cells**2)
    nothing = np.zeros((len(white), 3, 3))
    return Component(
        "geometry", "places of cells and sharp core", False,
        "blur and places as registered; neighbours as the print has them in the mean",
        nothing, (of_neighbours * contrast) ** 2,
    )  # fmt: skip
