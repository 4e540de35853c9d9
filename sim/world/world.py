"""The dark room: a lit print in front of a camera. What is shown decides what is photographed.

Light adds. The signal of a photosite is linear in the drives of the projector's three primaries, so the room is
rendered once for each primary alone (`_render`), and a frame is their weighted sum, its noise, and black. The laws:

- the same print, body, room, colour, settings and key give the same counts, on any number of threads;
- every frame's noise depends on the room's seed and the key alone;
- `project`, `white`, `reflected` and `field` are the truth that the counts were made from, for tests to compare with.

Signal = ∫ primary × reflectance × sensitivity dλ, scaled so that bare paper under full white gives
`Room.white_level_share` of the body's range in its strongest channel at 0.5 s, f/8, ISO 100.
Millimetres on the print; half-size pixels unless said; DN are raw counts above black.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.camera import ExposureSettings
from drivers.presenter import Colour
from foundation.processors import processor_count
from sim.camera.sensors import Body
from sim.world.geometry import Folded, View, Waviness
from sim.world.spectra import Lamp, print_reflectance, projector_primaries, sensitivities
from sim.world.wear import Fold, Stain

REFERENCE_EXPOSURE = ExposureSettings(iso=100, aperture=8.0, shutter_s=0.5)
"""The exposure at which `Room.white_level_share` holds."""

_PAPER = (255, 255, 255)
_A0_DIAGONAL_MM = math.hypot(1189, 841)
_BACKDROP_REFLECTANCE = 0.04
_BLOCK_ROWS = 64
_FINEST_MM = 1e-3
_MOST_LINES = 6000
_CHANNELS = "RGB"
_SLANT = 0.36
"""Tangent of 20°: a projector beside the camera."""


@dataclass(frozen=True, eq=False)
class Print:
    """A drawing on paper: rectangles of plain colour, each over those before it.

    Attributes
    ----------
    page_mm
        Width and height of the sheet; bare paper where no rectangle lies.
    rectangles_mm
        (N, 4) float64: left, top, right, bottom.
    rgb
        (N, 3) uint8, the code printed; (255, 255, 255) prints nothing.
    """

    page_mm: tuple[float, float]
    rectangles_mm: NDArray[np.float64]
    rgb: NDArray[np.uint8]

    def __post_init__(self) -> None:
        count = len(self.rectangles_mm)
        if self.rectangles_mm.shape != (count, 4) or self.rgb.shape != (count, 3):
            raise ValueError(
                f"rectangles {self.rectangles_mm.shape} and codes {self.rgb.shape}; (N, 4), (N, 3) expected"
            )
        if np.any(self.rectangles_mm[:, 2:] < self.rectangles_mm[:, :2]):
            raise ValueError("a rectangle's right or bottom lies before its left or top")


@dataclass(frozen=True)
class Room:
    """Everything about the lab that is not the print and not the camera's body.

    Attributes
    ----------
    seed
        Of the paper's shape, the photosites' response and the noise; 0 or more.
    fill
        The print's extent over the frame's, along whichever axis is the tighter.
    focal_diagonals
        Focal length over the frame's diagonal; 1.3 is 35 mm on APS-C. With `fill` it gives the distance.
    tilt_deg, pan_deg, roll_deg
        How the print is turned against the camera.
    k1, k2, p1, p2
        Brown's distortion in normalised coordinates, as OpenCV has it.
    waviness_mm
        Peak-to-valley height of the paper's surface on an A0 sheet; on another in proportion to its diagonal, so that
        small charts look like large ones.
    blur_px
        Standard deviation of the lens's blur, half-size pixels; the photosite's aperture is added to it.
    vignetting
        Share of the light that the lens loses at the frame's corner.
    projector_falloff
        Share of the projector's light that is missing a page's half diagonal from its brightest point.
    primary_difference
        How differently the primaries fall off: their `projector_falloff` spreads by this share of itself, and their
        brightest points by as much of the page's half diagonal.
    lamp_spectrum
        ``uhp`` (mercury lamp and colour wheel) or ``led``.
    transfer
        From code to light: ``srgb`` (IEC 61966-2-1) or the exponent of a power law.
    black_leak
        Share of a primary's full light that is there at code 0: 1 / contrast.
    ambient
        Light from elsewhere, as a share of the projector's white; of its colour, for it is taken to be stray light.
    white_level_share
        Signal of bare paper in full white at `REFERENCE_EXPOSURE`, strongest channel, over saturation − black.
    lamp_drift_per_hour
        Share of its light that the lamp loses in an hour; the room has no time, so whoever does applies it as `lamp`.
    response_spread
        Standard deviation of the photosites' response (PRNU).
    wheel_hz
        Turns of the projector's colour wheel per second, each a third red, green and blue; 0 for steady light. With a
        wheel, an exposure that is no whole number of turns, or starts and ends unsteadily, gets more of one primary
        than of another, and frames differ from `signal` and `white` by that.
    shutter_jitter_s
        Standard deviation of the exposure time; matters with a wheel only.
    stain_mm, stain_depth
        Diameter of a stain somewhere on the print, 0 for none, and the share of blue light that it takes; of green it
        takes six tenths of that, of red three. A thumb's is 25 mm across.
    fold_mm
        How far a crease across the print stands off its plane, 0 for none.
    """

    seed: int = 0
    fill: float = 0.94
    focal_diagonals: float = 1.3
    tilt_deg: float = 2.0
    pan_deg: float = -3.0
    roll_deg: float = 0.5
    k1: float = -0.03
    k2: float = 0.01
    p1: float = 2e-4
    p2: float = -3e-4
    waviness_mm: float = 3.0
    blur_px: float = 0.5
    vignetting: float = 0.25
    projector_falloff: float = 0.15
    primary_difference: float = 0.1
    lamp_spectrum: Lamp = "uhp"
    transfer: Literal["srgb"] | float = "srgb"
    black_leak: float = 1 / 1500
    ambient: float = 0.0
    white_level_share: float = 0.70
    lamp_drift_per_hour: float = 0.004
    response_spread: float = 0.003
    wheel_hz: float = 0.0
    shutter_jitter_s: float = 0.0005
    stain_mm: float = 0.0
    stain_depth: float = 0.5
    fold_mm: float = 0.0

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; 0 or more is expected")
        for name in ("fill", "focal_diagonals", "white_level_share"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; more than 0 is expected")
        for name in ("vignetting", "projector_falloff", "black_leak", "ambient", "stain_depth"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; 0 … below 1 is expected")
        for name in (
            "waviness_mm", "blur_px", "response_spread", "primary_difference", "wheel_hz", "shutter_jitter_s",
            "stain_mm", "fold_mm",
        ):  # fmt: skip
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} is {getattr(self, name)}; 0 or more is expected")


class World:
    """A print, a body and a room; see the module's laws.

    The first frame takes a few seconds for the rendering, which is kept: 12 bytes a photosite. Any thread may ask.
    """

    def __init__(self, sheet: Print, body: Body, room: Room) -> None:
        self.sheet = sheet
        self.body = body
        self.room = room
        rows, columns = body.half_size
        self.stain, self.fold = self._wear()
        surface = Waviness.random(
            room.seed, room.waviness_mm * math.hypot(*sheet.page_mm) / _A0_DIAGONAL_MM, sheet.page_mm
        )
        self.view = View.framed(
            surface if self.fold is None else Folded(surface, self.fold),
            (columns, rows),
            fill=room.fill,
            focal_diagonals=room.focal_diagonals,
            turn_deg=(room.tilt_deg, room.pan_deg, room.roll_deg),
            distortion=(room.k1, room.k2, room.p1, room.p2),
        )
        self._primaries = projector_primaries(room.lamp_spectrum)
        self._sensitivities = sensitivities(body.sensitivities)
        paper = np.einsum("pl,l,lc->c", self._primaries, print_reflectance([_PAPER])[0], self._sensitivities)
        self._dn = room.white_level_share * (body.saturation - body.black) / float(paper.max())
        self._lens, self._falloff = self._shading()
        self._falloff[:, 3] = self._balance()
        self._lock = threading.Lock()
        self._light: NDArray[np.float32] | None = None

    def expose(
        self, colour: Colour, settings: ExposureSettings, *, key: tuple[int, ...], lamp: float = 1.0
    ) -> NDArray[np.uint16]:
        """Return a frame.

        Parameters
        ----------
        colour
            What the projector shows.
        settings
            Light grows with shutter time and ISO speed and falls with the square of the f-number.
        key
            Names the frame; integers 0 or more. The same key has the same noise.
        lamp
            The lamp's light over its light when new; 0 is dark.

        Returns
        -------
        ndarray
            (rows, columns) uint16, the whole sensor's counts, masked borders included; never above saturation.
        """
        from sim.world.rendering import counts

        light = self._render()
        weights = np.asarray(self._drive(colour, settings, lamp * self._turned(settings, key)), dtype=np.float32)
        body, visible = self.body, self.body.visible
        black, noise_dn, gain_e = float(body.black), body.noise_dn(settings.iso), body.gain_e(settings.iso)
        frame = np.empty(body.sensor, dtype=np.uint16)

        def block(first: int, last: int) -> None:
            noise = self._random(1, *key, first).standard_normal((last - first, body.sensor[1]), dtype=np.float32)
            # Rows above, within and below the visible frame.
            edges = sorted({first, last, *(e for e in (visible.top, visible.top + visible.height) if first < e < last)})
            for top, bottom in pairwise(edges):
                seen = visible.top <= top < visible.top + visible.height
                part = light[:, top - visible.top : bottom - visible.top] if seen else light[:, : bottom - top, :0]
                noise_rows, rows = noise[top - first : bottom - first], frame[top:bottom]
                counts(part, weights, noise_rows, visible.left, black, noise_dn, gain_e, body.saturation, rows)

        _in_blocks(body.sensor[0], block)
        return frame

    def signal(self, colour: Colour, settings: ExposureSettings, lamp: float = 1.0) -> NDArray[np.float32]:
        """Return what a frame would be without noise, black and clipping.

        Parameters
        ----------
        colour, settings, lamp
            As for `expose`.

        Returns
        -------
        ndarray
            (rows, columns) float32, DN above black, of the body's visible photosites, their response included.
        """
        drive = np.asarray(self._drive(colour, settings, lamp), dtype=np.float32)
        return np.tensordot(drive, self._render(), 1)

    def project(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the half-size pixels where points of the print are seen: (..., 2) mm to (..., 2) px, x then y."""
        return self.view.project(np.asarray(points_mm, dtype=np.float64))

    def white(self, colour: Colour, settings: ExposureSettings, lamp: float = 1.0) -> NDArray[np.float64]:
        """Return (3,) float64: R, G, B of bare paper in DN above black, without clipping, where `field` is 1."""
        return self.reflected([_PAPER], colour, settings, lamp)[0]

    def reflected(
        self, rgb: ArrayLike, colour: Colour, settings: ExposureSettings, lamp: float = 1.0
    ) -> NDArray[np.float64]:
        """Return the true linear camera RGB of printed codes.

        Parameters
        ----------
        rgb
            (N, 3) codes 0 … 255.
        colour, settings, lamp
            As for `expose`.

        Returns
        -------
        ndarray
            (N, 3) float64, DN above black where `field` is 1, leak and ambient light included, without clipping.
        """
        return self._signals(print_reflectance(rgb)) @ self._drive(colour, settings, lamp)

    def seen(
        self,
        rgb: ArrayLike,
        points_mm: NDArray[np.float64],
        colour: Colour,
        settings: ExposureSettings,
        lamp: float = 1.0,
    ) -> NDArray[np.float64]:
        """Return the true linear camera RGB of printed codes at points of the print, in the light that falls there.

        Parameters
        ----------
        rgb
            (N, 3) codes 0 … 255.
        points_mm
            (N, 2) float64.
        colour, settings, lamp
            As for `expose`.

        Returns
        -------
        ndarray
            (N, 3) float64, DN above black, without clipping: what the photosites there get where nothing is blurred,
            stain and fold included.
        """
        light = self.field(points_mm) * self._drive(colour, settings, lamp)
        return np.einsum("ncp,np->nc", self._signals(print_reflectance(rgb)), light) * self.worn(points_mm)

    def worn(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what stain and fold leave of the light of a clean flat print.

        Parameters
        ----------
        points_mm
            (..., 2) float64.

        Returns
        -------
        ndarray
            (..., 3) float64 for red, green and blue of the camera; 1 where the print is clean and flat.
        """
        points = np.asarray(points_mm, dtype=np.float64)
        left = np.ones((*points.shape[:-1], 3))
        if self.stain is not None:
            left *= self.stain.passed(points)
        if self.fold is not None:
            left *= self.fold.shade(points)[..., None]
        return left

    def field(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the light at points of the print: lens vignetting times the projector's falloff.

        Parameters
        ----------
        points_mm
            (..., 2) float64.

        Returns
        -------
        ndarray
            (..., 3) float64, for each primary of the projector (red, green, blue). The lens is 1 on its axis and green
            1 at its brightest point; red and blue are balanced so that the three have one mean over the sheet. So
            `white` has the chromaticity of the light that the sheet receives on the whole. A camera channel sees the
            mean of the three weighted by what it receives of each.
        """
        points = np.asarray(points_mm, dtype=np.float64)
        photosites = 2 * self.project(points) + 0.5
        from_axis = ((photosites - self._lens[:2]) ** 2).sum(axis=-1)
        passed = 1 / (1 + self._lens[2] * from_axis) ** 2
        from_spot = ((points[..., None, :] - self._falloff[:, :2]) ** 2).sum(axis=-1)
        return passed[..., None] * self._falloff[:, 3] / (1 + self._falloff[:, 2] * from_spot)

    def _shading(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the constants of the lens's and the projector's falloff, as `sim.world.rendering.light` takes them."""
        room, visible = self.room, self.body.visible
        axis = 2 * np.array(self.view.centre_px) + 0.5
        corner2 = (visible.width**2 + visible.height**2) / 4
        lens = np.array([*axis, ((1 - room.vignetting) ** -0.5 - 1) / corner2])
        page = np.array(self.sheet.page_mm)
        half_diagonal = float(np.hypot(*page)) / 2
        random = self._random(2)
        lost = room.projector_falloff * (1 + room.primary_difference * np.array([-1.0, 0.0, 1.0]))
        aside = np.array([0.05, -0.1]) + room.primary_difference * random.uniform(-0.5, 0.5, (3, 2))
        spots = page / 2 + half_diagonal * aside
        return lens, np.column_stack([spots, lost / (1 - lost) / half_diagonal**2, np.ones(3)])

    def _balance(self) -> NDArray[np.float64]:
        """Return (3,) the gains of the primaries that give all three green's mean over the sheet."""
        width, height = self.sheet.page_mm
        x, y = np.meshgrid((np.arange(60) + 0.5) * width / 60, (np.arange(40) + 0.5) * height / 40)
        means = self.field(np.stack([x, y], axis=-1)).mean(axis=(0, 1))
        return means[1] / means

    def _turned(self, settings: ExposureSettings, key: tuple[int, ...]) -> NDArray[np.float64]:
        """Return (3,) the light of each primary that the wheel lets through, over that of steady light."""
        if self.room.wheel_hz == 0:
            return np.ones(3)
        random = self._random(4, *key)
        start = random.uniform()
        time = max(settings.shutter_s + self.room.shutter_jitter_s * random.standard_normal(), 0)
        turns = np.array([start, start + time * self.room.wheel_hz])[:, None]
        segment = np.arange(3) / 3
        shone = np.floor(turns) / 3 + np.clip(turns - np.floor(turns) - segment, 0, 1 / 3)
        return 3 * (shone[1] - shone[0]) / (settings.shutter_s * self.room.wheel_hz)

    def _drive(
        self, colour: Colour, settings: ExposureSettings, lamp: float | NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return (3,) how much of each primary's reference light a frame collects, gain included."""
        codes = np.array([colour.red, colour.green, colour.blue]) / 255
        if self.room.transfer == "srgb":
            linear = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
        else:
            linear = codes**self.room.transfer
        leak = self.room.black_leak
        shown = lamp * (leak + (1 - leak) * linear) + self.room.ambient
        reference = REFERENCE_EXPOSURE
        time = settings.shutter_s / reference.shutter_s
        return shown * time * (reference.aperture / settings.aperture) ** 2 * (settings.iso / reference.iso)

    def _signals(self, reflectance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (N, 3, 3): DN of (N, 81) reflectances at the reference exposure, [colour, channel, primary]."""
        seen = self._primaries[None] * self._sensitivities.T[:, None] * self._dn
        return (reflectance @ seen.reshape(9, -1).T).reshape(-1, 3, 3)

    def _random(self, *key: int) -> np.random.Generator:
        return np.random.Generator(np.random.SFC64([self.room.seed, *key]))

    def _render(self) -> NDArray[np.float32]:
        """Return (3, rows, columns) float32: DN of the visible photosites under each primary alone."""
        with self._lock:
            if self._light is None:
                self._light = self._lit()
            return self._light

    def _lit(self) -> NDArray[np.float32]:
        from sim.world.rendering import light

        visible, room = self.body.visible, self.room
        drawing = self._drawing
        nodes = self._nodes()
        # A uniform aperture of one photosite has a variance of 1/12.
        sigma = ((2 * room.blur_px) ** 2 + 1 / 12) ** 0.5
        channels = np.array([_CHANNELS.index(letter) for letter in self.body.pattern], dtype=np.int64).reshape(2, 2)
        out = np.empty((3, visible.height, visible.width), dtype=np.float32)

        def block(first: int, last: int) -> None:
            response = self._random(3, first).standard_normal((last - first, visible.width), dtype=np.float32)
            response *= np.float32(room.response_spread)
            response += np.float32(1)
            if self.stain is not None or self.fold is not None:
                response *= self._worn_rows(nodes, channels, first, last)
            lines, table, rows = drawing.lines, drawing.signals, out[:, first:last]
            lens, falloff = self._lens, self._falloff
            light(first, nodes, sigma, *lines, drawing.labels, table, channels, lens, falloff, response, rows)

        _in_blocks(visible.height, block)
        return out

    def _worn_rows(
        self, nodes: NDArray[np.float64], channels: NDArray[np.int64], first: int, last: int
    ) -> NDArray[np.float32]:
        """Return (rows, columns) float32: what stain and fold leave of the light on each photosite of some rows."""
        from scipy.ndimage import map_coordinates

        from sim.world.rendering import GRID_PX

        row, column = np.mgrid[first:last, : self.body.visible.width]
        at = np.stack([row, column]) / GRID_PX + 1
        points = np.stack([map_coordinates(nodes[..., axis], at, order=1) for axis in (0, 1)], axis=-1)
        channel = channels[row % 2, column % 2]
        return np.take_along_axis(self.worn(points), channel[..., None], axis=-1)[..., 0].astype(np.float32)

    def _wear(self) -> tuple[Stain | None, Fold | None]:
        """Return the stain and the fold, somewhere on the sheet, clear of its edges."""
        room, page, random = self.room, np.array(self.sheet.page_mm), self._random(5)
        x, y = (page * random.uniform(0.25, 0.75, 2)).tolist()
        taken = room.stain_depth * np.array([0.3, 0.6, 1.0])
        red, green, blue = (1 - taken).tolist()
        stain = Stain((x, y), room.stain_mm, (red, green, blue)) if room.stain_mm else None
        along = math.radians(random.uniform(-6, 6))
        crease = float(page[0] * random.uniform(0.3, 0.7)), float(page[1] / 2)
        direction = math.sin(along), math.cos(along)
        return stain, Fold(crease, direction, room.fold_mm, _SLANT) if room.fold_mm else None

    def _nodes(self) -> NDArray[np.float64]:
        """Return (ny, nx, 2) float64: the place on the print of every 16th photosite, one node beyond on each side."""
        from sim.world.rendering import GRID_PX

        visible = self.body.visible
        y, x = (np.arange(-1, (size - 1) // GRID_PX + 3) * GRID_PX for size in (visible.height, visible.width))
        photosites = np.stack(np.meshgrid(x, y), axis=-1).astype(np.float64)
        return self.view.locate((photosites - 0.5) / 2)

    @cached_property
    def _drawing(self) -> _Drawing:
        sheet = self.sheet
        codes, label = np.unique(np.concatenate([sheet.rgb, [_PAPER]]), axis=0, return_inverse=True)
        reflectance = np.concatenate(
            [print_reflectance(codes), np.full((1, len(self._sensitivities)), _BACKDROP_REFLECTANCE)]
        )
        backdrop = len(codes)
        boxes = np.concatenate([sheet.rectangles_mm, [[0, 0, *sheet.page_mm]]])
        boxes = np.clip(boxes, 0, [*sheet.page_mm, *sheet.page_mm])
        (x_lines, left, right), (y_lines, top, bottom) = _lines(boxes[:, 0::2]), _lines(boxes[:, 1::2])
        labels = np.full((len(y_lines) + 1, len(x_lines) + 1), backdrop, dtype=np.int32)
        label = label.reshape(-1).astype(np.int32)
        for k in (len(label) - 1, *range(len(label) - 1)):
            labels[top[k] + 1 : bottom[k] + 1, left[k] + 1 : right[k] + 1] = label[k]
        return _Drawing((x_lines, y_lines), labels, self._signals(reflectance).astype(np.float32))


@dataclass(frozen=True, eq=False)
class _Drawing:
    """A print as `sim.world.rendering.light` reads it."""

    lines: tuple[NDArray[np.float64], NDArray[np.float64]]
    labels: NDArray[np.int32]
    signals: NDArray[np.float32]


def _lines(ends: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.intp]]:
    """Return the sorted distinct coordinates of (N, 2) ends, and the index of each beginning and each end among them.

    Coordinates within a micrometre are one; where a drawing has more than a few thousand, nearer ones are joined, each
    then standing at the mean of those it stands for.
    """
    finest = _FINEST_MM
    while True:
        rounded, index = np.unique(np.round(ends / finest), return_inverse=True)
        if len(rounded) <= _MOST_LINES:
            break
        finest *= 1.5
    index = index.reshape(ends.shape)
    count = np.bincount(index.ravel())
    return np.bincount(index.ravel(), weights=ends.ravel()) / count, index[:, 0], index[:, 1]


def _in_blocks(rows: int, work: Callable[[int, int], None]) -> None:
    """Call `work` for each block of rows (first, last + 1), on as many threads as there are processors."""
    firsts = range(0, rows, _BLOCK_ROWS)
    with ThreadPoolExecutor(processor_count()) as threads:
        for done in [threads.submit(work, first, min(first + _BLOCK_ROWS, rows)) for first in firsts]:
            done.result()
