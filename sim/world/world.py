"""A lit print in front of a camera. What is shown decides what is photographed.

Light adds. The signal of a photosite is linear in the drives of the projector's three primaries, so the room is
rendered once for each primary alone (`_render`), and a frame is their weighted sum, its noise, and black. The rules:

- the same print, body, room, colour, settings and key give the same counts, on any number of threads;
- every frame's noise depends on the room's seed and the key alone;
- `project`, `white`, `reflected`, `seen` and `field` are the truth that the counts were made from, for tests to compare
  with. They are the print's and the light's, without point spread and veil: what a perfect table would hold.

Signal = ∫ primary × reflectance × sensitivity dλ, scaled so that bare paper under full white gives
`Room.white_level_share` of the body's range in its strongest channel at 0.5 s, f/8, ISO 100.
Millimetres on the print; half-size pixels unless said; DN are raw counts above black.

The lab around the camera is a `Room`: light, lens, print and what is wrong with them, as one frozen value. A stain on
the print (`Stain`) is a filter on the paper, of one colour, with a soft rim.

How one frame's circumstances differ from those of the undisturbed room is a `Situation`. Its places are shares of the
page unless said: (0, 0) is its top-left corner, (1, 1) its bottom-right one, and what reaches beyond lies off the page.
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

_SLANT: Final = 0.36  # Tangent of 20°: a projector beside the camera

RIM_MM = 1.0  # Over which a stain's edge fades

_BACKDROP_REFLECTANCE: Final = 0.04  # Of what lies behind the print, at every wavelength: dark, as a backdrop should be

# Rows that one thread works at. Noise is drawn block by block, so that another number gives other frames.
_BLOCK_ROWS: Final = 64

_A0_DIAGONAL_MM: Final = math.hypot(1189, 841)  # Of a sheet of A0 (ISO 216)

_CHANNELS: Final = "RGB"

Place = tuple[float, float, float, float]  # A rectangle: left, top, right, bottom, shares of the page

# Share of the page by which the projected picture reaches beyond it where it is nearest: an operator zooms until the
# whole sheet is lit, and a little more.
OVERSCAN: Final = 0.04

# Share of a blob's radius over which its edge fades: what stands a metre before the chart is out of focus.
_BLOB_RIM: Final = 0.15

REFERENCE_APERTURE: Final = 8.0  # Also what a lens without contacts is set to by hand in the simulated room
# The exposure at which `Room.white_level_share` holds.
REFERENCE_EXPOSURE: Final = ExposureSettings(iso=100, aperture=REFERENCE_APERTURE, shutter_s=0.5)


@dataclass(frozen=True)
class Room:
    """Everything about the lab that is not the chart's drawing and not the camera's body.

    - `seed`: of the paper's shape, the photosites' response and the noise; 0 or more.
    - `fill`: the print's extent over the frame's, along whichever axis is the tighter.
    - `focal_diagonals`: focal length over the frame's diagonal; 1.3 is 35 mm on APS-C. With `fill` it gives the
      distance.
    - `tilt_deg`, `pan_deg`, `roll_deg`: how the print is turned against the camera.
    - `k1`, `k2`, `p1`, `p2`: brown's distortion in normalised coordinates, as OpenCV has it.
    - `waviness_mm`: peak-to-valley height of the paper's surface on an A0 sheet; on another in proportion to its
      diagonal, so that small charts look like large ones.
    - `wave_mm`: wavelength of the paper's waves on an A0 sheet, in proportion as above: short ones, as paper gets in
      damp air; 150 is plausible. 0: long ones, up to three over the sheet's longer side.
    - `curl_mm`: how far the sheet's left and right edges stand off its middle, towards the camera, as paper from a roll
      does; on an A0 sheet, in proportion as above. Negative: away from the camera.
    - `blur_px`: standard deviation of the lens's blur, half-size pixels; the photosite's aperture is added to it.
    - `shoulder_share`, `shoulder_px`: share of the light that lies in the wide part of the lens's point spread, and
      that part's standard deviation along each axis, half-size pixels: an exponential (`sim.optics`,
      with the MTF and two lenses).
    - `veil`: veiling glare: share of the frame's mean light, backdrop included, that lies evenly on all of it.
    - `lateral_red_px`, `lateral_blue_px`: lateral chromatic aberration: how far out the channel sees the frame's corner
      against green, half-size pixels; towards the axis it falls off as `sim.optics` says. Negative:
      inwards.
    - `vignetting`: share of the light that the lens loses at the frame's corner.
    - `projector_falloff`: share of the projector's light that is missing a page's half diagonal from its brightest
      point.
    - `primary_difference`: how differently the primaries fall off: their `projector_falloff` spreads by this share of
      itself, and their brightest points by as much of the page's half diagonal.
    - `lamp_spectrum`: ``uhp`` (mercury lamp and colour wheel) or ``led``.
    - `transfer`: from code to light: ``srgb`` (IEC 61966-2-1) or the exponent of a power law.
    - `black_leak`: share of a primary's full light that is there at code 0: 1 / contrast.
    - `ambient`: light from elsewhere, as a share of the projector's white; of its colour, for it is taken to be stray
      light.
    - `white_level_share`: signal of bare paper in full white at `REFERENCE_EXPOSURE`, strongest channel, over
      saturation − black.
    - `lamp_drift_per_hour`: share of its light that the lamp loses in an hour; the room has no time, so whoever does
      applies it as `lamp`.
    - `response_spread`: standard deviation of the photosites' response (PRNU).
    - `wheel_hz`: turns of the projector's colour wheel per second, each a third red, green and blue; 0 for steady
      light. With a wheel, an exposure that is no whole number of turns, or starts and ends unsteadily, gets more of one
      primary than of another, and frames differ from `signal` and `white` by that.
    - `shutter_jitter_s`: standard deviation of the exposure time; matters with a wheel only.
    - `stain_mm`, `stain_depth`: diameter of a stain somewhere on the print, 0 for none, and the share of blue light
      that it takes; of green it takes six tenths of that, of red three. A thumb's is 25 mm across.
    - `fold_mm`: how far a crease across the print stands off its plane, 0 for none.
    - `hot_per_million`: photosites of a million whose dark current is out of proportion, the same in all frames, 0 for
      none. 20 is plausible for an EOS 550D of ten years, 2 for an EOS 6D Mark II of three (chosen: several times what
      `sim.world.sensors.HotPattern` has from the literature, as bodies are not delivered without any). Where a session
      has dark frames, `build-lut` lists the cells in which one stands out by 30 counts and more as unfit, and
      `generate` replaces their colours; a table computed by `sim table` has none, and keeps them in its images.
    - `hot_dn_per_s`: mean excess of such a photosite, DN per second at ISO 100; exponentially distributed. Chosen: at
      half a second the hottest of a hundred is nearly saturated.
    - `profile`: ``unmanaged``: the file's codes are ink codes. ``managed``: a print shop's profile makes ink codes of
      them, so that greys are grey (`sim.world.world`).
    - `paper`: ``poster``, ``matt`` or ``glossy`` (`sim.spectral.paper`).
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
        """Return the light of primaries, any shape, 0 … 1 of the full, that codes 0 … 255 of any integer dtype give."""
        share = codes / 255
        return decode_srgb(share) if self.transfer == "srgb" else share**self.transfer

    def wheel_light(self, shutter_s: float, random: np.random.Generator) -> NDArray[np.float64]:
        """Return (3,) float64, the light of each primary that the wheel lets through over that of steady light.

        `shutter_s`: exposure time, seconds.
        """
        if self.wheel_hz == 0:
            return np.ones(3)
        start = random.uniform()
        time = max(shutter_s + self.shutter_jitter_s * random.standard_normal(), 0)
        turns = np.array([start, start + time * self.wheel_hz])[:, None]
        segment = np.arange(3) / 3
        shone = np.floor(turns) / 3 + np.clip(turns - np.floor(turns) - segment, 0, 1 / 3)
        return 3 * (shone[1] - shone[0]) / (shutter_s * self.wheel_hz)

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; 0 or more is expected")
        for name in ("fill", "focal_diagonals", "white_level_share", "shoulder_px"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; more than 0 is expected")
        for name in (
            "vignetting", "projector_falloff", "black_leak", "ambient", "stain_depth", "shoulder_share", "veil",
        ):  # fmt: skip
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; 0 … below 1 is expected")
        for name in (
            "waviness_mm", "wave_mm", "blur_px", "response_spread", "primary_difference", "wheel_hz",
            "shutter_jitter_s", "stain_mm", "fold_mm", "hot_per_million", "hot_dn_per_s",
        ):  # fmt: skip
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} is {getattr(self, name)}; 0 or more is expected")


def read_room(seed: int, changes: Mapping[str, Any], where: str, key: str) -> Room:
    """Return the default room with a seed and the changes of a settings file or a command line."""
    known = [field.name for field in fields(Room) if field.name != "seed"]
    return from_settings(Room, changes, where, key, known, seed=seed)


@dataclass(frozen=True)
class Stain:
    """A round stain.

    - `centre_mm`: its middle on the print.
    - `transmittance`: share of red, green and blue light that comes back through it, over that of clean paper.
    """

    centre_mm: tuple[float, float]
    diameter_mm: float
    transmittance: tuple[float, float, float]

    def passed(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the share (..., 3) of red, green and blue light that comes back from points (..., 2)."""
        away = np.linalg.norm(points_mm - np.array(self.centre_mm), axis=-1) - self.diameter_mm / 2
        cover = 1 / (1 + np.exp(np.clip(4 * away / RIM_MM, -40, 40)))
        return 1 - cover[..., None] * (1 - np.array(self.transmittance))


def worn(room: Room, page_mm: tuple[float, float], random: np.random.Generator) -> tuple[Stain | None, Fold | None]:
    """Return a room's stain and fold, somewhere on a sheet of a size, clear of its edges; None where it has none."""
    page = np.array(page_mm)
    x, y = (page * random.uniform(0.25, 0.75, 2)).tolist()
    taken = room.stain_depth * np.array([0.3, 0.6, 1.0])
    red, green, blue = (1 - taken).tolist()
    stain = Stain((x, y), room.stain_mm, (red, green, blue)) if room.stain_mm else None
    along = math.radians(random.uniform(-6, 6))
    crease = float(page[0] * random.uniform(0.3, 0.7)), float(page[1] / 2)
    direction = math.sin(along), math.cos(along)
    return stain, Fold(crease, direction, room.fold_mm, _SLANT) if room.fold_mm else None


def _from_middle(place: Place, at: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far points (..., 2) lie from the middle of a place, across and down: 1 at its sides."""
    left, top, right, bottom = place
    return (2 * at[..., 0] - left - right) / (right - left), (2 * at[..., 1] - top - bottom) / (bottom - top)


@dataclass(frozen=True)
class Patch:
    """A rectangle of another colour in the projected picture.

    - `place`: where it falls.
    - `share`: of the exposure's time that it is there, 0 … 1.
    """

    place: Place
    colour: Colour
    share: float = 1.0

    def cover(self, at: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether points (..., 2) of the page, in shares of it, lie in the rectangle: (...) bool."""
        left, top, right, bottom = self.place
        x, y = at[..., 0], at[..., 1]
        return (x >= left) & (x < right) & (y >= top) & (y < bottom)


@dataclass(frozen=True)
class Blob:
    """Something dark between the chart and the camera, with a soft edge: an ellipse that touches its place's sides.

    - `place`: where it is seen.
    - `left`: light that comes from there, over that of the chart behind it, 0 … 1.
    """

    place: Place
    left: float = 0.08

    def passed(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the share (...) of the chart's light that is seen at points (..., 2) of the page, shares of it."""
        across, down = _from_middle(self.place, at)
        inside = np.clip((1 + _BLOB_RIM / 2 - np.hypot(across, down)) / _BLOB_RIM, 0, 1)
        return 1 - (1 - self.left) * inside * inside * (3 - 2 * inside)


@dataclass(frozen=True)
class Glare:
    """Light that the print's surface mirrors into the camera, unlike what ink and paper scatter: a broad, soft spot.

    - `place`: where it is seen: an ellipse that touches the sides of its place at 1 / e² of its light in the middle.
    - `share`: of the light that bare paper sends there; it has the colour of the projector's light, ambient light
      included.
    """

    place: Place
    share: float = 0.03

    def added(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the mirrored light (...) at points (..., 2) of the page, shares of it, over that of bare paper."""
        across, down = _from_middle(self.place, at)
        return self.share * np.exp(-2 * (across**2 + down**2))


@dataclass(frozen=True, eq=False)
class Situation:
    """What is otherwise than in the undisturbed room while one frame is exposed.

    - `lamp`: light of each primary over the undisturbed.
    - `ambient`: light from elsewhere, of each primary's colour, as a share of its full light; added to the room's own.
    - `picture`: (h, w, 3) float32, what the projector shows during the exposure: the mean over its time of each
      primary's light, 0 … 1 of the full (the codes decoded, not the codes). None: one plain colour. `projected_mm` is
      where it falls.
    - `patches`: of other colours in the picture, each over those before it.
    - `blobs`: what stands before the chart.
    - `glares`: what the print mirrors into the camera.
    - `bump_px`, `bump_mm`: how far the chart has moved in its plane, right and down, in half-size pixels at its middle
      and in millimetres; both count.
    - `turn_deg`: how far it has turned about its middle, clockwise as seen.
    - `defocus_px`: standard deviation of further blur, half-size pixels.
    - `black_dn`: how far the black level lies above the body's, DN.
    """

    lamp: tuple[float, float, float] = (1.0, 1.0, 1.0)
    ambient: tuple[float, float, float] = (0.0, 0.0, 0.0)
    picture: NDArray[np.float32] | None = None
    patches: tuple[Patch, ...] = ()
    blobs: tuple[Blob, ...] = ()
    glares: tuple[Glare, ...] = ()
    bump_px: tuple[float, float] = (0.0, 0.0)
    bump_mm: tuple[float, float] = (0.0, 0.0)
    turn_deg: float = 0.0
    defocus_px: float = 0.0
    black_dn: float = 0.0

    @property
    def is_even(self) -> bool:
        """Whether every place of the chart gets, and shows, the same share of each primary's light."""
        plain = self.picture is None or self.picture.shape[:2] == (1, 1)
        return plain and not self.patches and not self.blobs and not self.glares

    @property
    def view(self) -> tuple[float, ...]:
        """What decides how the chart lies in the picture; equal values have one rendering."""
        return (*self.bump_px, *self.bump_mm, self.turn_deg, self.defocus_px)

    def shown(
        self,
        points_mm: NDArray[np.float64],
        page_mm: tuple[float, float],
        plain: NDArray[np.float64],
        decoded: Callable[[Colour], NDArray[np.float64]],
    ) -> NDArray[np.float64]:
        """Return how much of each primary the projected picture has at points of the print.

        `points_mm`: (..., 2) float64. `plain`: (3,) float64, 0 … 1, the plain colour, where there is no `picture`.
        `decoded`: returns (3,) float64, 0 … 1, the light of a colour's codes. Returns (..., 3) float64, 0 … 1.
        """
        if self.picture is None:
            light = np.broadcast_to(plain, (*points_mm.shape[:-1], 3)).copy()
        else:
            light = sampled(
                self.picture, projected_mm(page_mm, self.picture.shape[1] / self.picture.shape[0]), points_mm
            )
        at = points_mm / np.array(page_mm)
        for patch in self.patches:
            here = patch.cover(at)
            light[here] += patch.share * (decoded(patch.colour) - light[here])
        return light

    def passed(self, points_mm: NDArray[np.float64], page_mm: tuple[float, float]) -> NDArray[np.float64]:
        """Return the share (...) float64 of the chart's light that gets past what stands before points (..., 2) mm."""
        at = points_mm / np.array(page_mm)
        left = np.ones(points_mm.shape[:-1])
        for blob in self.blobs:
            left *= blob.passed(at)
        return left

    def mirrored(self, points_mm: NDArray[np.float64], page_mm: tuple[float, float]) -> NDArray[np.float64]:
        """Return the light (...) float64 that points (..., 2) mm of the print mirror, over what bare paper sends."""
        at = points_mm / np.array(page_mm)
        added = np.zeros(points_mm.shape[:-1])
        for glare in self.glares:
            added += glare.added(at)
        return added


UNDISTURBED: Final = Situation()  # Nothing is otherwise


def projected_mm(page_mm: tuple[float, float], aspect: float) -> Place:
    """Return where the projected picture falls, mm on the print: centred, covering the page and `OVERSCAN`."""
    width, height = (side * (1 + 2 * OVERSCAN) for side in page_mm)
    width, height = max(width, height * aspect), max(height, width / aspect)
    x, y = page_mm[0] / 2, page_mm[1] / 2
    return x - width / 2, y - height / 2, x + width / 2, y + height / 2


def sampled(picture: NDArray[np.float32], place_mm: Place, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a picture's values at points of the print, interpolated linearly; its edge goes on beyond it.

    `picture`: (h, w, 3) float32. `place_mm`: where its corners fall, mm. `points_mm`: (..., 2) float64. Returns (...,
    3) float64.
    """
    from scipy.ndimage import map_coordinates

    left, top, right, bottom = place_mm
    rows, columns, _ = picture.shape
    x = (points_mm[..., 0] - left) / (right - left) * columns - 0.5
    y = (points_mm[..., 1] - top) / (bottom - top) * rows - 0.5
    at = np.stack([y, x])
    channels = [map_coordinates(picture[..., one], at, np.float64, order=1, mode="nearest") for one in range(3)]
    return np.stack(channels, axis=-1)


def moved(
    points_mm: NDArray[np.float64], middle_mm: ArrayLike, by_mm: ArrayLike, turn_deg: float
) -> NDArray[np.float64]:
    """Return where points of the chart are after it was turned about its middle and then pushed.

    `points_mm`: (..., 2) float64. `middle_mm`, `by_mm`: (2,) float64, where it turns, and how far it is pushed. Returns
    (..., 2) float64, mm in the room's own coordinates, which are those of the chart before.
    """
    return (points_mm - np.asarray(middle_mm)) @ _turned(turn_deg).T + np.asarray(middle_mm) + np.asarray(by_mm)


def moved_back(
    points_mm: NDArray[np.float64], middle_mm: ArrayLike, by_mm: ArrayLike, turn_deg: float
) -> NDArray[np.float64]:
    """Return which points (..., 2) float64, mm, of the chart lie at places (..., 2) of the room: `moved` undone."""
    return (points_mm - np.asarray(by_mm) - np.asarray(middle_mm)) @ _turned(turn_deg) + np.asarray(middle_mm)


def _turned(turn_deg: float) -> NDArray[np.float64]:
    cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    return np.array([[cosine, -sine], [sine, cosine]])


class World:
    """A print, a body and a room; the rules stand at the head of this file.

    The first frame takes a few seconds for the rendering, which is kept: 12 bytes a photosite. Any thread may ask.
    """

    def __init__(self, sheet: Print, body: Body, room: Room) -> None:
        self.sheet = sheet
        self.body = body
        self.room = room
        rows, columns = body.half_size
        self.stain, self.fold = worn(room, sheet.page_mm, self._random(5))
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
        """Return a frame.

        `settings`: light grows with shutter time and ISO speed and falls with the square of the f-number. Returns
        (rows, columns) uint16, the whole sensor's counts, masked borders included; never above saturation.
        """
        body, room = self.body, self.room
        of_lamp = lamp * room.wheel_light(settings.shutter_s, self._random(4, *key)) * np.array(situation.lamp)
        light, weights = self._lighting(colour, settings, of_lamp, situation)
        visible = body.visible
        black = body.black + situation.black_dn
        noise_dn, gain_e = body.noise_dn(settings.iso), body.gain_e(settings.iso)
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
            self._heat(frame[first:last], noise, light, weights, settings, first)

        _in_blocks(body.sensor[0], block)
        return frame

    def _heat(
        self,
        frame: NDArray[np.uint16],
        noise: NDArray[np.float32],
        light: NDArray[np.float32],
        drive: NDArray[np.float32],
        settings: ExposureSettings,
        first: int,
    ) -> None:
        """Raise the counts of hot photosites among some rows of a frame, the first of which is `first`."""
        hot, visible = self.hot.within(first, first + len(frame)), self.body.visible
        y, x = hot.rows + first - visible.top, hot.columns - visible.left
        seen = (y >= 0) & (y < visible.height) & (x >= 0) & (x < visible.width)
        lit = np.zeros(len(hot.rows))
        lit[seen] = drive.astype(np.float64) @ light[:, y[seen], x[seen]]
        hot.raise_counts(frame, noise, lit, self.body, settings.iso, settings.shutter_s)

    def _lighting(
        self, colour: Colour, settings: ExposureSettings, lamp: NDArray[np.float64], situation: Situation
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return light (3, rows, columns) on the photosites and weights (3,), whose product is a frame's signal."""
        (light, veil), ambient = self._render(situation), np.array(situation.ambient)
        plain = self.decoded(colour) if situation.picture is None else situation.picture[0, 0].astype(np.float64)
        if situation.is_even:
            return light, self._collected(plain, settings, lamp, ambient).astype(np.float32)
        nodes, page = self._nodes(UNDISTURBED), self.sheet.page_mm
        falling = np.empty_like(light)

        def block(first: int, last: int) -> None:
            points = self._points(nodes, first, last)
            shown = self._collected(situation.shown(points, page, plain, self.decoded), settings, lamp, ambient)
            shown *= situation.passed(points, page)[..., None]
            there = self.lens.unveiled(light[:, first:last], veil, first)
            if situation.glares:
                there = there + self._mirrored(points, situation, first)
            falling[:, first:last] = there * shown.transpose(2, 0, 1)

        _in_blocks(self.body.visible.height, block)
        self.lens.veiled(falling, self.body.pattern)
        return falling, np.ones(3, dtype=np.float32)

    def _mirrored(self, points: NDArray[np.float64], situation: Situation, first: int) -> NDArray[np.float32]:
        """Return (3, rows, columns) float32: what photosites of rows from `first` on get by mirroring, as `_render`."""
        row, column = np.mgrid[first : first + len(points), : points.shape[1]]
        paper = self._signals(self._reflectance([PAPER]))[0][self._channels()[row % 2, column % 2]]
        added = situation.mirrored(points, self.sheet.page_mm)[..., None] * self.field(points) * paper
        return added.transpose(2, 0, 1).astype(np.float32)

    def _channels(self) -> NDArray[np.int64]:
        """Return (2, 2) int64: the camera channel of a photosite by the parity of its row and column."""
        return np.array([_CHANNELS.index(letter) for letter in self.body.pattern], dtype=np.int64).reshape(2, 2)

    def decoded(self, colour: Colour) -> NDArray[np.float64]:
        """Return (3,) float64, 0 … 1: the light of each primary that a colour's codes stand for."""
        return self._light_of_code[list(colour)]

    def signal(
        self, colour: Colour, settings: ExposureSettings, lamp: float = 1.0, situation: Situation = UNDISTURBED
    ) -> NDArray[np.float32]:
        """Return what a frame would be without noise, black, hot photosites and clipping, by a wheel's mean light.

        Returns (rows, columns) float32, DN above black, of the body's visible photosites, their response included.
        """
        light, drive = self._lighting(colour, settings, lamp * np.array(situation.lamp), situation)
        return np.tensordot(drive, light, 1)

    def project(
        self, points_mm: NDArray[np.float64], channel: str = "G", situation: Situation = UNDISTURBED
    ) -> NDArray[np.float64]:
        """Return the half-size pixels where points of the print are seen.

        `points_mm`: (..., 2) float64, millimetres. Returns (..., 2) float64, x then y.
        """
        points = np.asarray(points_mm, dtype=np.float64)
        if any(situation.view):
            points = moved(points, np.array(self.sheet.page_mm) / 2, self._bumped(situation), situation.turn_deg)
        return self.lens.shifted(self.view.project(points), channel)

    def white(self, colour: Colour, settings: ExposureSettings, lamp: float = 1.0) -> NDArray[np.float64]:
        """Return (3,) float64: R, G, B of bare paper in DN above black, without clipping, where `field` is 1."""
        return self.reflected([PAPER], colour, settings, lamp)[0]

    def reflected(
        self, rgb: ArrayLike, colour: Colour, settings: ExposureSettings, lamp: float = 1.0
    ) -> NDArray[np.float64]:
        """Return the true linear camera RGB of printed codes.

        `rgb`: (N, 3) float or int codes 0 … 255. Returns (N, 3) float64, DN above black where `field` is 1, leak and
        ambient light included, without clipping.
        """
        return self._signals(self._reflectance(rgb)) @ self.drive(colour, settings, lamp)

    def seen(
        self,
        rgb: ArrayLike,
        points_mm: NDArray[np.float64],
        colour: Colour,
        settings: ExposureSettings,
        lamp: float = 1.0,
    ) -> NDArray[np.float64]:
        """Return the true linear camera RGB of printed codes at points of the print, in the light that falls there.

        `rgb`: (N, 3) float or int codes 0 … 255. `points_mm`: (N, 2) float64. Returns (N, 3) float64, DN above black,
        without clipping: what the photosites there get where nothing is blurred, stain and fold included.
        """
        light = self.field(points_mm) * self.drive(colour, settings, lamp)
        return np.einsum("ncp,np->nc", self._signals(self._reflectance(rgb)), light) * self.worn(points_mm)

    def of_primaries(self, rgb: ArrayLike, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what printed codes at points of a clean flat print give under each primary alone, at full drive.

        `rgb`: (N, 3) float or int codes 0 … 255. `points_mm`: (N, 2) float64. Returns (N, 3, 3) float64, DN above black
        at the reference exposure, [point, channel, primary], where nothing is blurred. Its product with `drive` is
        `seen`, without stain and fold.
        """
        return self._signals(self._reflectance(rgb)) * self.field(points_mm)[:, None]

    def drive(
        self,
        colour: Colour,
        settings: ExposureSettings,
        lamp: float | NDArray[np.float64] = 1.0,
        ambient: float | NDArray[np.float64] = 0.0,
    ) -> NDArray[np.float64]:
        """Return (3,) float64: how much of each primary's light at full drive a frame collects, gain included.

        Parameters are those of `expose`; `lamp` may be (3,), of each primary its own, and so may `ambient`, which is
        added to the room's.
        """
        return self._collected(self.decoded(colour), settings, lamp, ambient)

    def _collected(
        self,
        linear: NDArray[np.float64],
        settings: ExposureSettings,
        lamp: float | NDArray[np.float64],
        ambient: float | NDArray[np.float64],
    ) -> NDArray[np.float64]:
        leak = self.room.black_leak
        shown = lamp * (leak + (1 - leak) * linear) + self.room.ambient + ambient
        reference = REFERENCE_EXPOSURE
        time = settings.shutter_s / reference.shutter_s
        # A lens that the body does not set stands as it does for the reference.
        opening = 1.0 if settings.aperture is None else (REFERENCE_APERTURE / settings.aperture) ** 2
        return shown * time * opening * (settings.iso / reference.iso)

    def worn(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what stain and fold leave of the light of a clean flat print.

        `points_mm`: (..., 2) float64. Returns (..., 3) float64 for red, green and blue of the camera; 1 where the print
        is clean and flat.
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

        `points_mm`: (..., 2) float64. Returns (..., 3) float64, for each primary of the projector (red, green, blue).
        The lens is 1 on its axis and green 1 at its brightest point; red and blue are balanced so that the three have
        one mean over the sheet. So `white` has the chromaticity of the light that the sheet receives on the whole. A
        camera channel sees the mean of the three weighted by what it receives of each.
        """
        points = np.asarray(points_mm, dtype=np.float64)
        photosites = 2 * self.project(points) + 0.5
        from_axis = ((photosites - self._vignetting[:2]) ** 2).sum(axis=-1)
        passed = 1 / (1 + self._vignetting[2] * from_axis) ** 2
        from_spot = ((points[..., None, :] - self._falloff[:, :2]) ** 2).sum(axis=-1)
        return passed[..., None] * self._falloff[:, 3] / (1 + self._falloff[:, 2] * from_spot)

    def _balance(self) -> NDArray[np.float64]:
        """Return (3,) the gains of the primaries that give all three green's mean over the sheet."""
        width, height = self.sheet.page_mm
        x, y = np.meshgrid((np.arange(60) + 0.5) * width / 60, (np.arange(40) + 0.5) * height / 40)
        means = self.field(np.stack([x, y], axis=-1)).mean(axis=(0, 1))
        return means[1] / means

    def _reflectance(self, rgb: ArrayLike) -> NDArray[np.float64]:
        """Return (N, 81): reflectance of the chart's codes (N, 3) on this print."""
        return printed_reflectance(rgb, self.room.profile, self.room.paper)

    def _signals(self, reflectance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (N, 3, 3): DN of (N, 81) reflectances at the reference exposure, [colour, channel, primary]."""
        seen = self._primaries[None] * self._sensitivities.T[:, None] * self._dn
        return (reflectance @ seen.reshape(9, -1).T).reshape(-1, 3, 3)

    def _random(self, *key: int) -> np.random.Generator:
        return np.random.Generator(np.random.SFC64([self.room.seed, *key]))

    def _render(self, situation: Situation = UNDISTURBED) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return (3, rows, columns) and (3, 2, 2) float32: DN of the visible photosites under each primary alone.

        The second is the veil's part of it, by the parity of row and column. Kept are the undisturbed rendering and one
        other: a chart is bumped once, then it stays.
        """
        with self._lock:
            if situation.view not in self._rendered:
                kept = self._rendered.get(UNDISTURBED.view)
                self._rendered = {} if kept is None else {UNDISTURBED.view: kept}
                self._rendered[situation.view] = self._lit(situation)
            return self._rendered[situation.view]

    def _lit(self, situation: Situation) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        from sim.world.rendering import light

        visible, room = self.body.visible, self.room
        drawing, channels = label_map(self.sheet), self._channels()
        backdrop = np.full((1, len(self._sensitivities)), _BACKDROP_REFLECTANCE)
        reflectance = np.concatenate([self._reflectance(drawing.codes), backdrop])
        table = self._signals(reflectance).astype(np.float32)
        nodes = self._nodes(situation)
        views = [nodes]
        if self.lens.splits_colours:
            views = [self._nodes(situation, channel) for channel in _CHANNELS]
        sigma = ((2 * room.blur_px) ** 2 + (2 * situation.defocus_px) ** 2 + APERTURE_VARIANCE) ** 0.5
        out = np.empty((3, visible.height, visible.width), dtype=np.float32)
        # The projector stays where it is.
        falloff = self._falloff.copy()
        falloff[:, :2] = self._moved_back(falloff[:, :2], situation)

        places, lines, spread = np.stack(views), (drawing.x_lines, drawing.y_lines), room.shoulder_share > 0

        def block(first: int, last: int) -> None:
            # Shoulders lie between the print and the photosites' response.
            response = np.ones((last - first, visible.width), np.float32) if spread else self._response(first, last)
            if self.stain is not None or self.fold is not None:
                response *= self._worn_rows(nodes, channels, first, last)
            rows, lens = out[:, first:last], self._vignetting
            light(first, places, sigma, *lines, drawing.labels, table, channels, lens, falloff, response, rows)

        def respond(first: int, last: int) -> None:
            out[:, first:last] *= self._response(first, last)

        _in_blocks(visible.height, block)
        if spread:
            self.lens.spread(out)
            _in_blocks(visible.height, respond)
        return out, self.lens.veiled(out, self.body.pattern)

    def _response(self, first: int, last: int) -> NDArray[np.float32]:
        """Return (rows, columns) float32, about 1: the response of the photosites of a block of rows."""
        response = self._random(3, first).standard_normal((last - first, self.body.visible.width), dtype=np.float32)
        response *= np.float32(self.room.response_spread)
        response += np.float32(1)
        return response

    def _moved_back(self, points_mm: NDArray[np.float64], situation: Situation) -> NDArray[np.float64]:
        """Return which points of the chart lie where, undisturbed, points (..., 2) mm of it lie."""
        if not any(situation.view):
            # Rounding would make other counts of the undisturbed chart, here and there one.
            return points_mm
        return moved_back(points_mm, np.array(self.sheet.page_mm) / 2, self._bumped(situation), situation.turn_deg)

    def _bumped(self, situation: Situation) -> NDArray[np.float64]:
        """Return (2,) float64 mm, how far the chart has been pushed."""
        view = self.view
        return np.array(situation.bump_mm) + np.array(situation.bump_px) * (view.distance_mm / view.focal_px)

    def _points(self, nodes: NDArray[np.float64], first: int, last: int) -> NDArray[np.float64]:
        """Return (rows, columns, 2) float64, mm: the places on the print that some rows of photosites see."""
        from scipy.ndimage import map_coordinates

        row, column = np.mgrid[first:last, : self.body.visible.width]
        at = np.stack([row, column]) / GRID_PX + 1
        return np.stack([map_coordinates(nodes[..., axis], at, order=1) for axis in (0, 1)], axis=-1)

    def _worn_rows(
        self, nodes: NDArray[np.float64], channels: NDArray[np.int64], first: int, last: int
    ) -> NDArray[np.float32]:
        """Return (rows, columns) float32: what stain and fold leave of the light on each photosite of some rows."""
        row, column = np.mgrid[first:last, : self.body.visible.width]
        points = self._points(nodes, first, last)
        channel = channels[row % 2, column % 2]
        return np.take_along_axis(self.worn(points), channel[..., None], axis=-1)[..., 0].astype(np.float32)

    def _nodes(self, situation: Situation, channel: str = "G") -> NDArray[np.float64]:
        """Return (ny, nx, 2) float64: the place on the print of every 16th photosite, one node beyond on each side."""
        visible = self.body.visible
        y, x = (np.arange(-1, (size - 1) // GRID_PX + 3) * GRID_PX for size in (visible.height, visible.width))
        photosites = np.stack(np.meshgrid(x, y), axis=-1).astype(np.float64)
        seen = self.lens.unshifted((photosites - 0.5) / 2, channel)
        return self._moved_back(self.view.locate(seen), situation)


def _in_blocks(rows: int, work: Callable[[int, int], None]) -> None:
    """Call `work` for each block of rows (first, last + 1), on as many threads as there are processors."""
    firsts = range(0, rows, _BLOCK_ROWS)
    with ThreadPoolExecutor(processor_count()) as threads:
        for done in [threads.submit(work, first, min(first + _BLOCK_ROWS, rows)) for first in firsts]:
            done.result()


def sheet_of(room: Room, page_mm: tuple[float, float], fold: Fold | None) -> Sheet:
    """Return the shape of a room's sheet; waves and curl shrink with its size."""
    size = math.hypot(*page_mm) / _A0_DIAGONAL_MM
    waves = Waviness.random(room.seed, room.waviness_mm * size, page_mm, wave_mm=room.wave_mm * size)
    return Sheet(waves, room.curl_mm * size, fold)
