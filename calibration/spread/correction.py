"""The correction: what surroundings add to each patch of a frame, and what is said of it.

What is subtracted from a patch's samples is one number for each channel: the light that the lens brought in, less what
it took away. The samples' noise is not touched. Levels of a frame are taken from the frame itself, as it is: the shares
were fitted on such levels, so that light which was spread twice is in them.

P patches as in `PrintedGrid`; counts above black; half-size pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from acquisition.measures.flat_field import FlatField
from acquisition.measures.least_squares import least_squares
from acquisition.measures.polynomials import page_polynomial, page_powers
from calibration.registration.registration import Registration
from calibration.sampling.samples import Sites, sites_at
from calibration.spread.fitting import SpreadData, fit_spread, predicted_levels
from calibration.spread.point_spread import FAR_PX, NEAR_PX, PointSpread
from calibration.spread.printed_grid import PrintedGrid
from calibration.spread.surroundings import Levels, NearLight, Surroundings, light_at, surroundings

_MARGIN_PX = 12.0
"""How far from the sheet's edge what lies behind it is looked at."""

_LATTICE_PX = 24
"""Distance of the places at which what lies behind the sheet is looked at."""

_FIELD_ORDER = 6
"""Highest order of the smooth change of white references by which a frame's field would change."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PrintView:
    """What holds for all frames of a session: the print's grid, its usual light, and where it is looked past.

    Attributes
    ----------
    grid, neighbours
        The print.
    whites
        Places of the white references among the patches.
    photosites_px
        (3, 2) float64, where each channel's photosites lie from a block's centre.
    light, slot_light
        The usual field at patches (P, 3) and slots (R K, 3).
    beyond
        Places that show what lies behind the print; none where the print fills the frame.
    """

    grid: PrintedGrid
    neighbours: npt.NDArray[np.int32]
    whites: slice
    photosites_px: _Array
    light: _Array
    slot_light: _Array
    beyond: Sites

    @staticmethod
    def of(
        grid: PrintedGrid,
        whites: slice,
        photosites_px: _Array,
        field: FlatField,
        registration: Registration,
        shape: tuple[int, int],
        window: int,
    ) -> PrintView:
        """Return the view of a session.

        Parameters
        ----------
        grid, whites, photosites_px
            As the attributes.
        field
            Of the frame that is registered first.
        registration
            The chart's place in it.
        shape
            Rows and columns of the half-size frame.
        window
            Pixels along a patch's window.
        """
        beyond = _places_beyond(grid, registration, shape, window)
        return PrintView(grid, grid.neighbours, whites, photosites_px, *light_at(grid, field), beyond)

    def around(self, registration: Registration, cells: Sites, references: Sites) -> Surroundings:
        """Return the surroundings of the patches of a frame, given where they are sampled."""
        return surroundings(
            self.grid, self.neighbours, self.photosites_px, registration, cells, references, self.whites,
            (self.light, self.slot_light),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class FrameCorrection:
    """The correction of frames that are sampled at the same places.

    Attributes
    ----------
    around
        The patches' surroundings.
    near
        Weights of the near kernels.
    far, veil
        Shares of the far kernels (F,) and of the veil.
    beyond
        Places that show what lies behind the print.
    """

    around: Surroundings
    near: NearLight
    far: _Array
    veil: float
    beyond: Sites

    @staticmethod
    def of(spread: PointSpread, view: PrintView, around: Surroundings) -> FrameCorrection:
        """Return the correction for a point spread and the surroundings of a frame's patches."""
        amounts, near = spread.amounts(), len(NEAR_PX)
        return FrameCorrection(
            around, around.near(amounts[:, :near]), amounts[0, near:-1], float(amounts[0, -1]), view.beyond
        )

    def added(self, levels: Levels) -> _Array:
        """Return what the lens added to each patch, (P, 3) float64 counts; negative where it took more away."""
        around = self.around
        added = self.near.at(levels, around.local(levels)) - self.near.total * levels.patches
        if self.far.any() or self.veil:
            image = around.image(levels)
            for share, scale in zip(self.far.tolist(), FAR_PX, strict=True):
                if share:
                    added += share * (around.far(image, scale) - levels.patches)
            if self.veil:
                added += self.veil * (image.mean(axis=(0, 1), dtype=np.float64) - levels.patches)
        return added


@dataclass(frozen=True, eq=False)
class SpreadFrame:
    """A frame that the point spread is measured on.

    Attributes
    ----------
    levels, around
        What it shows, and the patches' surroundings.
    field
        (P, 3) float64, its flat field at the patches.
    white
        (3,) float64 counts, its bare paper.
    usable
        (P,) bool, patches that are in the frame, not clipped and not covered.
    unevenness
        As in `SpreadData`.
    """

    levels: Levels
    around: Surroundings
    field: _Array
    white: _Array
    usable: npt.NDArray[np.bool_]
    unevenness: float


@dataclass(frozen=True)
class LensFigures:
    """What the correction comes to under the light of the frames that it was measured on; cells above 300 counts.

    Attributes
    ----------
    rms, worst
        Change of the cells' means relative to paper, RMS and the largest; 0 where nothing is corrected.
    residual
        RMS error that the means have after it, by the shares' standard errors, proven or not.
    veil, veil_error
        Share of the frame's mean light that lies on all of it, and its standard error.
    beyond_cell
        Share of the light of a window's worst sample that the kernels bring from beyond its cell, channel by channel
        the largest.
    left_in_worst
        The same beyond that of the window's mean, which is what is corrected.
    why_not
        Why nothing was measured or nothing is corrected; "" where it is.
    """

    rms: float
    worst: float
    residual: float
    veil: float
    veil_error: float
    beyond_cell: float
    left_in_worst: float
    why_not: str = ""


@dataclass(frozen=True, eq=False)
class LensCorrection:
    """The lens of a session: its point spread, what is said of it, and the view by which frames are corrected.

    Attributes
    ----------
    view, spread, figures
        As said.
    """

    view: PrintView
    spread: PointSpread
    figures: LensFigures

    def of(self, registration: Registration, cells: Sites, references: Sites) -> FrameCorrection:
        """Return the correction of frames that are sampled at these places."""
        return FrameCorrection.of(self.spread, self.view, self.view.around(registration, cells, references))


def measure_spread(
    frames: list[SpreadFrame], page_mm: tuple[float, float], bits: int, least_counts: float
) -> tuple[PointSpread, LensFigures] | None:
    """Return the point spread that frames show, and its figures; None where no frame is bright enough.

    Parameters
    ----------
    frames
        Best of one primary each, whose field is the same for all cells.
    page_mm
        Width and height of the page.
    bits
        Bits of each channel of a code.
    least_counts
        Counts of bare paper from which on a channel is used, and of a cell from which on figures count it.
    """
    count = 8**bits
    data: list[SpreadData] = []
    scales: list[_Array] = []
    for frame in frames:
        changes, gains = _changes(frame, page_mm, bits)
        for channel in range(3):
            if frame.white[channel] >= least_counts:
                level = (frame.levels.patches / (frame.field * frame.white))[:count, channel]
                usable = frame.usable[:count]
                data.append(SpreadData(channel, level, changes[:, :, channel].T, usable, frame.unevenness))
                scales.append(np.append(gains[:, channel], frame.white[channel]))
    if not data:
        return None
    cells_mm = frames[0].around.grid.points_mm[:count]
    spread = fit_spread(data, cells_mm, page_mm, bits)
    return None if spread is None else (spread, _figures(spread, data, scales, frames[0].around, bits, least_counts))


def _changes(frame: SpreadFrame, page_mm: tuple[float, float], bits: int) -> tuple[_Array, _Array]:
    """Return the change (K, C, 3) of cells' levels for a whole share of each kernel, and the mean change of white (K, 3).

    What comes in, less what the white references get, since the field is fitted through them; their mean, by which
    all levels change alike, is returned apart.
    """
    around, levels, count = frame.around, frame.levels, 8**bits
    relative = frame.field * frame.white
    expected = predicted_levels((levels.patches / relative)[:count], bits)
    local, image = around.local(levels), around.image(levels)
    points = around.grid.points_mm
    whites = np.arange(len(points))[around.whites]
    whites = whites[frame.usable[whites]]
    order = next((n for n in range(_FIELD_ORDER, 0, -1) if 3 * len(page_powers(n)) <= len(whites)), 0)
    at_whites, at_cells = (page_polynomial(where, page_mm, order) for where in (points[whites], points[:count]))
    changes, gains = np.empty((len(NEAR_PX) + len(FAR_PX) + 1, count, 3)), np.empty((len(NEAR_PX) + len(FAR_PX) + 1, 3))
    one = np.eye(len(NEAR_PX))
    for kernel in range(len(changes)):
        if kernel < len(NEAR_PX):
            near = around.near(np.tile(one[kernel], (3, 1)))
            own = near.own
            seen = near.at(levels, local)
        elif kernel < len(changes) - 1:
            own = np.full_like(levels.patches, around.own_share(FAR_PX[kernel - len(NEAR_PX)]))
            seen = around.far(image, FAR_PX[kernel - len(NEAR_PX)])
        else:
            own = np.zeros_like(levels.patches)
            seen = np.broadcast_to(image.mean(axis=(0, 1), dtype=np.float64), levels.patches.shape)
        coming = (seen - own * levels.patches) / np.maximum(relative, 1e-6)
        usual = own[:count].mean(axis=0)
        for channel in range(3):
            of_white = coming[whites, channel] + own[whites, channel] - usual[channel]
            smooth = at_cells @ least_squares(np.ascontiguousarray(at_whites), of_white, np.ones(len(whites)))
            gains[kernel, channel] = smooth.mean()
            kept = own[:count, channel] - usual[channel] - (smooth - gains[kernel, channel])
            changes[kernel, :, channel] = coming[:count, channel] + kept * expected[:, channel]
    return changes, gains


def _figures(
    spread: PointSpread,
    data: list[SpreadData],
    scales: list[_Array],
    around: Surroundings,
    bits: int,
    least_counts: float,
) -> LensFigures:
    amounts = spread.amounts()
    corrected: list[_Array] = []
    unknown: list[_Array] = []
    from calibration.spread.point_spread import terms_of

    for one, scale in zip(data, scales, strict=True):
        expected = predicted_levels(one.level[:, None], bits)[:, 0]
        lit = one.usable & (one.level * scale[-1] > least_counts)
        # All of the change: with white's mean, by which a level over paper's changes too.
        change = (one.changes[lit] - np.outer(expected[lit], scale[:-1])) / one.level[lit, None]
        corrected.append(change @ amounts[one.channel])
        terms = terms_of(one.channel)
        unknown.append(np.einsum("nk,kl,nl->n", change, spread.covariance[np.ix_(terms, terms)], change))
    size, left = np.concatenate(corrected), np.concatenate(unknown)
    worst, mean = _beyond_cell(around)
    near = amounts[:, : len(NEAR_PX)]
    wide = amounts[:, len(NEAR_PX) :].sum(axis=1)
    nothing = len(size) == 0
    return LensFigures(
        rms=0.0 if nothing else float(np.sqrt((size**2).mean())),
        worst=0.0 if nothing else float(np.abs(size).max()),
        residual=0.0 if nothing else float(np.sqrt(left.mean())),
        veil=float(amounts[0, -1]),
        veil_error=float(spread.errors()[0, -1]),
        beyond_cell=float((near @ worst + wide).max()),
        left_in_worst=float((near @ (worst - mean)).max()),
        why_not="" if spread.proven else "no spread beside the sharp core is proven",
    )


def _beyond_cell(around: Surroundings) -> tuple[_Array, _Array]:
    """Return the share (N,) of each near kernel from beyond a cell, in the worst sample and in the mean of a window."""
    from scipy.special import ndtr

    cell, reach = float(around.pitch_px.min()), around.window // 2
    worst, mean = np.empty(len(NEAR_PX)), np.empty(len(NEAR_PX))
    # A corner's pixel, half a pixel of rounding towards the corner.
    for kernel, scale in enumerate(NEAR_PX):
        at = np.arange(-reach, reach + 1) + 0.5
        inside = ndtr((cell / 2 - at) / scale) - ndtr((-cell / 2 - at) / scale)
        worst[kernel] = 1 - inside[-1] ** 2
        mean[kernel] = 1 - inside.mean() ** 2
    return worst, mean


def _places_beyond(grid: PrintedGrid, registration: Registration, shape: tuple[int, int], window: int) -> Sites:
    """Return places that show what lies behind the print, all over the frame beside it."""
    import cv2

    rows, columns = shape
    width, height = grid.pitch_mm
    # The outermost patches, and from them straight on to the sheet's edge and a margin.
    low, high = grid.points_mm.min(axis=0), grid.points_mm.max(axis=0)
    sheet = grid.slots_mm[grid.others[..., 2].ravel() < 0.5]
    low, high = np.minimum(low, sheet.min(axis=0)), np.maximum(high, sheet.max(axis=0))
    low, high = low - (width / 2, height / 2), high + (width / 2, height / 2)
    along = np.linspace(0, 1, 40)[:, None]
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]], low])
    outline = np.concatenate([a + (b - a) * along for a, b in zip(corners[:-1], corners[1:], strict=True)])
    edge = registration.to_pixels(outline)
    covered = np.zeros((rows, columns), dtype=np.uint8)
    cv2.fillPoly(covered, [np.rint(edge).astype(np.int32).reshape(-1, 1, 2)], 1)
    reach = 2 * int(_MARGIN_PX) + 1
    covered = cv2.dilate(covered, np.ones((reach, reach), dtype=np.uint8))
    y, x = np.mgrid[_LATTICE_PX // 2 : rows : _LATTICE_PX, _LATTICE_PX // 2 : columns : _LATTICE_PX]
    free = covered[y, x] == 0
    found = sites_at(np.stack([x[free], y[free]], axis=1).astype(np.float64).reshape(-1, 2), shape, window)
    return Sites(found.rows[found.inside], found.columns[found.inside], found.inside[found.inside], window)
