"""Simulated frames of a printed chart under projector light, calculated from the displayed colour.

Signals are linear in the light of the three primaries of the projector. So the room is rendered once under each
primary (`_render`). A frame is the weighted sum of these three images, plus noise and black level. Rules:

- The same print, camera, room, colour, settings and key give the same counts with any number of threads.
- The noise of a frame depends only on the seed of the room and the key.
- `project`, `white`, `reflected`, `camera_rgb_at` and `field` return exact values, without point spread and veiling
  glare. An ideal look-up table would contain these values; tests compare with them.

The signal is ∫ primary × reflectance × sensitivity dλ. Bare paper under full white at 0.5 s, f/8 and ISO 100 gives the
scale: its strongest channel is `Room.white_level_share` times the range from black to saturation. Positions are
millimetres on the print or half-size pixels; DN are counts above the black level.

A `Room` describes light, lens and print. A `Situation` describes the differences of one frame from the undisturbed
room. Positions in a situation are relative to the page: (0, 0) is the top left corner, (1, 1) the bottom right corner,
and other values lie off the page.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.camera import ExposureSettings
from drivers.presenter import Colour
from foundation.colorimetry import decode_srgb
from foundation.compiled import processor_count
from foundation.records import from_settings
from sim.optics import APERTURE_VARIANCE, PhotographicLens, lens_falloff, projector_falloff
from sim.spectral import LampSpectrum, PaperName, ProfileName, printed_reflectance, projector_primaries, sensitivities
from sim.world.rendering import GRID_PX, PAPER, Fold, Print, Sheet, View, Waviness, label_map
from sim.world.sensors import Body, HotPattern, counts

_SLANT: Final = 0.36  # Tangent of the angle of incidence, 20° for a projector next to the camera.

RIM_MM = 1.0  # Width of the soft edge of a stain, mm.

_BACKDROP_REFLECTANCE: Final = 0.04  # Reflectance of the dark backdrop behind the print, at all wavelengths.

_BLOCK_ROWS: Final = 64  # Rows per task of a thread. Each task draws its own noise, so another number changes frames.

_A0_DIAGONAL_MM: Final = math.hypot(1189, 841)  # Diagonal of an A0 sheet (ISO 216), mm.

_CHANNELS: Final = "RGB"

Place = tuple[float, float, float, float]  # Rectangle on the page: left, top, right, bottom, relative to the page.

# Smallest margin of the projected picture around the page, relative to the page. An operator sets the zoom like this.
OVERSCAN: Final = 0.04

# Width of the soft edge of a `Blob`, relative to its radius. Objects 1 m in front of the chart are out of focus.
_BLOB_RIM: Final = 0.15

REFERENCE_APERTURE: Final = 8.0  # f-number. Lenses without contacts are set to it by hand.

# Exposure for which `Room.white_level_share` is defined.
REFERENCE_EXPOSURE: Final = ExposureSettings(iso=100, aperture=REFERENCE_APERTURE, shutter_s=0.5)


@dataclass(frozen=True)
class Room:
    """Parameters of the laboratory, except the drawing of the chart and the camera.

    Parameters
    ----------
    seed
        Seed of the shape of the paper, the response of photosites and the noise; 0 or more.
    fill
        Width or height of the print relative to the frame, whichever is larger.
    focal_diagonals
        Focal length relative to the diagonal of the frame; 1.3 is 35 mm on APS-C.
    tilt_deg, pan_deg, roll_deg
        Rotation of the print relative to the camera.
    k1, k2, p1, p2
        Distortion by Brown in normalised coordinates, as in OpenCV.
    waviness_mm
        Peak-to-valley height of the waves of an A0 sheet. It is scaled with the diagonal of other sheets.
    wave_mm
        Wavelength of the waves of an A0 sheet, scaled like `waviness_mm`. 150 is plausible for damp paper. With 0, the
        longer side has at most three waves.
    curl_mm
        Height of the left and right edges of an A0 sheet above the centre, towards the camera, scaled like
        `waviness_mm`.
    blur_px
        Standard deviation of the lens blur, half-size pixels, without the aperture of the photosite.
    shoulder_share, shoulder_px
        Share of the light in the wide tails of the point spread, and standard deviation of the tails along each axis,
        half-size pixels (`sim.optics`).
    veil
        Veiling glare: share of the light that the lens distributes uniformly over the frame.
    lateral_red_px, lateral_blue_px
        Outward shift of the channel relative to green in the corner, half-size pixels (`sim.optics`).
    vignetting
        Share of the light that the lens loses in the corner of the frame.
    projector_falloff
        Share of the projector's light that is lost half a page diagonal from its brightest point.
    primary_difference
        Relative difference of `projector_falloff` between primaries. The brightest points of the primaries differ by up
        to this number of half page diagonals.
    lamp_spectrum
        ``uhp`` (mercury lamp and colour wheel) or ``led``.
    transfer
        Conversion of codes to light: ``srgb`` (IEC 61966-2-1) or the exponent of a power law.
    black_leak
        Relative light of a primary at code 0: 1 / contrast.
    ambient
        Ambient light with the colour of projector white, relative to full white.
    white_level_share
        Signal of bare paper under full white at `REFERENCE_EXPOSURE`, strongest channel, relative to saturation −
        black.
    lamp_drift_per_hour
        Relative loss of lamp brightness per hour. Callers calculate the argument `lamp` from it.
    response_spread
        Standard deviation of the response of photosites (PRNU).
    wheel_hz
        Rotations of the colour wheel per second; 0 for steady light. Red, green and blue each fill a third of the
        wheel. The primaries differ if an exposure is not a whole number of rotations.
    shutter_jitter_s
        Standard deviation of the exposure time, s. It has an effect only with a colour wheel.
    stain_mm, stain_depth
        Diameter of a stain on the print (25 for a thumb, 0 for no stain), and the share of blue light that it absorbs.
        The stain absorbs 0.6 times this share of green light and 0.3 times this share of red light.
    fold_mm
        Height of a crease across the print, 0 for none.
    hot_per_million
        Photosites per million with high dark current, the same in all frames. 20 is assumed for an EOS 550D after ten
        years, 2 for an EOS 6D Mark II after three years. Unlike the numbers in `sim.world.sensors.HotPattern`, these
        numbers include hot photosites of a new body.
    hot_dn_per_s
        Mean dark signal of a hot photosite, DN per second at ISO 100; an assumption. The signals are exponentially
        distributed.
    profile
        ``unmanaged``: codes of the file are ink codes. ``managed``: a profile converts them, so that greys are
        neutral.
    paper
        ``poster``, ``matt`` or ``glossy`` (`sim.spectral.paper`).
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
    wave_mm: float = 0.0
    curl_mm: float = 0.0
    blur_px: float = 0.5
    shoulder_share: float = 0.0
    shoulder_px: float = 3.0
    veil: float = 0.0
    lateral_red_px: float = 0.0
    lateral_blue_px: float = 0.0
    vignetting: float = 0.25
    projector_falloff: float = 0.15
    primary_difference: float = 0.1
    lamp_spectrum: LampSpectrum = "uhp"
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
    hot_per_million: float = 0.0
    hot_dn_per_s: float = 4000.0
    profile: ProfileName = "unmanaged"
    paper: PaperName = "poster"

    def light_of(self, codes: NDArray[np.integer[Any]]) -> NDArray[np.float64]:
        """Convert integer codes 0 to 255 of any shape to the light of the primaries, 0 to 1 of the full light."""
        share = codes / 255
        return decode_srgb(share) if self.transfer == "srgb" else share**self.transfer

    def wheel_light(self, shutter_s: float, random: np.random.Generator) -> NDArray[np.float64]:
        """Return the light (3,) float64 of each primary through the colour wheel, relative to steady light."""
        if self.wheel_hz == 0:
            return np.ones(3)
        start = random.uniform()
        time = max(shutter_s + self.shutter_jitter_s * random.standard_normal(), 0)
        turns = np.array([start, start + time * self.wheel_hz])[:, None]
        segment = np.arange(3) / 3
        lit_turns = np.floor(turns) / 3 + np.clip(turns - np.floor(turns) - segment, 0, 1 / 3)
        return 3 * (lit_turns[1] - lit_turns[0]) / (shutter_s * self.wheel_hz)

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}, expected 0 or more")
        for name in ("fill", "focal_diagonals", "white_level_share", "shoulder_px"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}, expected more than 0")
        for name in (
            "vignetting", "projector_falloff", "black_leak", "ambient", "stain_depth", "shoulder_share", "veil",
        ):  # fmt: skip
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected 0 to below 1")
        for name in (
            "waviness_mm", "wave_mm", "blur_px", "response_spread", "primary_difference", "wheel_hz",
            "shutter_jitter_s", "stain_mm", "fold_mm", "hot_per_million", "hot_dn_per_s",
        ):  # fmt: skip
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} is {getattr(self, name)}, expected 0 or more")


def read_room(seed: int, changes: Mapping[str, Any], where: str, key: str) -> Room:
    """Return the default room with a seed and the changes of a settings file or command line."""
    names = [field.name for field in fields(Room) if field.name != "seed"]
    return from_settings(Room, changes, where, key, names, seed=seed)


@dataclass(frozen=True)
class Stain:
    """A round stain on the print with a soft edge."""

    centre_mm: tuple[float, float]  # Centre on the print
    diameter_mm: float
    transmittance: tuple[float, float, float]  # Reflected red, green and blue light relative to clean paper

    def transmittance_at(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the transmittance (..., 3) at points (..., 2)."""
        distance = np.linalg.norm(points_mm - np.array(self.centre_mm), axis=-1) - self.diameter_mm / 2
        cover = 1 / (1 + np.exp(np.clip(4 * distance / RIM_MM, -40, 40)))
        return 1 - cover[..., None] * (1 - np.array(self.transmittance))


def damage(room: Room, page_mm: tuple[float, float], rng: np.random.Generator) -> tuple[Stain | None, Fold | None]:
    """Draw the stain and the fold of a room at random positions away from the edges; None if the room has none."""
    page = np.array(page_mm)
    x, y = (page * rng.uniform(0.25, 0.75, 2)).tolist()
    absorbed = room.stain_depth * np.array([0.3, 0.6, 1.0])
    red, green, blue = (1 - absorbed).tolist()
    stain = Stain((x, y), room.stain_mm, (red, green, blue)) if room.stain_mm else None
    along = math.radians(rng.uniform(-6, 6))
    crease = float(page[0] * rng.uniform(0.3, 0.7)), float(page[1] / 2)
    direction = math.sin(along), math.cos(along)
    return stain, Fold(crease, direction, room.fold_mm, _SLANT) if room.fold_mm else None


def _relative_position(rectangle: Place, xy: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    # Position relative to the centre of a rectangle, across and down: ±1 at its sides.
    left, top, right, bottom = rectangle
    return (2 * xy[..., 0] - left - right) / (right - left), (2 * xy[..., 1] - top - bottom) / (bottom - top)


@dataclass(frozen=True)
class Patch:
    """A rectangle of another colour in the projected picture."""

    place: Place
    colour: Colour
    share: float = 1.0  # Share of the exposure time, 0 to 1

    def cover(self, position: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether points (..., 2), relative to the page, are in the rectangle: (...) bool."""
        left, top, right, bottom = self.place
        x, y = position[..., 0], position[..., 1]
        return (x >= left) & (x < right) & (y >= top) & (y < bottom)


@dataclass(frozen=True)
class Blob:
    """A dark object between chart and camera: an ellipse with a soft edge that fills a rectangle."""

    place: Place
    left: float = 0.08  # Remaining light behind the object, relative to the light without the object, 0 to 1

    def transmittance(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the share of the light (...) that reaches points (..., 2), given relative to the page."""
        across, down = _relative_position(self.place, position)
        inside = np.clip((1 + _BLOB_RIM / 2 - np.hypot(across, down)) / _BLOB_RIM, 0, 1)
        return 1 - (1 - self.left) * inside * inside * (3 - 2 * inside)


@dataclass(frozen=True)
class Glare:
    """Specular reflection of the print: a broad, soft ellipse with the colour of projector and ambient light."""

    place: Place  # At the sides of the rectangle, the reflection is 1 / e² of its maximum
    share: float = 0.03  # Maximum of the reflection, relative to the light from bare paper

    def reflected_light(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the reflection (...), relative to bare paper, at points (..., 2), given relative to the page."""
        across, down = _relative_position(self.place, position)
        return self.share * np.exp(-2 * (across**2 + down**2))


@dataclass(frozen=True, eq=False)
class Situation:
    """Differences from the undisturbed room during one frame."""

    lamp: tuple[float, float, float] = (1.0, 1.0, 1.0)  # Relative light of each primary
    # Additional ambient light with the spectrum of each primary, relative to the full light of this primary
    ambient: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # (h, w, 3) float32, mean light of the projected picture, 0 to 1 of each primary; None: one uniform colour
    picture: NDArray[np.float32] | None = None
    patches: tuple[Patch, ...] = ()  # Rectangles of other colours in the picture, later rectangles on top
    blobs: tuple[Blob, ...] = ()  # Objects in front of the chart
    glares: tuple[Glare, ...] = ()  # Specular reflections of the print
    # Shift of the chart in its plane, right and down, half-size pixels at its centre; adds to `bump_mm`
    bump_px: tuple[float, float] = (0.0, 0.0)
    bump_mm: tuple[float, float] = (0.0, 0.0)  # Shift of the chart, right and down, mm
    turn_deg: float = 0.0  # Rotation about the centre of the chart, clockwise
    defocus_px: float = 0.0  # Standard deviation of additional blur, half-size pixels
    black_dn: float = 0.0  # Increase of the black level, DN

    @property
    def scales_uniformly(self) -> bool:
        """Whether the light of each primary changes by the same factor at all points of the chart."""
        plain = self.picture is None or self.picture.shape[:2] == (1, 1)
        return plain and not self.patches and not self.blobs and not self.glares

    @property
    def view(self) -> tuple[float, ...]:
        """Position and sharpness of the chart; situations with equal values share one rendering."""
        return (*self.bump_px, *self.bump_mm, self.turn_deg, self.defocus_px)

    def picture_light(
        self,
        points_mm: NDArray[np.float64],
        page_mm: tuple[float, float],
        plain: NDArray[np.float64],
        decoded: Callable[[Colour], NDArray[np.float64]],
    ) -> NDArray[np.float64]:
        """Return the projected light (..., 3) float64 of each primary at points of the print, 0 to 1.

        `points_mm`: (..., 2) float64. `plain`: (3,) float64, light of the uniform colour, if there is no `picture`.
        `decoded` converts the codes of a colour to light (3,).
        """
        if self.picture is None:
            light = np.broadcast_to(plain, (*points_mm.shape[:-1], 3)).copy()
        else:
            light = sampled(
                self.picture, projected_mm(page_mm, self.picture.shape[1] / self.picture.shape[0]), points_mm
            )
        position = points_mm / np.array(page_mm)
        for patch in self.patches:
            covered = patch.cover(position)
            light[covered] += patch.share * (decoded(patch.colour) - light[covered])
        return light

    def transmittance(self, points_mm: NDArray[np.float64], page_mm: tuple[float, float]) -> NDArray[np.float64]:
        """Return the share of the light (...) float64 that passes the objects in front of points (..., 2) mm."""
        position = points_mm / np.array(page_mm)
        transmitted = np.ones(points_mm.shape[:-1])
        for blob in self.blobs:
            transmitted *= blob.transmittance(position)
        return transmitted

    def reflected_light(self, points_mm: NDArray[np.float64], page_mm: tuple[float, float]) -> NDArray[np.float64]:
        """Return the specularly reflected light (...) float64 at points (..., 2) mm, relative to bare paper."""
        position = points_mm / np.array(page_mm)
        added = np.zeros(points_mm.shape[:-1])
        for glare in self.glares:
            added += glare.reflected_light(position)
        return added


UNDISTURBED: Final = Situation()  # No differences.


def projected_mm(page_mm: tuple[float, float], aspect: float) -> Place:
    """Return the rectangle of the projected picture, mm on the print: the centred page with the margin `OVERSCAN`."""
    width, height = (side * (1 + 2 * OVERSCAN) for side in page_mm)
    width, height = max(width, height * aspect), max(height, width / aspect)
    x, y = page_mm[0] / 2, page_mm[1] / 2
    return x - width / 2, y - height / 2, x + width / 2, y + height / 2


def sampled(picture: NDArray[np.float32], place_mm: Place, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Interpolate a picture linearly at points of the print; edge values continue outside.

    `picture`: (h, w, 3) float32. `place_mm`: its rectangle, mm. `points_mm`: (..., 2) float64. Returns (..., 3)
    float64.
    """
    from scipy.ndimage import map_coordinates

    left, top, right, bottom = place_mm
    rows, columns, _ = picture.shape
    x = (points_mm[..., 0] - left) / (right - left) * columns - 0.5
    y = (points_mm[..., 1] - top) / (bottom - top) * rows - 0.5
    at = np.stack([y, x])
    channels = [map_coordinates(picture[..., channel], at, np.float64, order=1, mode="nearest") for channel in range(3)]
    return np.stack(channels, axis=-1)


def displaced(
    points_mm: NDArray[np.float64], middle_mm: ArrayLike, shift_mm: ArrayLike, turn_deg: float
) -> NDArray[np.float64]:
    """Return the positions of points of the chart after a rotation about `middle_mm` and a shift `shift_mm`.

    `points_mm`: (..., 2) float64. Returns (..., 2) float64, mm, in the coordinates of the undisturbed chart.
    """
    return (points_mm - np.asarray(middle_mm)) @ _rotation(turn_deg).T + np.asarray(middle_mm) + np.asarray(shift_mm)


def undisplaced(
    points_mm: NDArray[np.float64], middle_mm: ArrayLike, shift_mm: ArrayLike, turn_deg: float
) -> NDArray[np.float64]:
    """Return the points (..., 2) float64, mm, of the chart at positions (..., 2): inverse of `displaced`."""
    return (points_mm - np.asarray(shift_mm) - np.asarray(middle_mm)) @ _rotation(turn_deg) + np.asarray(middle_mm)


def _rotation(turn_deg: float) -> NDArray[np.float64]:
    cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    return np.array([[cosine, -sine], [sine, cosine]])


class World:
    """A print, a camera and a room.

    The first frame takes some seconds, because the room is rendered. The rendering stays in memory (12 bytes per
    photosite). Methods may be called by several threads.
    """

    def __init__(self, sheet: Print, body: Body, room: Room) -> None:
        self.sheet = sheet
        self.body = body
        self.room = room
        rows, columns = body.half_size
        self.stain, self.fold = damage(room, sheet.page_mm, self._random(5))
        self.view = View.framed(
            sheet_of(room, sheet.page_mm, self.fold),
            (columns, rows),
            fill=room.fill,
            focal_diagonals=room.focal_diagonals,
            turn_deg=(room.tilt_deg, room.pan_deg, room.roll_deg),
            distortion=(room.k1, room.k2, room.p1, room.p2),
        )
        shoulders = room.shoulder_share, room.shoulder_px
        self.lens = PhotographicLens(body.half_size, *shoulders, room.veil, room.lateral_red_px, room.lateral_blue_px)
        self._primaries = projector_primaries(room.lamp_spectrum)
        self._sensitivities = sensitivities(body.sensitivities)
        paper = np.einsum("pl,l,lc->c", self._primaries, self._reflectance([PAPER])[0], self._sensitivities)
        self._dn = room.white_level_share * (body.saturation - body.black) / float(paper.max())
        axis = 2 * self.view.centre_px[0] + 0.5, 2 * self.view.centre_px[1] + 0.5
        self._vignetting = lens_falloff(axis, (body.visible.width, body.visible.height), room.vignetting)
        self._falloff = projector_falloff(
            sheet.page_mm, room.projector_falloff, room.primary_difference, self._random(2)
        )
        self._falloff[:, 3] = self._balance()
        self._light_of_code = room.light_of(np.arange(256))
        self.hot = HotPattern.drawn(self._random(6), body.sensor, room.hot_per_million, room.hot_dn_per_s)
        self._lock = threading.Lock()
        self._rendered: dict[tuple[float, ...], tuple[NDArray[np.float32], NDArray[np.float32]]] = {}

    def expose(
        self,
        colour: Colour,
        settings: ExposureSettings,
        *,
        key: tuple[int, ...],
        lamp: float = 1.0,
        situation: Situation = UNDISTURBED,
    ) -> NDArray[np.uint16]:
        """Return a frame: counts (rows, columns) uint16 of the whole sensor, including masked borders.

        Parameters
        ----------
        colour
            Displayed colour.
        settings
            Exposure; the signal is proportional to shutter time, ISO speed and 1 / f-number².
        key
            Integers that select the random numbers of the frame.
        lamp
            Relative lamp brightness.
        situation
            Differences from the undisturbed room.
        """
        body, room = self.body, self.room
        lamp_light = lamp * room.wheel_light(settings.shutter_s, self._random(4, *key)) * np.array(situation.lamp)
        light, weights = self._lighting(colour, settings, lamp_light, situation)
        visible = body.visible
        black = body.black + situation.black_dn
        noise_dn, gain_e = body.noise_dn(settings.iso), body.gain_e(settings.iso)
        frame = np.empty(body.sensor, dtype=np.uint16)

        def block(first: int, last: int) -> None:
            noise = self._random(1, *key, first).standard_normal((last - first, body.sensor[1]), dtype=np.float32)
            # Rows above, within and below the visible frame.
            edges = sorted({first, last, *(e for e in (visible.top, visible.top + visible.height) if first < e < last)})
            for top, bottom in pairwise(edges):
                is_lit = visible.top <= top < visible.top + visible.height
                strip = light[:, top - visible.top : bottom - visible.top] if is_lit else light[:, : bottom - top, :0]
                noise_rows, rows = noise[top - first : bottom - first], frame[top:bottom]
                counts(strip, weights, noise_rows, visible.left, black, noise_dn, gain_e, body.saturation, rows)
            self._raise_hot_counts(frame[first:last], noise, light, weights, settings, first)

        _run_in_blocks(body.sensor[0], block)
        return frame

    def _raise_hot_counts(
        self,
        frame: NDArray[np.uint16],
        noise: NDArray[np.float32],
        light: NDArray[np.float32],
        weights: NDArray[np.float32],
        settings: ExposureSettings,
        first: int,
    ) -> None:
        # `frame` has the rows of the sensor from `first`.
        hot, visible = self.hot.within(first, first + len(frame)), self.body.visible
        y, x = hot.rows + first - visible.top, hot.columns - visible.left
        is_visible = (y >= 0) & (y < visible.height) & (x >= 0) & (x < visible.width)
        hot_light = np.zeros(len(hot.rows))
        hot_light[is_visible] = weights.astype(np.float64) @ light[:, y[is_visible], x[is_visible]]
        hot.raise_counts(frame, noise, hot_light, self.body, settings.iso, settings.shutter_s)

    def _lighting(
        self, colour: Colour, settings: ExposureSettings, lamp: NDArray[np.float64], situation: Situation
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the light (3, rows, columns) of each primary and weights (3,); their weighted sum is the signal."""
        (light, veil), ambient = self._render(situation), np.array(situation.ambient)
        plain = self.decoded(colour) if situation.picture is None else situation.picture[0, 0].astype(np.float64)
        if situation.scales_uniformly:
            return light, self._relative_exposure(plain, settings, lamp, ambient).astype(np.float32)
        nodes, page = self._nodes(UNDISTURBED), self.sheet.page_mm
        frame_light = np.empty_like(light)

        def block(first: int, last: int) -> None:
            points = self._points(nodes, first, last)
            picture_light = situation.picture_light(points, page, plain, self.decoded)
            weights = self._relative_exposure(picture_light, settings, lamp, ambient)
            weights *= situation.transmittance(points, page)[..., None]
            patch_light = self.lens.unveiled(light[:, first:last], veil, first)
            if situation.glares:
                patch_light = patch_light + self._mirrored(points, situation, first)
            frame_light[:, first:last] = patch_light * weights.transpose(2, 0, 1)

        _run_in_blocks(self.body.visible.height, block)
        self.lens.add_veil(frame_light, self.body.pattern)
        return frame_light, np.ones(3, dtype=np.float32)

    def _mirrored(self, points: NDArray[np.float64], situation: Situation, first: int) -> NDArray[np.float32]:
        """Return the specular reflection (3, rows, columns) float32 in rows from `first`, in the units of `_render`."""
        row, column = np.mgrid[first : first + len(points), : points.shape[1]]
        paper = self._signals(self._reflectance([PAPER]))[0][self._channels()[row % 2, column % 2]]
        added = situation.reflected_light(points, self.sheet.page_mm)[..., None] * self.field(points) * paper
        return added.transpose(2, 0, 1).astype(np.float32)

    def _channels(self) -> NDArray[np.int64]:
        # (2, 2) int64, camera channel by parity of row and column.
        return np.array([_CHANNELS.index(letter) for letter in self.body.pattern], dtype=np.int64).reshape(2, 2)

    def decoded(self, colour: Colour) -> NDArray[np.float64]:
        """Return the light (3,) float64 of each primary for the codes of a colour, 0 to 1."""
        return self._light_of_code[list(colour)]

    def signal(
        self, colour: Colour, settings: ExposureSettings, lamp: float = 1.0, situation: Situation = UNDISTURBED
    ) -> NDArray[np.float32]:
        """Return the signal (rows, columns) float32 of the visible photosites, DN above black.

        It includes the response of each photosite, but no noise, hot photosites, clipping or colour wheel.
        """
        light, weights = self._lighting(colour, settings, lamp * np.array(situation.lamp), situation)
        return np.tensordot(weights, light, 1)

    def project(
        self, points_mm: NDArray[np.float64], channel: str = "G", situation: Situation = UNDISTURBED
    ) -> NDArray[np.float64]:
        """Return the positions (..., 2) float64 in the image, half-size pixels, of points (..., 2) mm of the print."""
        points = np.asarray(points_mm, dtype=np.float64)
        if any(situation.view):
            points = displaced(points, np.array(self.sheet.page_mm) / 2, self._shift_mm(situation), situation.turn_deg)
        return self.lens.shifted(self.view.project(points), channel)

    def white(self, colour: Colour, settings: ExposureSettings, lamp: float = 1.0) -> NDArray[np.float64]:
        """Return R, G, B (3,) float64 of bare paper without fall-off (`field` = 1), DN above black, unclipped."""
        return self.reflected([PAPER], colour, settings, lamp)[0]

    def reflected(
        self, rgb: ArrayLike, colour: Colour, settings: ExposureSettings, lamp: float = 1.0
    ) -> NDArray[np.float64]:
        """Return the exact linear camera RGB (N, 3) float64 of printed codes without fall-off (`field` = 1).

        `rgb`: (N, 3) codes 0 to 255. The result is in DN above black. It includes black leak and ambient light, and is
        not clipped.
        """
        return self._signals(self._reflectance(rgb)) @ self.drive(colour, settings, lamp)

    def camera_rgb_at(
        self,
        rgb: ArrayLike,
        points_mm: NDArray[np.float64],
        colour: Colour,
        settings: ExposureSettings,
        lamp: float = 1.0,
    ) -> NDArray[np.float64]:
        """Return the exact linear camera RGB (N, 3) float64 of printed codes at points of the print, without blur.

        `rgb`: (N, 3) codes 0 to 255. `points_mm`: (N, 2) float64. The result is in DN above black. It includes stain
        and fold, and is not clipped.
        """
        light = self.field(points_mm) * self.drive(colour, settings, lamp)
        return np.einsum("ncp,np->nc", self._signals(self._reflectance(rgb)), light) * self.worn_light(points_mm)

    def signals_of_primaries(self, rgb: ArrayLike, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the signal of printed codes at points of a clean flat print under each primary at full brightness.

        `rgb`: (N, 3) codes 0 to 255. `points_mm`: (N, 2) float64. Returns (N, 3, 3) float64 [point, channel, primary],
        DN above black at the reference exposure, without blur. The product of this array and `drive` equals
        `camera_rgb_at` of a print without stain and fold.
        """
        return self._signals(self._reflectance(rgb)) * self.field(points_mm)[:, None]

    def drive(
        self,
        colour: Colour,
        settings: ExposureSettings,
        lamp: float | NDArray[np.float64] = 1.0,
        ambient: float | NDArray[np.float64] = 0.0,
    ) -> NDArray[np.float64]:
        """Return the exposure (3,) float64 to each primary, relative to full brightness at the reference exposure.

        `colour` and `settings` as in `expose`. `lamp` and `ambient` may have one value per primary; `ambient` is added
        to the ambient light of the room.
        """
        return self._relative_exposure(self.decoded(colour), settings, lamp, ambient)

    def _relative_exposure(
        self,
        linear: NDArray[np.float64],
        settings: ExposureSettings,
        lamp: float | NDArray[np.float64],
        ambient: float | NDArray[np.float64],
    ) -> NDArray[np.float64]:
        leak = self.room.black_leak
        relative_light = lamp * (leak + (1 - leak) * linear) + self.room.ambient + ambient
        reference = REFERENCE_EXPOSURE
        time = settings.shutter_s / reference.shutter_s
        # A lens without contacts has the reference aperture.
        opening = 1.0 if settings.aperture is None else (REFERENCE_APERTURE / settings.aperture) ** 2
        return relative_light * time * opening * (settings.iso / reference.iso)

    def worn_light(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the light (..., 3) float64 of R, G, B at points (..., 2) mm, relative to a print without damage."""
        points = np.asarray(points_mm, dtype=np.float64)
        transmitted = np.ones((*points.shape[:-1], 3))
        if self.stain is not None:
            transmitted *= self.stain.transmittance_at(points)
        if self.fold is not None:
            transmitted *= self.fold.shade(points)[..., None]
        return transmitted

    def field(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the light at points of the print: lens vignetting times fall-off of the projector.

        `points_mm`: (..., 2) float64. Returns (..., 3) float64 for each primary. The factor of the lens is 1 on its
        axis, the factor of green is 1 at the brightest point of green. The means of red and blue over the sheet are
        scaled to the mean of green, so `white` has the chromaticity of the mean light. The field of a camera channel is
        the mean of the fields of the primaries, weighted by the signal of the channel under each primary.
        """
        points = np.asarray(points_mm, dtype=np.float64)
        photosites = 2 * self.project(points) + 0.5
        from_axis = ((photosites - self._vignetting[:2]) ** 2).sum(axis=-1)
        passed = 1 / (1 + self._vignetting[2] * from_axis) ** 2
        from_spot = ((points[..., None, :] - self._falloff[:, :2]) ** 2).sum(axis=-1)
        return passed[..., None] * self._falloff[:, 3] / (1 + self._falloff[:, 2] * from_spot)

    def _balance(self) -> NDArray[np.float64]:
        width, height = self.sheet.page_mm
        x, y = np.meshgrid((np.arange(60) + 0.5) * width / 60, (np.arange(40) + 0.5) * height / 40)
        means = self.field(np.stack([x, y], axis=-1)).mean(axis=(0, 1))
        return means[1] / means

    def _reflectance(self, rgb: ArrayLike) -> NDArray[np.float64]:
        return printed_reflectance(rgb, self.room.profile, self.room.paper)

    def _signals(self, reflectance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return DN (N, 3, 3) [colour, channel, primary] of reflectances (N, 81) at the reference exposure."""
        weighted = self._primaries[None] * self._sensitivities.T[:, None] * self._dn
        return (reflectance @ weighted.reshape(9, -1).T).reshape(-1, 3, 3)

    def _random(self, *key: int) -> np.random.Generator:
        return np.random.Generator(np.random.SFC64([self.room.seed, *key]))

    def _render(self, situation: Situation = UNDISTURBED) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return DN (3, rows, columns) float32 under each primary, and their veiling glare (3, 2, 2) by parity."""
        with self._lock:
            if situation.view not in self._rendered:
                undisturbed = self._rendered.get(UNDISTURBED.view)
                self._rendered = {} if undisturbed is None else {UNDISTURBED.view: undisturbed}
                self._rendered[situation.view] = self._render_new(situation)
            return self._rendered[situation.view]

    def _render_new(self, situation: Situation) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        from sim.world.rendering import light

        visible, room = self.body.visible, self.room
        drawing, channels = label_map(self.sheet), self._channels()
        backdrop = np.full((1, len(self._sensitivities)), _BACKDROP_REFLECTANCE)
        reflectance = np.concatenate([self._reflectance(drawing.codes), backdrop])
        table = self._signals(reflectance).astype(np.float32)
        nodes = self._nodes(situation)
        views = [nodes]
        if self.lens.has_lateral_colour:
            views = [self._nodes(situation, channel) for channel in _CHANNELS]
        sigma = ((2 * room.blur_px) ** 2 + (2 * situation.defocus_px) ** 2 + APERTURE_VARIANCE) ** 0.5
        out = np.empty((3, visible.height, visible.width), dtype=np.float32)
        # The projector does not move with the chart.
        falloff = self._falloff.copy()
        falloff[:, :2] = self._undisplaced(falloff[:, :2], situation)

        node_grids, lines, spread = np.stack(views), (drawing.x_lines, drawing.y_lines), room.shoulder_share > 0

        def block(first: int, last: int) -> None:
            # Shoulders are applied before the response of the photosites.
            response = np.ones((last - first, visible.width), np.float32) if spread else self._response(first, last)
            if self.stain is not None or self.fold is not None:
                response *= self._worn_rows(nodes, channels, first, last)
            rows, lens = out[:, first:last], self._vignetting
            light(first, node_grids, sigma, *lines, drawing.labels, table, channels, lens, falloff, response, rows)

        def respond(first: int, last: int) -> None:
            out[:, first:last] *= self._response(first, last)

        _run_in_blocks(visible.height, block)
        if spread:
            self.lens.spread(out)
            _run_in_blocks(visible.height, respond)
        return out, self.lens.add_veil(out, self.body.pattern)

    def _response(self, first: int, last: int) -> NDArray[np.float32]:
        response = self._random(3, first).standard_normal((last - first, self.body.visible.width), dtype=np.float32)
        response *= np.float32(self.room.response_spread)
        response += np.float32(1)
        return response

    def _undisplaced(self, points_mm: NDArray[np.float64], situation: Situation) -> NDArray[np.float64]:
        if not any(situation.view):
            # The undisturbed chart is not transformed, because rounding errors would change some counts.
            return points_mm
        return undisplaced(points_mm, np.array(self.sheet.page_mm) / 2, self._shift_mm(situation), situation.turn_deg)

    def _shift_mm(self, situation: Situation) -> NDArray[np.float64]:
        view = self.view
        return np.array(situation.bump_mm) + np.array(situation.bump_px) * (view.distance_mm / view.focal_px)

    def _points(self, nodes: NDArray[np.float64], first: int, last: int) -> NDArray[np.float64]:
        """Return the points (rows, columns, 2) float64 of the print, mm, at rows of photosites."""
        from scipy.ndimage import map_coordinates

        row, column = np.mgrid[first:last, : self.body.visible.width]
        at = np.stack([row, column]) / GRID_PX + 1
        return np.stack([map_coordinates(nodes[..., axis], at, order=1) for axis in (0, 1)], axis=-1)

    def _worn_rows(
        self, nodes: NDArray[np.float64], channels: NDArray[np.int64], first: int, last: int
    ) -> NDArray[np.float32]:
        # `worn_light` (rows, columns) float32 of the photosites of some rows.
        row, column = np.mgrid[first:last, : self.body.visible.width]
        points = self._points(nodes, first, last)
        channel = channels[row % 2, column % 2]
        return np.take_along_axis(self.worn_light(points), channel[..., None], axis=-1)[..., 0].astype(np.float32)

    def _nodes(self, situation: Situation, channel: str = "G") -> NDArray[np.float64]:
        # Points of the print (ny, nx, 2), mm, at every 16th photosite, with an additional node beyond each edge.
        visible = self.body.visible
        y, x = (np.arange(-1, (size - 1) // GRID_PX + 3) * GRID_PX for size in (visible.height, visible.width))
        photosites = np.stack(np.meshgrid(x, y), axis=-1).astype(np.float64)
        green_px = self.lens.unshifted((photosites - 0.5) / 2, channel)
        return self._undisplaced(self.view.locate(green_px), situation)


def _run_in_blocks(rows: int, work: Callable[[int, int], None]) -> None:
    # Calls `work(first, end)` for each block of rows.
    firsts = range(0, rows, _BLOCK_ROWS)
    with ThreadPoolExecutor(processor_count()) as threads:
        for future in [threads.submit(work, first, min(first + _BLOCK_ROWS, rows)) for first in firsts]:
            future.result()


def sheet_of(room: Room, page_mm: tuple[float, float], fold: Fold | None) -> Sheet:
    """Return the shape of the sheet of a room; waves and curl are proportional to its size."""
    size = math.hypot(*page_mm) / _A0_DIAGONAL_MM
    waves = Waviness.random(room.seed, room.waviness_mm * size, page_mm, wave_mm=room.wave_mm * size)
    return Sheet(waves, room.curl_mm * size, fold)
