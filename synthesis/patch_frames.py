"""Frames that hold nothing but the middle of each patch: what the simulated camera gives where a table is sampled.

A frame of a session has some twenty million photosites, of which a table takes a sixth: the 10 by 10 photosites in the
middle of each cell (25 half-size pixels), and those of the references. Here these alone exist, patch below patch in a
frame as wide as one patch. Their light is what the simulated room would let fall on them without the lens's blur; their
counts come from the simulated sensor itself (`sim.world.rendering.counts`), so that response, shot and read noise,
rounding and saturation are those of a photographed frame, and calibration's own functions sample them as they do any
other frame.

What differs from a photographed frame: nothing is blurred, so no light leaks between neighbouring cells; all of a patch
has the light of its middle; the chart lies exactly where it is looked for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from calibration.sampling import Sites
from drivers.raw.rawfile import Area, Mosaic
from sim.world.room import Room
from sim.world.sensors import Body, HotPattern

_CHANNELS: Final = "RGB"

_RESPONSE, _NOISE, _BLACK, _HOT = 11, 12, 13, 14
"""Purposes of the random streams, so that none is drawn from twice; those of `sim.world.world` are below 10."""

_SKIPPED_COLUMNS: Final = 4
"""Columns of a masked area that its black level is not read from, as `drivers.raw.rawfile` leaves them out."""

_Array = npt.NDArray[np.float64]
_Float = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PatchSensor:
    """The photosites under the patches of a chart, with their response.

    - `body`: the camera's body.
    - `patches`: N, how many patches there are.
    - `window`: half-size pixels along a patch's side.
    - `seed`: of response and noise.
    - `response`: (N · 2 · window, 2 · window) float32, what each photosite gives over what it should: the fixed
      pattern.
    - `hot`: the photosites whose dark current is out of proportion.
    - `shutter_s`: exposure time of every frame, seconds: their excess grows with it.
    """

    body: Body
    patches: int
    window: int
    seed: int
    response: _Float
    hot: HotPattern
    shutter_s: float

    @staticmethod
    def of(body: Body, patches: int, window: int, room: Room, shutter_s: float) -> PatchSensor:
        """Return the sensor of a body under so many patches, with what a room says of its photosites."""
        seed, response_spread = room.seed, room.response_spread
        shape = (patches * 2 * window, 2 * window)
        response = _random(seed, _RESPONSE).standard_normal(shape, dtype=np.float32)
        response *= np.float32(response_spread)
        response += np.float32(1)
        response.setflags(write=False)
        hot = HotPattern.drawn(_random(seed, _HOT), shape, room.hot_per_million, room.hot_dn_per_s)
        return PatchSensor(body, patches, window, seed, response, hot, shutter_s)

    @property
    def sites(self) -> Sites:
        """Where the patches lie in a frame."""
        reach = self.window // 2
        rows = np.arange(self.patches, dtype=np.int64) * self.window + reach
        columns = np.full(self.patches, reach, dtype=np.int64)
        return Sites(rows, columns, np.ones(self.patches, dtype=np.bool_), self.window)

    def light(self, signals: _Array) -> _Float:
        """Return the light on every photosite.

        `signals`: (N, 3, P) float64, DN above black of each patch by channel under each of P ≤ 3 primaries. Returns (3,
        N · 2 · window, 2 · window) float32, response included; 0 for primaries that are not given.
        """
        side = 2 * self.window
        found = np.zeros((3, *self.response.shape), dtype=np.float32)
        by_patch = self.response.reshape(self.patches, side, side)
        for primary in range(signals.shape[2]):
            out = found[primary].reshape(self.patches, side, side)
            for place, letter in enumerate(self.body.pattern):
                level = signals[:, _CHANNELS.index(letter), primary].astype(np.float32)
                part = np.s_[:, place // 2 :: 2, place % 2 :: 2]
                np.multiply(by_patch[part], level[:, None, None], out=out[part])
        return found

    def expose(self, light: _Float, weights: _Array, iso: int, frame: int) -> tuple[Mosaic, _Array]:
        """Return a frame, and its black level as a masked border would show it.

        `light`: (3, N · 2 · window, 2 · window) float32, what `light` returned. `weights`: (3,) float64, how much of
        each primary the frame collects. `iso`: ISO speed, which sets gain and read noise. Returns (N · 2 · window, 2 ·
        window) counts, without borders. Returns (2, 2) float64 counts, the estimate for each position of the block: the
        mean of as many dark counts as the body has masked photosites there, or its true black where it has none.
        """
        from sim.world.rendering import counts

        body = self.body
        noise = _random(self.seed, _NOISE, frame).standard_normal(self.response.shape, dtype=np.float32)
        found = np.empty(self.response.shape, dtype=np.uint16)
        noise_dn, gain_e = body.noise_dn(iso), body.gain_e(iso)
        counts(light, weights.astype(np.float32), noise, 0, float(body.black), noise_dn, gain_e, body.saturation, found)
        lit = weights @ light[:, self.hot.rows, self.hot.columns]
        self.hot.raise_counts(found, noise, lit, body, iso, self.shutter_s)
        found.setflags(write=False)
        black = np.full((2, 2), float(body.black))
        masked = sum(area.height * max(area.width - _SKIPPED_COLUMNS, 0) for area in body.masked) // 4
        if masked:
            # Rounding to whole counts adds the variance of an even distribution one count wide.
            error = ((noise_dn**2 + 1 / 12) / masked) ** 0.5
            black += error * _random(self.seed, _BLACK, frame).standard_normal((2, 2))
        side = 2 * self.window
        mosaic = Mosaic(
            counts=found,
            pattern=body.pattern,
            black=np.full((2, 2), float(body.black)),
            white_level=body.saturation,
            camera=body.camera,
            sensor=found,
            visible=Area(0, 0, self.patches * side, side),
            masked=(),
            iso=iso,
        )
        return mosaic, black


def _random(*key: int) -> np.random.Generator:
    return np.random.Generator(np.random.SFC64(key))
