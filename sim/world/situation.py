"""How one frame's circumstances differ from those of the undisturbed room: picture, light, chart, lens, sensor.

Frozen values, and pure functions of places on the print. `sim.world.world.World.expose` takes a `Situation`;
`sim.world.disturbances` makes one of what has gone wrong. Places are shares of the page unless said: (0, 0) is its
top-left corner, (1, 1) its bottom-right one, and what reaches beyond lies off the page.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.presenter import Colour

Place = tuple[float, float, float, float]
"""A rectangle: left, top, right, bottom, shares of the page."""

OVERSCAN: Final = 0.04
"""Share of the page by which the projected picture reaches beyond it where it is nearest: an operator zooms until the
whole sheet is lit, and a little more."""

_BLOB_RIM: Final = 0.15
"""Share of a blob's radius over which its edge fades: what stands a metre before the chart is out of focus."""


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
        left, top, right, bottom = self.place
        x, y = at[..., 0], at[..., 1]
        away = np.hypot((2 * x - left - right) / (right - left), (2 * y - top - bottom) / (bottom - top))
        inside = np.clip((1 + _BLOB_RIM / 2 - away) / _BLOB_RIM, 0, 1)
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
        left, top, right, bottom = self.place
        x, y = at[..., 0], at[..., 1]
        away2 = ((2 * x - left - right) / (right - left)) ** 2 + ((2 * y - top - bottom) / (bottom - top)) ** 2
        return self.share * np.exp(-2 * away2)


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


UNDISTURBED: Final = Situation()
"""Nothing is otherwise."""


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
