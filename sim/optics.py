"""What lens and projector do to light beside a Gaussian blur: shoulders, veil, lateral colour, fall-off.

**Point spread.** A share 1 − s of the light forms the core, a Gaussian of standard deviation σ, the photosite's
aperture included; a share s is spread further, over the core convolved with the shoulder

    w(r) = exp(−r / a) / (2π a²),

whose standard deviation along each axis is √3 a, the shoulder's scale. Its transfer function is
(1 + (2π a f)²)^(−3/2), so that the whole lens transfers, at f cycles per half-size pixel,

    MTF(f) = exp(−2π² σ² f²) · (1 − s + s · (1 + (2π a f)²)^(−3/2)).

An exponential is chosen because measured wings of photographic lenses, of spherical aberration and of light scattered
at glass and sensor, are straight lines on a logarithmic plot over some decades, and because it is no sum of
Gaussians: what fits Gaussians to it has to show how well. `MILD_SHOULDERS` and `STRONG_SHOULDERS` are two such
lenses.

**Veiling glare** (ISO 9358:1994, ISO 18844:2017): a share v of the light of the whole frame, backdrop included, lies
evenly on all of it, each camera channel by itself: (1 − v) · light + v · mean light. A uniform field keeps its light.

**Lateral chromatic aberration**: red and blue are magnified otherwise than green. At ρ of the way from the axis to
the frame's corner a channel's picture is shifted outwards against green's by d · ρ · (1 + ρ²) / 2, d at the corner:
half of it the chromatic difference of magnification, which is linear in the field, half the chromatic difference of
distortion, which is cubic (W. T. Welford, "Aberrations of Optical Systems", 1986, ch. 10). Half and half is chosen.

Half-size pixels, centres at integers, x right, y down.

**Fall-off** of the lens over the frame and of the projector over the page, both as the constants that
`sim.world.rendering.light` takes: 1 / (1 + c r²)² for the lens, which is cos⁴ of the angle to its axis, and g / (1 +
c d²) for each primary of the projector.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray


def lens_falloff(axis: tuple[float, float], size: tuple[int, int], lost: float) -> NDArray[np.float64]:
    """Return (3,) float64: x and y of the axis, photosites, and c, for a lens that loses a share at the corner."""
    corner2 = (size[0] ** 2 + size[1] ** 2) / 4
    return np.array([*axis, ((1 - lost) ** -0.5 - 1) / corner2])


def projector_falloff(
    page_mm: tuple[float, float], lost: float, difference: float, random: np.random.Generator
) -> NDArray[np.float64]:
    """Return (3, 4) float64: for each primary x and y of its brightest point, mm, c and a gain of 1."""
    page = np.array(page_mm)
    half_diagonal = float(np.hypot(*page)) / 2
    shares = lost * (1 + difference * np.array([-1.0, 0.0, 1.0]))
    aside = np.array([0.05, -0.1]) + difference * random.uniform(-0.5, 0.5, (3, 2))
    spots = page / 2 + half_diagonal * aside
    return np.column_stack([spots, shares / (1 - shares) / half_diagonal**2, np.ones(3)])


# Settings of a simulated room, chosen so that on an EOS 550D, of 4.29 µm a photosite, the MTF with the photosite's
# aperture is 0.96 at 10 and 0.73 at 30 lp/mm.
MILD_SHOULDERS: Final = {"blur_px": 0.46, "shoulder_share": 0.0116, "shoulder_px": 3.0}

STRONG_SHOULDERS: Final = {"blur_px": 0.535, "shoulder_share": 0.0452, "shoulder_px": 3.0}  # The same for 0.93 and 0.64

# Of the shoulder's kernel, in lengths a: 0.12 % of its light lies beyond, and is put back by its normalisation.
_REACH: Final = 9.0

_FINER: Final = 7  # Points across a pixel at which the kernel is averaged: its cusp is sharper than a pixel

# Of the inversion of a shift; each reduces the error by the shift's slope, below 10⁻² for shifts of some pixels.
_STEPS: Final = 6

APERTURE_VARIANCE: Final = 1 / 12  # Of a photosite's aperture, uniform over the photosite; photosites²


@dataclass(frozen=True)
class PhotographicLens:
    """A lens before a frame; its blur's core and its vignetting are drawn with the print.

    - `half_size`: rows and columns of the frame, half-size pixels; the optical axis meets its middle.
    - `shoulder_share`, `shoulder_px`: share of the light in the shoulders, and their standard deviation along each
      axis.
    - `veil`: share of the light in the veil.
    - `lateral_red_px`, `lateral_blue_px`: how far out the channel sees the frame's corner against green.
    """

    half_size: tuple[int, int]
    shoulder_share: float
    shoulder_px: float
    veil: float
    lateral_red_px: float
    lateral_blue_px: float

    @property
    def centre_px(self) -> tuple[float, float]:
        """Where the optical axis meets the frame, x then y."""
        rows, columns = self.half_size
        return (columns - 1) / 2, (rows - 1) / 2

    @property
    def corner_px(self) -> float:
        """From the optical axis to the frame's corner."""
        return math.hypot(*self.half_size) / 2

    @property
    def splits_colours(self) -> bool:
        """Whether red and blue are seen elsewhere than green."""
        return bool(self.lateral_red_px or self.lateral_blue_px)

    def shifted(self, green_px: NDArray[np.float64], channel: str) -> NDArray[np.float64]:
        """Return where a channel, ``R``, ``G`` or ``B``, sees what green sees at pixels (..., 2)."""
        at_corner = self._at_corner_px(channel)
        if not at_corner:
            return green_px
        away = green_px - np.array(self.centre_px)
        return np.array(self.centre_px) + away * self._magnified(away, at_corner)

    def unshifted(self, pixels: NDArray[np.float64], channel: str) -> NDArray[np.float64]:
        """Return where green sees what a channel sees at pixels (..., 2): `shifted` undone, within 10⁻⁶ px."""
        at_corner = self._at_corner_px(channel)
        if not at_corner:
            return pixels
        seen = pixels - np.array(self.centre_px)
        away = seen
        for _ in range(_STEPS):
            away = seen / self._magnified(away, at_corner)
        return np.array(self.centre_px) + away

    def _at_corner_px(self, channel: str) -> float:
        return {"R": self.lateral_red_px, "G": 0.0, "B": self.lateral_blue_px}[channel]

    def _magnified(self, away: NDArray[np.float64], at_corner: float) -> NDArray[np.float64]:
        """Return (..., 1): a channel's magnification over green's at (..., 2) px from the axis."""
        rho2 = (away**2).sum(axis=-1, keepdims=True) / self.corner_px**2
        return 1 + at_corner / self.corner_px * (1 + rho2) / 2

    def spread(self, light: NDArray[np.float32]) -> None:
        """Put a share of the light (primaries, rows, columns) of a Bayer mosaic's photosites into shoulders, in place.

        Each phase of the mosaic is a picture of half-size pixels. It was blurred by the core before it was sampled, so
        that what sampling folds back changes the shoulders by less than a thousandth of themselves. Beyond the frame
        its edge goes on.
        """
        if self.shoulder_share == 0:
            return
        from cv2 import BORDER_REPLICATE, filter2D

        kernel = self.kernel()
        for plane in light:
            for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):
                part = np.ascontiguousarray(plane[row::2, column::2])
                wide = np.asarray(filter2D(part, -1, kernel, borderType=BORDER_REPLICATE), dtype=np.float32)
                plane[row::2, column::2] = part + np.float32(self.shoulder_share) * (wide - part)

    def kernel(self) -> NDArray[np.float32]:
        """Return the shoulder w on half-size pixels.

        Returns (n, n) float32, n odd, the light of a point at the middle; its sum is 1.
        """
        length = self.shoulder_px / math.sqrt(3)
        reach = max(math.ceil(_REACH * length), 1)
        along = (np.arange((2 * reach + 1) * _FINER) - (_FINER - 1) / 2) / _FINER - reach
        fine = np.exp(-np.hypot(along[:, None], along) / length)
        pixels = fine.reshape(2 * reach + 1, _FINER, 2 * reach + 1, _FINER).sum(axis=(1, 3))
        return (pixels / pixels.sum()).astype(np.float32)

    def veiled(self, light: NDArray[np.float32], pattern: str) -> NDArray[np.float32]:
        """Spread a share of each channel's light evenly over the frame, in place, and return what was added.

        `light`: (primaries, rows, columns) float32, of a Bayer mosaic's photosites. Returns (primaries, 2, 2) float32:
        by the parity of row and column, the veil's light.
        """
        added = np.zeros((len(light), 2, 2), dtype=np.float32)
        if self.veil == 0:
            return added
        phases = [(k // 2, k % 2) for k in range(4)]
        means = np.array([light[:, row::2, column::2].mean(axis=(1, 2), dtype=np.float64) for row, column in phases])
        for letter in "RGB":
            same = [k for k in range(4) if pattern[k] == letter]
            for k in same:
                row, column = phases[k]
                added[:, row, column] = self.veil * means[same].mean(axis=0)
        light *= np.float32(1 - self.veil)
        for row, column in phases:
            light[:, row::2, column::2] += added[:, row, column, None, None]
        return added

    def unveiled(self, light: NDArray[np.float32], added: NDArray[np.float32], first_row: int) -> NDArray[np.float32]:
        """Return the light (primaries, rows, columns) of rows from `first_row` on without the veil that was added."""
        if self.veil == 0:
            return light
        row, column = np.mgrid[first_row : first_row + light.shape[1], : light.shape[2]]
        return (light - added[:, row % 2, column % 2]) / np.float32(1 - self.veil)
