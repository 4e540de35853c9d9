"""Optical effects of lens and projector: wide tails of the point spread, veiling glare, lateral colour and fall-off.

**Point spread.** The point spread has a core and wide tails, called shoulders. The core is a Gaussian of standard
deviation σ, which includes the aperture of the photosite. The shoulders contain the share s of the light. They are the
core convolved with

    w(r) = exp(−r / a) / (2π a²).

The standard deviation of w along each axis is √3 a, which is the parameter `shoulder_px`. The modulation transfer
function at f cycles per half-size pixel is

    MTF(f) = exp(−2π² σ² f²) · (1 − s + s · (1 + (2π a f)²)^(−3/2)).

The shoulders are exponential, because the measured tails of photographic lenses are straight lines on a logarithmic
plot. Gaussian shoulders would give an advantage to software that fits Gaussians.

**Veiling glare** (ISO 9358:1994, ISO 18844:2017). The lens distributes a share v of the light uniformly over the frame.
Each camera channel becomes (1 − v) · light + v · mean light, where the mean includes the background.

**Lateral chromatic aberration.** The lens magnifies red and blue differently from green. Let ρ be the distance from the
axis relative to the corner, and d the shift in the corner. Then red or blue is shifted outwards by d · ρ · (1 + ρ²) / 2
relative to green. The linear term is the chromatic difference of magnification, the cubic term the chromatic difference
of distortion (W. T. Welford, "Aberrations of Optical Systems", 1986, ch. 10). Equal weights of both terms are an
assumption.

**Fall-off.** The lens transmits 1 / (1 + c r²)² at the distance r from the axis. This is cos⁴ of the angle to the axis.
A primary of the projector has the light g / (1 + c d²) at the distance d from its brightest point, with the gain g.
`sim.world.rendering.light` applies both.

Positions are half-size pixels, centres at integers, x right, y down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray


def lens_falloff(axis: tuple[float, float], size: tuple[int, int], lost: float) -> NDArray[np.float64]:
    """Return (3,) float64: x, y of the axis, photosites, and c. `lost`: share of the light lost in the corners."""
    corner2 = (size[0] ** 2 + size[1] ** 2) / 4
    return np.array([*axis, ((1 - lost) ** -0.5 - 1) / corner2])


def projector_falloff(
    page_mm: tuple[float, float], lost: float, difference: float, random: np.random.Generator
) -> NDArray[np.float64]:
    """Return (3, 4) float64: for each primary x, y of its brightest point, in mm, then c, and a gain of 1."""
    page = np.array(page_mm)
    half_diagonal = float(np.hypot(*page)) / 2
    losses = lost * (1 + difference * np.array([-1.0, 0.0, 1.0]))
    offsets = np.array([0.05, -0.1]) + difference * random.uniform(-0.5, 0.5, (3, 2))
    spots = page / 2 + half_diagonal * offsets
    return np.column_stack([spots, losses / (1 - losses) / half_diagonal**2, np.ones(3)])


# Settings of a simulated room with a good lens, for an EOS 550D with photosites of 4.29 µm. Together with the aperture
# of the photosite, the MTF is 0.96 at 10 lp/mm and 0.73 at 30 lp/mm.
MILD_SHOULDERS: Final = {"blur_px": 0.46, "shoulder_share": 0.0116, "shoulder_px": 3.0}

# Settings for a worse lens: the MTF is 0.93 at 10 lp/mm and 0.64 at 30 lp/mm.
STRONG_SHOULDERS: Final = {"blur_px": 0.535, "shoulder_share": 0.0452, "shoulder_px": 3.0}

# Radius of the kernel, relative to the length a. Its normalisation replaces the light outside, 0.12 %.
_KERNEL_RADIUS: Final = 9.0

# Points per pixel and axis over which the kernel is averaged, because its peak is narrower than a pixel.
_POINTS_PER_PX: Final = 7

# Iterations that invert a shift. Each divides the error by more than 100 for shifts of a few pixels.
_INVERSION_STEPS: Final = 6

APERTURE_VARIANCE: Final = 1 / 12  # Variance of the uniform aperture of a photosite, photosites².


@dataclass(frozen=True)
class PhotographicLens:
    """Shoulders, veiling glare and lateral colour of a lens. Core blur and vignetting are rendered with the print."""

    half_size: tuple[int, int]  # Rows and columns of the frame, half-size pixels; the optical axis is in its centre
    shoulder_share: float  # Share of the light in the shoulders
    shoulder_px: float  # Standard deviation of the shoulders along each axis
    veil: float  # Share of the light in the veiling glare
    lateral_red_px: float  # Outward shift of red relative to green in the corner
    lateral_blue_px: float  # Outward shift of blue relative to green in the corner

    @property
    def centre_px(self) -> tuple[float, float]:
        """Position of the optical axis, x and y."""
        rows, columns = self.half_size
        return (columns - 1) / 2, (rows - 1) / 2

    @property
    def corner_px(self) -> float:
        """Distance from the optical axis to the corner of the frame."""
        return math.hypot(*self.half_size) / 2

    @property
    def has_lateral_colour(self) -> bool:
        """Whether red or blue is shifted relative to green."""
        return bool(self.lateral_red_px or self.lateral_blue_px)

    def shifted(self, green_px: NDArray[np.float64], channel: str) -> NDArray[np.float64]:
        """Convert positions (..., 2) in green to the positions (..., 2) in a channel ``R``, ``G`` or ``B``."""
        corner_shift_px = self._corner_shift_px(channel)
        if not corner_shift_px:
            return green_px
        offset = green_px - np.array(self.centre_px)
        return np.array(self.centre_px) + offset * self._magnification(offset, corner_shift_px)

    def unshifted(self, pixels: NDArray[np.float64], channel: str) -> NDArray[np.float64]:
        """Convert positions (..., 2) in a channel to the positions in green: inverse of `shifted`, within 10⁻⁶ px."""
        corner_shift_px = self._corner_shift_px(channel)
        if not corner_shift_px:
            return pixels
        shifted = pixels - np.array(self.centre_px)
        offset = shifted
        for _ in range(_INVERSION_STEPS):
            offset = shifted / self._magnification(offset, corner_shift_px)
        return np.array(self.centre_px) + offset

    def _corner_shift_px(self, channel: str) -> float:
        return {"R": self.lateral_red_px, "G": 0.0, "B": self.lateral_blue_px}[channel]

    def _magnification(self, offset: NDArray[np.float64], corner_shift_px: float) -> NDArray[np.float64]:
        """Return the magnification (..., 1) relative to green at offsets (..., 2) px from the axis."""
        rho2 = (offset**2).sum(axis=-1, keepdims=True) / self.corner_px**2
        return 1 + corner_shift_px / self.corner_px * (1 + rho2) / 2

    def spread(self, light: NDArray[np.float32]) -> None:
        """Move a share of the light into the shoulders, in place.

        `light`: (primaries, rows, columns) float32, light on the photosites after the blur of the core. The four
        positions of the Bayer pattern are filtered separately, as images of half-size pixels. Aliasing changes the
        shoulders by less than 0.1 %, because the light is already blurred. Edge values continue outside of the frame.
        """
        if self.shoulder_share == 0:
            return
        from cv2 import BORDER_REPLICATE, filter2D

        kernel = self.kernel()
        for plane in light:
            for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):
                phase = np.ascontiguousarray(plane[row::2, column::2])
                wide = np.asarray(filter2D(phase, -1, kernel, borderType=BORDER_REPLICATE), dtype=np.float32)
                plane[row::2, column::2] = phase + np.float32(self.shoulder_share) * (wide - phase)

    def kernel(self) -> NDArray[np.float32]:
        """Return the shoulder kernel on half-size pixels, (n, n) float32 with odd n and sum 1."""
        length = self.shoulder_px / math.sqrt(3)
        reach = max(math.ceil(_KERNEL_RADIUS * length), 1)
        distance = (np.arange((2 * reach + 1) * _POINTS_PER_PX) - (_POINTS_PER_PX - 1) / 2) / _POINTS_PER_PX - reach
        fine = np.exp(-np.hypot(distance[:, None], distance) / length)
        pixels = fine.reshape(2 * reach + 1, _POINTS_PER_PX, 2 * reach + 1, _POINTS_PER_PX).sum(axis=(1, 3))
        return (pixels / pixels.sum()).astype(np.float32)

    def add_veil(self, light: NDArray[np.float32], pattern: str) -> NDArray[np.float32]:
        """Add veiling glare to the light of a mosaic (primaries, rows, columns) float32, in place.

        Returns the added light (primaries, 2, 2) float32, by parity of row and column.
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
        """Return the light (primaries, rows, columns) of rows from `first_row` without the veiling glare `added`."""
        if self.veil == 0:
            return light
        row, column = np.mgrid[first_row : first_row + light.shape[1], : light.shape[2]]
        return (light - added[:, row % 2, column % 2]) / np.float32(1 - self.veil)
