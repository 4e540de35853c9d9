"""Correct the light that the lens scatters from the surroundings into each patch, and report the result.

The correction subtracts one number per patch and channel from the samples: the light that the lens added, minus the
light that it removed. The noise of samples is unchanged. The light is calculated from the levels of the uncorrected
frame. `calibration.spread.fitting` defines near and far kernels, their shares, and the T unknowns of a channel.

Levels are counts above black level; lengths are half-size pixels; P is the number of patches in `PrintedGrid`.
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
    FRAME_TERMS,
    NEAR_PX,
    TERMS,
    USUAL_VEIL,
    PointSpread,
    ReferenceData,
    SpreadData,
    channel_terms,
    channels_alike,
    far_groups,
    fit_spread,
    frame_terms,
    kernel_of_terms,
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

_MARGIN_PX = 12.0  # minimum distance of background samples from the edge of the sheet

_LATTICE_PX = 24  # distance between neighbouring background samples

# Minimum number of references of one colour, per coefficient of the polynomial that is removed from their levels.
_MIN_REFERENCES = 3

# Highest order of the polynomial over the page for white references. The flat field is fitted to these references, so
# smooth changes of their levels are part of the flat field.
_FIELD_ORDER = 6

_MIN_LEVEL = 1e-3  # lower bound of levels as divisors of relative errors

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PrintView:
    """Properties common to all frames of a session: grid of the print, first flat field, background samples."""

    grid: PrintedGrid
    whites: slice  # indices of the white references
    photosites_px: _Array  # (3, 2) offset of the photosites of each channel from the centre of a block
    frame_px: tuple[int, int]  # rows and columns of the half-size frame
    light: UsualLight
    background: Sites  # positions of background samples; empty if the print fills the frame

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
        """Return the view of a session; `field`: flat field of its first frame."""
        low, high = grid.points_mm.min(axis=0), grid.points_mm.max(axis=0)
        light = UsualLight.of(grid, field.at(grid.points_mm), field.at(np.clip(grid.slots_mm, low, high)))
        background = _background_sites(grid, registration, shape, window)
        return PrintView(grid, whites, photosites_px, shape, light, background)

    def around(self, registration: Registration, cells: Sites, references: Sites) -> Surroundings:
        """Return the surroundings of the patches of a frame from their sampling positions."""
        half, points = np.array(self.grid.pitch_mm) / 2, self.grid.points_mm
        across, down = (
            registration.to_pixels(points + half * axis) - registration.to_pixels(points - half * axis)
            for axis in (np.array([1.0, 0.0]), np.array([0.0, 1.0]))
        )
        pitch = np.stack([np.linalg.norm(across, axis=1), np.linalg.norm(down, axis=1)], axis=1)
        to_slots = np.linalg.inv(np.stack([across, down], axis=-1))
        columns = np.concatenate([cells.columns, references.columns])
        window_px = np.stack([columns, np.concatenate([cells.rows, references.rows])], axis=1)
        channel_px = np.stack([registration.to_pixels(points, channel) for channel in CHANNELS], axis=1)
        from_centre = window_px[:, None] + self.photosites_px - channel_px
        offset = np.einsum("nij,ncj->nci", to_slots, from_centre) * pitch[:, None]
        return Surroundings(
            grid=self.grid,
            window=cells.window,
            offset_px=np.ascontiguousarray(offset),
            pitch_px=pitch,
            frame_slots=float(np.prod(self.frame_px) / pitch.prod(axis=1).mean()),
            places=frame_terms(window_px.astype(np.float64), self.frame_px),
            whites=self.whites,
            light=self.light,
        )


@dataclass(frozen=True, eq=False)
class FrameCorrection:
    """Correction of frames with the same sampling positions."""

    around: Surroundings
    near: NearLight
    far: _Array  # (3, F) shares of far kernels by channel
    veil: _Array  # (3,) shares of veiling glare by channel
    background: Sites

    @staticmethod
    def of(spread: PointSpread, view: PrintView, around: Surroundings) -> FrameCorrection:
        """Return the correction for a point spread and the surroundings of a frame's patches."""
        amounts, near = spread.amounts(), len(NEAR_PX)
        far, veil = amounts[0, :, near:-1], amounts[0, :, -1]
        return FrameCorrection(around, around.near(amounts[:, :, :near]), far, veil, view.background)

    def added(self, levels: FrameLevels) -> _Array:
        """Return the light that the lens added to each patch minus the light that it removed, (P, 3) float64 counts."""
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
    """A frame for measuring the point spread."""

    levels: FrameLevels
    field: _Array  # (P, 3) flat field at the patches
    white: _Array  # (3,) counts of paper
    usable: npt.NDArray[np.bool_]  # (P,) patches in the frame that are not clipped or covered
    unevenness: float  # as in `SpreadData`
    # (P,) colour number of each reference, −1 for patches; None: references are not used
    printed: npt.NDArray[np.int64] | None = None
    frames: int = 1  # number of averaged frames
    bend: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of each channel, as in `SpreadData`


@dataclass(frozen=True, eq=False)
class LensFigures:
    """Effect of the lens and its correction under the illuminants of the measurement, for patches above 300 counts."""

    rms: float  # RMS change of patch means relative to paper; 0 without correction
    worst: float  # largest change of a patch mean
    # RMS error of patch means after correction: uncertainty of the shares and uncorrected veiling glare
    residual: float
    residual_worst: float  # error of the mean of the worst patch after correction
    worst_level: float  # level of the worst patch relative to paper
    veil: float  # most likely veiling glare relative to the mean light of the frame, worst channel
    veil_error: float  # standard uncertainty of `veil`
    beyond_cell: float  # share of light from outside of the patch, in the worst sample
    left_in_worst: float  # `beyond_cell` minus the mean of this share in the window; this part is not corrected
    # (3, 3) covariance of the relative errors of white (ground truth), with usual veiling glare if not measured
    white_covariance: _Array
    # (C, 3) standard uncertainty of patch means relative to white, in the brightest frame of each channel
    cells_error: _Array
    measured: bool = True  # whether the lens could be measured
    corrected: bool = True  # whether samples and ground truth are corrected
    why_not: str = ""  # reason for a missing measurement or correction, or ""

    @staticmethod
    def unknown(why_not: str, levels: _Array) -> LensFigures:
        """Return the figures of a lens that could not be measured, with usual veiling glare.

        `levels`: (C, 3) float64 of the patches, relative to paper; NaN if not visible.
        """
        mean = np.nanmean(levels, axis=0)
        levels = np.where(np.isfinite(levels), levels, mean)
        white = USUAL_VEIL**2 * channels_alike() * np.outer(1 - mean, 1 - mean)
        cells = USUAL_VEIL * mean * np.abs(1 / np.maximum(levels, _MIN_LEVEL) - 1)
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
        """Share of light from outside of the patch that is not corrected, in the worst sample."""
        return max(self.left_in_worst, 0.0) if self.corrected else self.beyond_cell

    @property
    def is_uncorrected(self) -> bool:
        """Whether measured spread is not corrected."""
        return self.measured and not self.corrected and self.beyond_cell > 0

    @property
    def remaining_rms(self) -> float:
        """RMS error of patch means that the lens still causes, relative to paper."""
        return self._remaining(self.rms, self.residual)

    @property
    def remaining_worst(self) -> float:
        """Error of the worst patch that the lens still causes, relative to paper."""
        return self._remaining(self.worst, self.residual_worst)

    def _remaining(self, size: float, residual: float) -> float:
        return residual if self.corrected or not self.beyond_cell else float(np.hypot(size, residual))

    @property
    def veil_at_most(self) -> float:
        """Upper bound of veiling glare: two standard uncertainties above the most likely value."""
        return self.veil + 2 * self.veil_error

    def to_json(self) -> dict[str, Any]:
        """Return the figures in the form of `lut.json` and `report.json`."""
        names = [field.name for field in fields(self) if isinstance(getattr(self, field.name), float)]
        values: dict[str, Any] = {name: float(f"{getattr(self, name):.4g}") for name in names}
        values |= {
            "white_covariance": [[float(f"{value:.4g}") for value in row] for row in self.white_covariance.tolist()],
            "assumed": not self.measured,
        }
        return {"measured": self.measured, "corrected": self.corrected, "why_not": self.why_not, **values}


@dataclass(frozen=True, eq=False)
class LensCorrection:
    """Lens of a session: point spread, figures, and the view for correcting frames."""

    view: PrintView
    spread: PointSpread
    figures: LensFigures

    def correction(self) -> dict[str, Any]:
        """Return the entry of `lut.json`."""
        return {
            "name": "lens",
            "how": "subtracted from samples, ground truth and references before division by the field, one number per "
            "patch and channel: sum over kernels k of share[k] (B_k - m) + share[veil] (M - m); m mean of the patch in "
            "the frame, B_k print in the frame, blurred by a Gaussian of sigma_px[k] half-size px and averaged over "
            "the window of the patch, M mean light of the frame; share[term][channel][kernel], terms P_i(x) P_j(y) "
            "over the frame, Legendre, j slowest, i, j 0 ... 2, x, y -1 ... 1; the last kernel is veiling glare; the "
            "noise of samples is unchanged; build-lut --no-lens-correction omits this correction",
            **self.figures.to_json(),
            **self.spread.to_json(),
        }

    def of(self, registration: Registration, cells: Sites, references: Sites) -> FrameCorrection:
        """Return the correction of frames with these sampling positions."""
        return FrameCorrection.of(self.spread, self.view, self.view.around(registration, cells, references))


def measure_spread(
    frames: list[SpreadFrame],
    around: Surroundings,
    page_mm: tuple[float, float],
    bits: int,
    least_counts: float,
    reason_uncorrected: str = "",
) -> tuple[PointSpread, LensFigures] | None:
    """Measure the point spread on frames; None if no frame is bright enough.

    `least_counts`: minimum counts of paper in a used channel, and of patches in the figures. `reason_uncorrected`:
    reason why a proven spread is not corrected, or "".
    """
    if not frames:
        return None
    count = 8**bits
    data: list[SpreadData] = []
    scales: list[_Array] = []
    paper_changes: dict[int, _Array] = {}
    references: list[ReferenceData] = []
    # One set of shares for each near kernel: its share is 1 in the whole frame, and all other shares are 0.
    unit_shares = np.zeros((len(NEAR_PX), FRAME_TERMS, 3, len(NEAR_PX)))
    unit_shares[:, 0] = np.eye(len(NEAR_PX))[:, None]
    near = [around.near(amounts) for amounts in unit_shares]
    # Each channel is measured in its brightest frame; an average of n frames counts as n times as bright.
    brightest = np.argmax([frame.white * frame.frames for frame in frames], axis=0)
    for index, frame in enumerate(frames):
        channels = np.flatnonzero((brightest == index) & (frame.white >= least_counts))
        if not len(channels):
            continue
        light, inks = _kernel_light(frame, around, near), around.inks(frame.levels)
        even = around.mean(frame.levels, inks)
        for channel in channels.tolist():
            changes, gains, paper_changes[channel] = _changes(frame, around, light, page_mm, bits, channel)
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
                references += _reference_data(frame, around, channel, changes.T)
            scales.append(np.append(gains, frame.white[channel]))
    if not data:
        return None
    spread = fit_spread(data, around.grid.points_mm[:count], page_mm, bits, references)
    if spread is None:
        return None
    return spread, _figures(spread, data, scales, paper_changes, around, bits, least_counts, reason_uncorrected)


def _reference_data(frame: SpreadFrame, around: Surroundings, channel: int, changes: _Array) -> list[ReferenceData]:
    if frame.printed is None:
        return []
    references: list[ReferenceData] = []
    level = frame.levels.patches[:, channel] / np.maximum(frame.field[:, channel] * frame.white[channel], 1e-6)
    whites = np.zeros(len(level), dtype=np.bool_)
    whites[around.whites] = True
    for colour in range(int(frame.printed.max()) + 1):
        selected = np.flatnonzero((frame.printed == colour) & frame.usable)
        order = _white_order(len(selected)) if whites[selected].any() else 1
        if len(selected) >= _MIN_REFERENCES * len(page_powers(order)):
            positions_mm = around.grid.points_mm[selected]
            field = frame.field[selected, channel]
            references.append(ReferenceData(channel, level[selected], changes[selected], field, positions_mm, order))
    return references


def _white_order(count: int) -> int:
    return next((n for n in range(_FIELD_ORDER, 0, -1) if 3 * len(page_powers(n)) <= count), 0)


def _changes(
    frame: SpreadFrame,
    around: Surroundings,
    light: list[tuple[_Array, _Array]],
    page_mm: tuple[float, float],
    bits: int,
    channel: int,
) -> tuple[_Array, _Array, _Array]:
    """Return the effects on a channel of T unknowns, each with the share 1.

    1. (T, P), change of levels: added light minus the change of the flat field, which is fitted to white references.
    2. (T,), mean change of the white references.
    3. (T,), relative change of the counts of paper: the second value minus the light that a patch loses.
    """
    count, points = 8**bits, around.grid.points_mm
    levels = frame.levels.patches[:, channel]
    relative = np.maximum(frame.field[:, channel] * frame.white[channel], 1e-6)
    expected = levels / relative
    expected[:count] = LevelModel.of(expected[:count], frame.usable[:count], bits).predicted
    if frame.printed is not None:
        for colour in range(int(frame.printed.max()) + 1):
            expected[frame.printed == colour] = np.median(expected[frame.printed == colour])
    whites = np.arange(len(points))[around.whites]
    whites = whites[frame.usable[whites]]
    page_terms = page_polynomial(points, page_mm, _white_order(len(whites)))
    terms = kernel_of_terms()
    added, deviation = np.empty((2, len(terms), len(points)))
    loss = np.empty(len(terms))
    for term, (kernel, place) in enumerate(terms):
        incoming, own = (values[:, channel] for values in light[kernel])
        np.divide(incoming - own * levels, relative, out=added[term])
        np.subtract(own, own[:count].mean(), out=deviation[term])
        loss[term] = 1 - own[:count].mean()
        if place is not None:
            loss[term] *= around.places[whites, place].mean()
            added[term] *= around.places[:, place]
            deviation[term] *= around.places[:, place]
    at_whites = (added[:, whites] + deviation[:, whites]).T
    smooth = (page_terms @ np.linalg.lstsq(page_terms[whites], at_whites, rcond=None)[0]).T
    gains = smooth[:, :count].mean(axis=1)
    smooth -= gains[:, None]
    deviation -= smooth
    deviation *= expected
    added += deviation
    return added, gains, gains - loss


def _kernel_light(frame: SpreadFrame, around: Surroundings, near: list[NearLight]) -> list[tuple[_Array, _Array]]:
    """Return for each kernel its light at the patches (P, 3), counts, and the weight (P, 3) of the patch itself."""
    levels = frame.levels
    inks = around.inks(levels)
    image = around.image(levels, inks)
    results = [(kernel.at(levels, inks), kernel.own) for kernel in near]
    results += [(around.far(image, scale), np.full_like(levels.patches, around.own_share(scale))) for scale in FAR_PX]
    even = np.broadcast_to(around.mean(levels, inks), levels.patches.shape)
    return [*results, (even, np.zeros_like(levels.patches))]


def _figures(
    spread: PointSpread,
    data: list[SpreadData],
    scales: list[_Array],
    paper: dict[int, _Array],
    around: Surroundings,
    bits: int,
    least_counts: float,
    reason: str,
) -> LensFigures:
    amounts = spread.amounts()
    corrected: list[_Array] = []
    error2: list[_Array] = []
    levels: list[_Array] = []
    mean_square = spread.unexplained
    total_error = spread.mean_square_error(np.zeros(TERMS)) if reason else mean_square
    cells: dict[int, _Array] = {}
    for item, scale in zip(data, scales, strict=True):
        expected = LevelModel.of(item.level, item.usable, bits).predicted
        is_bright = item.usable & (item.level * scale[-1] > least_counts)
        # Levels are relative to paper, so the mean change of the white references is subtracted.
        change = (item.changes[is_bright] - np.outer(expected[is_bright], scale[:-1])) / item.level[is_bright, None]
        terms = channel_terms(item.channel)
        corrected.append(change @ spread.shares[terms])
        error2.append(((change @ mean_square[np.ix_(terms, terms)]) * change).sum(axis=1))
        levels.append(item.level[is_bright])
        change = item.changes / np.maximum(item.level, _MIN_LEVEL)[:, None] - scale[:-1]
        cells[item.channel] = np.sqrt(((change @ total_error[np.ix_(terms, terms)]) * change).sum(axis=1))
    correction, error, level = np.concatenate(corrected), np.concatenate(error2), np.concatenate(levels)
    worst, mean = _beyond_cell(around)
    near = amounts[:, :, : len(NEAR_PX)]
    wide = amounts[:, :, len(NEAR_PX) :].sum(axis=2)
    is_empty = len(correction) == 0
    subtracted = spread.proven and not reason
    veils = far_groups()[-1]
    veil, veil_error = spread.likeliest[veils], np.sqrt(np.diag(spread.covariance)[veils])
    worst_channel = int(np.argmax(veil + 2 * veil_error))
    # A channel that is too dark for a measurement gets the values of the brightest channel.
    best = data[int(np.argmax([scale[-1] for scale in scales]))].channel
    return LensFigures(
        rms=0.0 if is_empty else float(np.sqrt((correction**2).mean())),
        worst=0.0 if is_empty else float(np.abs(correction).max()),
        residual=0.0 if is_empty else float(np.sqrt(error.mean())),
        residual_worst=0.0 if is_empty else float(np.sqrt(error.max())),
        worst_level=0.0 if is_empty else float(level[np.argmax(error)]),
        veil=float(veil[worst_channel]),
        veil_error=float(veil_error[worst_channel]),
        beyond_cell=float((near @ worst + wide).max()),
        left_in_worst=float((near @ (worst - mean)).max()),
        white_covariance=_white_covariance(total_error, [paper.get(channel, paper[best]) for channel in range(3)]),
        cells_error=np.stack([cells.get(channel, cells[best]) for channel in range(3)], axis=1),
        corrected=subtracted,
        why_not="" if subtracted else reason if spread.proven else "no spread outside of the sharp core is proven",
    )


def _white_covariance(shares_error: _Array, paper_changes: list[_Array]) -> _Array:
    """Return the covariance (3, 3) of the relative errors of paper, from its changes (T,) in each channel."""
    change = np.zeros((3, TERMS))
    for channel in range(3):
        change[channel, channel_terms(channel)] = paper_changes[channel]
    # Light that leaves the frame causes no error, because it makes all patches of a channel darker by the same factor.
    return change @ shares_error @ change.T


def _beyond_cell(around: Surroundings) -> tuple[_Array, _Array]:
    """Return the fraction (N,) of each near kernel outside of the patch: in the worst sample, and on average."""
    cell, reach = float(around.pitch_px.min()), around.window // 2
    worst, mean = np.empty(len(NEAR_PX)), np.empty(len(NEAR_PX))
    # The worst sample is a corner pixel, with 0.5 px of rounding towards the corner.
    for kernel, scale in enumerate(NEAR_PX):
        offsets = np.arange(-reach, reach + 1) + 0.5
        inside = ndtr((cell / 2 - offsets) / scale) - ndtr((-cell / 2 - offsets) / scale)
        worst[kernel] = 1 - inside[-1] ** 2
        mean[kernel] = 1 - inside.mean() ** 2
    return worst, mean


def _background_sites(grid: PrintedGrid, registration: Registration, shape: tuple[int, int], window: int) -> Sites:
    rows, columns = shape
    width, height = grid.pitch_mm
    # Background samples must be outside of the sheet and of a margin around it.
    low, high = grid.points_mm.min(axis=0), grid.points_mm.max(axis=0)
    sheet = grid.slots_mm[grid.blank_shares[..., 2].ravel() < 0.5]
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
    sites = sites_at(np.stack([x[free], y[free]], axis=1).astype(np.float64).reshape(-1, 2), shape, window)
    return Sites(sites.rows[sites.inside], sites.columns[sites.inside], sites.inside[sites.inside], window)
