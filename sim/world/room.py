"""The simulated lab around the camera: light, lens, print and what is wrong with them, as one frozen value.

**Handling.** A stain is a filter on the paper, of one colour, with a soft rim. A fold is a crease that does not lie
flat: the sheet rises towards it on both sides, so that the crease stands off the plane, and either flank is turned a
little towards the light or away from it. Pure functions of places on the print, millimetres from its top-left corner.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from drivers.camera import ExposureSettings
from foundation.colorimetry import decode_srgb
from foundation.records import from_settings
from sim.spectral import LampSpectrum, PaperName, ProfileName

REFERENCE_APERTURE: Final = 8.0
"""Also what a lens without contacts is set to by hand in the simulated room."""
REFERENCE_EXPOSURE: Final = ExposureSettings(iso=100, aperture=REFERENCE_APERTURE, shutter_s=0.5)
"""The exposure at which `Room.white_level_share` holds."""


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
      them, so that greys are grey (`sim.world.room`).
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


_SLANT: Final = 0.36
"""Tangent of 20°: a projector beside the camera."""

RIM_MM = 1.0
"""Over which a stain's edge fades."""

ROUND_MM = 4.0
"""Paper bends; a crease is no sharper than this."""

FLANK_MM = 40.0
"""From the crease to where the sheet lies flat again, to 1 / e."""


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


@dataclass(frozen=True)
class Fold:
    """A crease across the sheet, from its upper to its lower edge.

    - `at_mm`: A point of the crease.
    - `along`: its direction, a unit vector.
    - `height_mm`: how far the crease stands off the plane, towards the camera.
    - `slant`: change of the light with a flank's slope: the tangent of the angle under which the light falls in.
    """

    at_mm: tuple[float, float]
    along: tuple[float, float]
    height_mm: float
    slant: float

    def _away(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance (...) of points from the crease, positive on its right."""
        x, y = np.moveaxis(points_mm - np.array(self.at_mm), -1, 0)
        return x * self.along[1] - y * self.along[0]

    def height(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height (...) in mm of points (..., 2)."""
        rounded = np.hypot(self._away(points_mm), ROUND_MM) - ROUND_MM
        return self.height_mm * np.exp(-rounded / FLANK_MM)

    def shade(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the light (...) on points (..., 2) over that on a flat sheet."""
        away = self._away(points_mm)
        slope = -self.height(points_mm) * away / np.hypot(away, ROUND_MM) / FLANK_MM
        return 1 + self.slant * slope


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
