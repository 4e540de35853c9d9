"""What lights the chart: the simulated projector under its codes, or any spectra from one luminaire.

Light adds: a frame under a projector's light is the weighted sum of the same frame under each of its three primaries.
A luminaire has one spectrum a light, and so one frame of its own for each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from calibration.radiometry.primaries import pure_lights
from drivers.camera import ExposureSettings
from drivers.presenter import WHITE
from experiment.lights import Illumination
from sim.world.drawing import PAPER
from sim.world.profile import printed_reflectance
from sim.world.spectra import sensitivities
from sim.world.world import World
from synthesis.patch_frames import PatchSensor

_Array = npt.NDArray[np.float64]
_Float = npt.NDArray[np.float32]


class ChartLamp(Protocol):
    """What lights the chart."""

    @property
    def illuminations(self) -> Sequence[Illumination]:
        """The lights."""
        ...

    def lit(self, light: int) -> tuple[_Float, _Array]:
        """Return the light on every photosite by primary, (3, rows, columns) float32, and the primaries' weights (3,).

        As `synthesis.patch_frames.PatchSensor.expose` takes them, for the frame of a light.
        """
        ...

    def even(self) -> tuple[_Float, _Array]:
        """Return the same, (3, rows, columns) and (3,), for the frame that the flat field is read from first."""
        ...

    def pure(self) -> tuple[int, int, int] | None:
        """Return the lights of red, green and blue alone; None where the light has no primaries."""
        ...


@dataclass(frozen=True, eq=False)
class ProjectorLamp:
    """The simulated projector.

    - `world`: room, body and page.
    - `settings`: the exposure of every frame.
    - `illuminations`: the lights and their codes.
    - `light`: (3, rows, columns) float32, the light on every photosite under each primary at full drive.
    """

    world: World
    settings: ExposureSettings
    illuminations: tuple[Illumination, ...]
    light: _Float

    @staticmethod
    def of(
        world: World,
        settings: ExposureSettings,
        illuminations: tuple[Illumination, ...],
        sensor: PatchSensor,
        rgb: npt.NDArray[np.uint8],
        points_mm: _Array,
    ) -> ProjectorLamp:
        """Return the projector in front of patches of printed codes (N, 3) at points (N, 2) of the print."""
        return ProjectorLamp(world, settings, illuminations, sensor.light(world.of_primaries(rgb, points_mm)))

    def lit(self, light: int) -> tuple[_Float, _Array]:
        """Return light (3, rows, columns) float32 and weights (3,) of a light's frame; see `ChartLamp.lit`."""
        return self.light, self.world.drive(self.illuminations[light].colour, self.settings)

    def even(self) -> tuple[_Float, _Array]:
        """Return light (3, rows, columns) float32 and weights (3,) of a white frame."""
        return self.light, self.world.drive(WHITE, self.settings)

    def pure(self) -> tuple[int, int, int] | None:
        """Return the lights of red, green and blue alone; None where one is not planned."""
        return pure_lights(self.illuminations)


@dataclass(frozen=True, eq=False)
class SpectralLamp:
    """A luminaire of one spectrum a light, all from one place, so that one field holds for every wavelength.

    Each light is exposed so that bare paper's strongest channel reaches the room's `white_level_share`, as a
    photographer would: a table of spectra has no brightness of its own.

    - `world`: body, print and room; the field is that of its projector's green.
    - `powers`: (L, 81) float64, relative power of each per nm.
    - `sensor`: the photosites under the patches.
    - `reflectance`: (N, 81) float64, of each patch's print.
    - `field`: (N,) float64, the light on each patch over that in the brightest place.
    """

    world: World
    illuminations: tuple[Illumination, ...]
    powers: _Array
    sensor: PatchSensor
    reflectance: _Array
    field: _Array

    @staticmethod
    def of(
        world: World,
        illuminations: tuple[Illumination, ...],
        powers: _Array,
        sensor: PatchSensor,
        rgb: npt.NDArray[np.uint8],
        points_mm: _Array,
    ) -> SpectralLamp:
        """Return a luminaire of spectra (L, 81) before patches of printed codes (N, 3) at points (N, 2), mm."""
        room = world.room
        reflectance = printed_reflectance(rgb, room.profile, room.paper)
        return SpectralLamp(world, illuminations, powers, sensor, reflectance, world.field(points_mm)[:, 1])

    def signals(self, light: int) -> _Array:
        """Return what each patch gives under a light, (N, 3) float64 DN above black, where nothing is blurred."""
        room, body = self.world.room, self.world.body
        seen = self.powers[light][:, None] * sensitivities(body.sensitivities)
        paper = printed_reflectance([PAPER], room.profile, room.paper)[0] @ seen
        level = room.white_level_share * (body.saturation - body.black) / float(paper.max())
        return (self.reflectance @ seen) * level * self.field[:, None]

    def lit(self, light: int) -> tuple[_Float, _Array]:
        """Return light (3, rows, columns) float32 and weights (3,) of a light's frame; see `ChartLamp.lit`."""
        return self.sensor.light(self.signals(light)[:, :, None]), np.array([1.0, 0.0, 0.0])

    def even(self) -> tuple[_Float, _Array]:
        """Return light (3, rows, columns) float32 and weights (3,) of the frame of the whitest light."""
        whites = self.powers @ sensitivities(self.world.body.sensitivities)
        # The light whose weakest channel is the strongest shows the field best in all three.
        return self.lit(int((whites.min(axis=1) / whites.max(axis=1)).argmax()))

    def pure(self) -> tuple[int, int, int] | None:
        """Return None: one field holds for all wavelengths, so that a coloured cell's is that of paper."""
        return None
