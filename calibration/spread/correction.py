"""The correction: what surroundings add to each patch of a frame, and what is said of it.

What is subtracted from a patch's samples is one number for each channel: the light that the lens brought in, less what
it took away. The samples' noise is not touched. Levels of a frame are taken from the frame itself, as it is: the shares
were fitted on such levels, so that light which was spread twice is in them.

P patches as in `PrintedGrid`; counts above black; half-size pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from calibration import kernels
from calibration.registration.register import Registration
from calibration.sampling import Sites, sites_at
from calibration.spread.fitting import (
    FAR_PX,
    NEAR_PX,
    PLACES,
    TERMS,
    USUAL_VEIL,
    PointSpread,
    ReferenceData,
    SpreadData,
    channels_alike,
    far_groups,
    fit_spread,
    kernel_of_terms,
    place_terms,
    terms_of,
)
from calibration.spread.predicting import VARYING_BITS, LevelModel
from calibration.spread.surroundings import (
    FrameLevels,
    NearLight,
    PrintedGrid,
    Surroundings,
    UsualLight,
)
from drivers.raw.rawfile import CHANNELS
from experiment.measures.least_squares import page_polynomial, page_powers
from experiment.measures.paper import FlatField

_MARGIN_PX = 12.0  # How far from the sheet's edge what lies behind it is looked at

_LATTICE_PX = 24  # Distance of the places at which what lies behind the sheet is looked at

# References of one colour for each term of what is smooth over the page, at least, for them to say anything else.
_LEAST_REFERENCES = 3

_FIELD_ORDER = 6  # Highest order of the smooth change of white references by which a frame's field would change

_LEAST_LEVEL = 1e-3  # Level, bare paper 1, below which a cell's relative error is that of such a cell

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PrintView:
    """What holds for all frames of a session: the print's grid, its usual light, and where it is looked past.

    - `whites`: places of the white references among the patches.
    - `photosites_px`: (3, 2) float64, where each channel's photosites lie from a block's centre.
    - `frame_px`: rows and columns of the half-size frame.
    - `beyond`: places that show what lies behind the print; none where the print fills the frame.
    """

    grid: PrintedGrid
    whites: slice
    photosites_px: _Array
    frame_px: tuple[int, int]
    light: UsualLight
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

        `photosites_px`: (3, 2) float64, where each channel's photosites lie from a block's centre.
        """
        low, high = grid.points_mm.min(axis=0), grid.points_mm.max(axis=0)
        light = UsualLight.of(grid, field.at(grid.points_mm), field.at(np.clip(grid.slots_mm, low, high)))
        beyond = _places_beyond(grid, registration, shape, window)
        return PrintView(grid, whites, photosites_px, shape, light, beyond)

    def around(self, registration: Registration, cells: Sites, references: Sites) -> Surroundings:
        """Return the surroundings of the patches of a frame, given where they are sampled."""
        half, points = np.array(self.grid.pitch_mm) / 2, self.grid.points_mm
        across, down = (
            registration.to_pixels(points + half * axis) - registration.to_pixels(points - half * axis)
            for axis in (np.array([1.0, 0.0]), np.array([0.0, 1.0]))
        )
        pitch = np.stack([np.linalg.norm(across, axis=1), np.linalg.norm(down, axis=1)], axis=1)
        to_slots = np.linalg.inv(np.stack([across, down], axis=-1))
        columns = np.concatenate([cells.columns, references.columns])
        middle = np.stack([columns, np.concatenate([cells.rows, references.rows])], axis=1)
        seen = np.stack([registration.to_pixels(points, channel) for channel in CHANNELS], axis=1)
        from_centre = middle[:, None] + self.photosites_px - seen
        offset = np.einsum("nij,ncj->nci", to_slots, from_centre) * pitch[:, None]
        return Surroundings(
            grid=self.grid,
            window=cells.window,
            offset_px=np.ascontiguousarray(offset),
            pitch_px=pitch,
            frame_slots=float(np.prod(self.frame_px) / pitch.prod(axis=1).mean()),
            places=place_terms(middle.astype(np.float64), self.frame_px),
            whites=self.whites,
            light=self.light,
        )


@dataclass(frozen=True, eq=False)
class FrameCorrection:
    """The correction of frames that are sampled at the same places.

    - `far`, `veil`: shares of the far kernels (3, F), and of the veil (3,), by channel.
    """

    around: Surroundings
    near: NearLight
    far: _Array
    veil: _Array
    beyond: Sites

    @staticmethod
    def of(spread: PointSpread, view: PrintView, around: Surroundings) -> FrameCorrection:
        """Return the correction for a point spread and the surroundings of a frame's patches."""
        amounts, near = spread.amounts(), len(NEAR_PX)
        far, veil = amounts[0, :, near:-1], amounts[0, :, -1]
        return FrameCorrection(around, around.near(amounts[:, :, :near]), far, veil, view.beyond)

    def added(self, levels: FrameLevels) -> _Array:
        """Return what the lens added to each patch, (P, 3) float64 counts; negative where it took more away."""
        around, inks = self.around, self.around.inks(levels)
        added = self.near.at(levels, inks) - self.near.total * levels.patches
        if self.far.any():
            image, grid = around.image(levels, inks), around.grid
            for share, scale in zip(np.ascontiguousarray(self.far.T), FAR_PX, strict=True):
                if share.any():
                    blurred = around.blurred(image, scale)
                    kernels.add_far(blurred, grid.column, grid.row, share, levels.patches, added)
        if self.veil.any():
            added += self.veil * (around.mean(levels, inks) - levels.patches)
        return added


@dataclass(frozen=True, eq=False)
class SpreadFrame:
    """A frame that the point spread is measured on.

    - `field`: (P, 3) float64, its flat field at the patches.
    - `white`: (3,) float64 counts, its bare paper.
    - `usable`: (P,) bool, patches that are in the frame, not clipped and not covered.
    - `unevenness`: as in `SpreadData`.
    - `printed`: (P,) int64, which references have one colour: a number for each, −1 of cells; None where they are not
      used.
    - `frames`: of how many frames it is the mean.
    - `bend`: of each channel, as in `SpreadData`.
    """

    levels: FrameLevels
    field: _Array
    white: _Array
    usable: npt.NDArray[np.bool_]
    unevenness: float
    printed: npt.NDArray[np.int64] | None = None
    frames: int = 1
    bend: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class LensFigures:
    """What the correction comes to under the light of the frames that it was measured on; cells above 300 counts.

    - `rms`, `worst`: change of the cells' means relative to paper, RMS and the largest; 0 where nothing is corrected.
    - `residual`, `residual_worst`: RMS error that the means have after it, and that of the cell that it is largest of:
      by the shares' standard errors, proven or not, and by what is likely of the veil but not subtracted.
    - `worst_level`: level of that cell, bare paper 1.
    - `veil`, `veil_error`: likeliest share of the frame's mean light that lies on all of it, subtracted or not, and its
      standard error, of the channel in which both may come to most.
    - `beyond_cell`: share of the light of a window's worst sample that the kernels bring from beyond its cell, channel
      by channel the largest.
    - `left_in_worst`: the same beyond that of the window's mean, which is what is corrected.
    - `white_covariance`: (3, 3) float64, of the relative error that the lens leaves in the white of bare paper, the
      ground truth, in R, G and B: by the shares' covariance, and by all of what is likely but not subtracted. An
      assumed one, of a usual veil, where the lens is not measured.
    - `cells_error`: (C, 3) float64, relative standard error that it leaves in the means of cells, in the order of
      colour indices, against that white, under the light that is brightest in the channel; by the same covariance.
    - `measured`, `corrected`: whether the lens could be measured on the print, and whether samples and ground truth are
      corrected by it.
    - `why_not`: why nothing was measured or nothing is corrected; "" where it is.
    """

    rms: float
    worst: float
    residual: float
    residual_worst: float
    worst_level: float
    veil: float
    veil_error: float
    beyond_cell: float
    left_in_worst: float
    white_covariance: _Array
    cells_error: _Array
    measured: bool = True
    corrected: bool = True
    why_not: str = ""

    @staticmethod
    def unknown(why_not: str, levels: _Array) -> LensFigures:
        """Return the figures of a lens that could not be measured, and why.

        A veil of the usual size is assumed. `levels`: (C, 3) float64 of the cells, bare paper 1; NaN where not seen.
        """
        mean = np.nanmean(levels, axis=0)
        levels = np.where(np.isfinite(levels), levels, mean)
        white = USUAL_VEIL**2 * channels_alike() * np.outer(1 - mean, 1 - mean)
        cells = USUAL_VEIL * mean * np.abs(1 / np.maximum(levels, _LEAST_LEVEL) - 1)
        return LensFigures(
            *(0.0,) * 9,
            white_covariance=white,
            cells_error=cells,
            measured=False,
            corrected=False,
            why_not=why_not,
        )

    @property
    def uncorrected_in_worst(self) -> float:
        """Share of the worst sample's light from beyond its cell, but for the sharp core's, that is not corrected."""
        return max(self.left_in_worst, 0.0) if self.corrected else self.beyond_cell

    @property
    def is_left_in(self) -> bool:
        """Whether spread that the print shows is not corrected."""
        return self.measured and not self.corrected and self.beyond_cell > 0

    @property
    def left(self) -> float:
        """RMS error that the lens leaves in the means of cells, relative to paper."""
        return self._left(self.rms, self.residual)

    @property
    def left_worst(self) -> float:
        """The same of the cell that it is largest of."""
        return self._left(self.worst, self.residual_worst)

    def _left(self, size: float, residual: float) -> float:
        return residual if self.corrected or not self.beyond_cell else float(np.hypot(size, residual))

    @property
    def veil_at_most(self) -> float:
        """Share of the frame's mean light that the veil hardly exceeds: two standard errors above the likeliest."""
        return self.veil + 2 * self.veil_error

    def to_json(self) -> dict[str, Any]:
        """Return the figures as `lut.json` and `report.json` state them."""
        shares = [one.name for one in fields(self) if isinstance(getattr(self, one.name), float)]
        found: dict[str, Any] = {name: float(f"{getattr(self, name):.4g}") for name in shares}
        found |= {
            "white_covariance": [[float(f"{value:.4g}") for value in row] for row in self.white_covariance.tolist()],
            "assumed": not self.measured,
        }
        return {"measured": self.measured, "corrected": self.corrected, "why_not": self.why_not, **found}


@dataclass(frozen=True, eq=False)
class LensCorrection:
    """The lens of a session: its point spread, what is said of it, and the view by which frames are corrected."""

    view: PrintView
    spread: PointSpread
    figures: LensFigures

    def correction(self) -> dict[str, Any]:
        """Return what was done, for `lut.json`."""
        return {
            "name": "lens",
            "how": "subtracted from samples, ground truth and references before the field is divided out, one number "
            "for each patch and channel: sum over kernels k of share[k] (B_k - m) + share[veil] (M - m); m the patch's "
            "mean in the frame, B_k the print as the frame shows it, blurred by a Gaussian of sigma_px[k] half-size px "
            "and averaged over the patch's window, M the frame's mean light; share[term][channel][kernel], terms "
            "P_i(x) P_j(y) over the frame, Legendre, j rising slowest, i, j 0 ... 2, x, y -1 ... 1; the last kernel is "
            "the veil; samples' noise is not touched; build-lut --no-lens-correction leaves it out",
            **self.figures.to_json(),
            **self.spread.to_json(),
        }

    def of(self, registration: Registration, cells: Sites, references: Sites) -> FrameCorrection:
        """Return the correction of frames that are sampled at these places."""
        return FrameCorrection.of(self.spread, self.view, self.view.around(registration, cells, references))


def measure_spread(
    frames: list[SpreadFrame],
    around: Surroundings,
    page_mm: tuple[float, float],
    bits: int,
    least_counts: float,
    left_out: str = "",
) -> tuple[PointSpread, LensFigures] | None:
    """Return the point spread that frames show, and its figures; None where no frame is bright enough.

    `least_counts`: counts of bare paper from which on a channel is used, and of a cell from which on figures count it.
    `left_out`: why frames are not corrected by it though it is proven; "" where they are.
    """
    if not frames:
        return None
    count = 8**bits
    data: list[SpreadData] = []
    scales: list[_Array] = []
    of_paper: dict[int, _Array] = {}
    references: list[ReferenceData] = []
    # All of a near kernel, the same over the frame, and nothing of the others.
    whole = np.zeros((len(NEAR_PX), PLACES, 3, len(NEAR_PX)))
    whole[:, 0] = np.eye(len(NEAR_PX))[:, None]
    near = [around.near(amounts) for amounts in whole]
    # Of each channel the frame in which it has most light, of all frames that it is the mean of.
    best = np.argmax([frame.white * frame.frames for frame in frames], axis=0)
    for number, frame in enumerate(frames):
        bright = np.flatnonzero((best == number) & (frame.white >= least_counts))
        if not len(bright):
            continue
        seen, inks = _seen(frame, around, near), around.inks(frame.levels)
        even = around.mean(frame.levels, inks)
        for channel in bright.tolist():
            changes, gains, of_paper[channel] = _changes(frame, around, seen, page_mm, bits, channel)
            relative = frame.field[:count, channel] * frame.white[channel]
            level = frame.levels.patches[:count, channel] / relative
            usable = frame.usable[:count]
            data.append(
                SpreadData(
                    channel, level, changes[:, :count].T, even[channel] / relative, frame.field[:count, channel],
                    usable, frame.unevenness, frame.bend[channel],
                )
            )  # fmt: skip
            if bits < VARYING_BITS:
                references += _references(frame, around, channel, changes.T)
            scales.append(np.append(gains, frame.white[channel]))
    if not data:
        return None
    spread = fit_spread(data, around.grid.points_mm[:count], page_mm, bits, references)
    if spread is None:
        return None
    return spread, _figures(spread, data, scales, of_paper, around, bits, least_counts, left_out)


def _references(frame: SpreadFrame, around: Surroundings, channel: int, changes: _Array) -> list[ReferenceData]:
    """Return a channel's references, colour by colour; `changes` (P, T)."""
    if frame.printed is None:
        return []
    found: list[ReferenceData] = []
    level = frame.levels.patches[:, channel] / np.maximum(frame.field[:, channel] * frame.white[channel], 1e-6)
    whites = np.zeros(len(level), dtype=np.bool_)
    whites[around.whites] = True
    for number in range(int(frame.printed.max()) + 1):
        chosen = np.flatnonzero((frame.printed == number) & frame.usable)
        order = _white_order(len(chosen)) if whites[chosen].any() else 1
        if len(chosen) >= _LEAST_REFERENCES * len(page_powers(order)):
            places = around.grid.points_mm[chosen]
            field = frame.field[chosen, channel]
            found.append(ReferenceData(channel, level[chosen], changes[chosen], field, places, order))
    return found


def _white_order(count: int) -> int:
    """Return the order of the smooth change that so many white references show."""
    return next((n for n in range(_FIELD_ORDER, 0, -1) if 3 * len(page_powers(n)) <= count), 0)


def _changes(
    frame: SpreadFrame,
    around: Surroundings,
    seen: list[tuple[_Array, _Array]],
    page_mm: tuple[float, float],
    bits: int,
    channel: int,
) -> tuple[_Array, _Array, _Array]:
    """Return what a whole share of each unknown changes in a channel.

    The change (T, P) of its levels: what comes in, less what the white references get, since the field is fitted
    through them. Their mean (T,), by which all levels change alike. The relative change (T,) of white itself: that
    mean, less what a patch loses. `seen` is what `_seen` returns.
    """
    count, points = 8**bits, around.grid.points_mm
    seen_levels = frame.levels.patches[:, channel]
    relative = np.maximum(frame.field[:, channel] * frame.white[channel], 1e-6)
    expected = seen_levels / relative
    expected[:count] = LevelModel.of(expected[:count], frame.usable[:count], bits).predicted
    if frame.printed is not None:
        for number in range(int(frame.printed.max()) + 1):
            expected[frame.printed == number] = np.median(expected[frame.printed == number])
    whites = np.arange(len(points))[around.whites]
    whites = whites[frame.usable[whites]]
    at_all = page_polynomial(points, page_mm, _white_order(len(whites)))
    terms = kernel_of_terms()
    coming, differs = np.empty((2, len(terms), len(points)))
    lost = np.empty(len(terms))
    for term, (kernel, place) in enumerate(terms):
        light, own = (part[:, channel] for part in seen[kernel])
        np.divide(light - own * seen_levels, relative, out=coming[term])
        np.subtract(own, own[:count].mean(), out=differs[term])
        lost[term] = 1 - own[:count].mean()
        if place is not None:
            lost[term] *= around.places[whites, place].mean()
            coming[term] *= around.places[:, place]
            differs[term] *= around.places[:, place]
    of_white = (coming[:, whites] + differs[:, whites]).T
    smooth = (at_all @ np.linalg.lstsq(at_all[whites], of_white, rcond=None)[0]).T
    gains = smooth[:, :count].mean(axis=1)
    smooth -= gains[:, None]
    differs -= smooth
    differs *= expected
    coming += differs
    return coming, gains, gains - lost


def _seen(frame: SpreadFrame, around: Surroundings, near: list[NearLight]) -> list[tuple[_Array, _Array]]:
    """Return for each kernel the light (P, 3) that it brings, counts, and the share (P, 3) of a patch's own in it."""
    levels = frame.levels
    inks = around.inks(levels)
    image = around.image(levels, inks)
    found = [(one.at(levels, inks), one.own) for one in near]
    found += [(around.far(image, scale), np.full_like(levels.patches, around.own_share(scale))) for scale in FAR_PX]
    even = np.broadcast_to(around.mean(levels, inks), levels.patches.shape)
    return [*found, (even, np.zeros_like(levels.patches))]


def _figures(
    spread: PointSpread,
    data: list[SpreadData],
    scales: list[_Array],
    of_paper: dict[int, _Array],
    around: Surroundings,
    bits: int,
    least_counts: float,
    left_out: str,
) -> LensFigures:
    amounts = spread.amounts()
    corrected: list[_Array] = []
    unknown: list[_Array] = []
    levels: list[_Array] = []
    mean_square = spread.unexplained
    off_by = spread.off_by(np.zeros(TERMS)) if left_out else mean_square
    cells: dict[int, _Array] = {}
    for one, scale in zip(data, scales, strict=True):
        expected = LevelModel.of(one.level, one.usable, bits).predicted
        lit = one.usable & (one.level * scale[-1] > least_counts)
        # All of the change: with white's mean, by which a level over paper's changes too.
        change = (one.changes[lit] - np.outer(expected[lit], scale[:-1])) / one.level[lit, None]
        terms = terms_of(one.channel)
        corrected.append(change @ spread.shares[terms])
        unknown.append(((change @ mean_square[np.ix_(terms, terms)]) * change).sum(axis=1))
        levels.append(one.level[lit])
        change = one.changes / np.maximum(one.level, _LEAST_LEVEL)[:, None] - scale[:-1]
        cells[one.channel] = np.sqrt(((change @ off_by[np.ix_(terms, terms)]) * change).sum(axis=1))
    size, left, level = np.concatenate(corrected), np.concatenate(unknown), np.concatenate(levels)
    worst, mean = _beyond_cell(around)
    near = amounts[:, :, : len(NEAR_PX)]
    wide = amounts[:, :, len(NEAR_PX) :].sum(axis=2)
    nothing = len(size) == 0
    subtracted = spread.proven and not left_out
    veils = far_groups()[-1]
    veil, veil_error = spread.likeliest[veils], np.sqrt(np.diag(spread.covariance)[veils])
    largest = int(np.argmax(veil + 2 * veil_error))
    # Of a channel that is too dark to measure on, what the brightest of the others has.
    other = data[int(np.argmax([scale[-1] for scale in scales]))].channel
    return LensFigures(
        rms=0.0 if nothing else float(np.sqrt((size**2).mean())),
        worst=0.0 if nothing else float(np.abs(size).max()),
        residual=0.0 if nothing else float(np.sqrt(left.mean())),
        residual_worst=0.0 if nothing else float(np.sqrt(left.max())),
        worst_level=0.0 if nothing else float(level[np.argmax(left)]),
        veil=float(veil[largest]),
        veil_error=float(veil_error[largest]),
        beyond_cell=float((near @ worst + wide).max()),
        left_in_worst=float((near @ (worst - mean)).max()),
        white_covariance=_of_white(off_by, [of_paper.get(channel, of_paper[other]) for channel in range(3)]),
        cells_error=np.stack([cells.get(channel, cells[other]) for channel in range(3)], axis=1),
        corrected=subtracted,
        why_not="" if subtracted else left_out if spread.proven else "no spread beside the sharp core is proven",
    )


def _of_white(off_by: _Array, of_paper: list[_Array]) -> _Array:
    """Return the covariance (3, 3) of paper white's relative errors, by its change (T,) for whole shares by channel."""
    change = np.zeros((3, TERMS))
    for channel in range(3):
        change[channel, terms_of(channel)] = of_paper[channel]
    # What leaves the frame is no error: it dims all that a channel sees alike, as the glass does.
    return change @ off_by @ change.T


def _beyond_cell(around: Surroundings) -> tuple[_Array, _Array]:
    """Return the share (N,) of each near kernel from beyond a cell, in the worst sample and in the mean of a window."""
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
    rows, columns = shape
    width, height = grid.pitch_mm
    # The outermost patches, and from them straight on to the sheet's edge and a margin.
    low, high = grid.points_mm.min(axis=0), grid.points_mm.max(axis=0)
    sheet = grid.slots_mm[grid.others[..., 2].ravel() < 0.5]
    low, high = np.minimum(low, sheet.min(axis=0)), np.maximum(high, sheet.max(axis=0))
    half = np.array([width, height]) / 2
    low, high = low - half, high + half
    along = np.linspace(0, 1, 40)[:, None]
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]], low])
    outline = np.concatenate([a + (b - a) * along for a, b in pairwise(corners)])
    edge = registration.to_pixels(outline)
    covered = np.zeros((rows, columns), dtype=np.uint8)
    cv2.fillPoly(covered, [np.rint(edge).astype(np.int32).reshape(-1, 1, 2)], 1)
    reach = 2 * int(_MARGIN_PX) + 1
    covered = cv2.dilate(covered, np.ones((reach, reach), dtype=np.uint8))
    y, x = np.mgrid[_LATTICE_PX // 2 : rows : _LATTICE_PX, _LATTICE_PX // 2 : columns : _LATTICE_PX]
    free = covered[y, x] == 0
    found = sites_at(np.stack([x[free], y[free]], axis=1).astype(np.float64).reshape(-1, 2), shape, window)
    return Sites(found.rows[found.inside], found.columns[found.inside], found.inside[found.inside], window)
