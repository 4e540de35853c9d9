"""Frames taken for a check: shown, exposed, read, and thrown away."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from acquisition.run.devices import Devices
from drivers.camera import capture
from drivers.presenter import Colour
from drivers.raw.rawfile import Mosaic, read_raw
from experiment.config import LabSettings
from experiment.framing.planes import CHANNELS, frame_black, phases
from foundation.errors import DeviceError


@dataclass(frozen=True, eq=False)
class Shot:
    """One frame.

    `mosaic`: its counts.

    - `colour`: what was shown.
    - `shutter_s`: the shutter time that was set, seconds.
    - `took_s`: seconds from the release until the file was here, by the lab's clock.
    - `size`: bytes of its file.
    """

    colour: Colour
    shutter_s: float
    mosaic: Mosaic
    took_s: float
    size: int

    def brightest(self, percentile: float) -> npt.NDArray[np.float64]:
        """Return (3,) float64: counts above black of R, G and B at a percentile of their photosites."""
        black, blocks = frame_black(self.mosaic), self.mosaic.block_planes()[:, :, ::2, ::2]
        found = phases(self.mosaic)
        return np.array(
            [
                max(float(np.percentile(blocks[place], percentile) - black[place]) for place in found[channel])
                for channel in CHANNELS
            ]
        )


class Photographer:
    """Takes frames with the devices of a rig; each is read and its file deleted.

    `settings`: the lab's; ISO speed and aperture are never changed.
    """

    def __init__(self, devices: Devices, settings: LabSettings, scratch: Path) -> None:
        self._devices = devices
        self._settings = settings
        self._file = scratch / "frame"
        self._shutter_s = settings.camera.shutter_s
        self.timings: list[tuple[float, float]] = []
        """Of every frame taken: shutter time and the time until its file was here, seconds."""
        self.focal_px: float | None = None
        """Focal length in half-size px, as the last frame's file states it; None where it does not."""

    def take(self, colour: Colour, shutter_s: float | None = None) -> Shot:
        """Return a frame of a plain colour, at the shutter time of the settings unless another is given."""
        devices, settings = self._devices, self._settings
        wanted = settings.camera.shutter_s if shutter_s is None else shutter_s
        if wanted != self._shutter_s:
            devices.camera.configure(replace(settings.camera.exposure, shutter_s=wanted))
            self._shutter_s = wanted
        devices.presenter.show(colour)
        devices.clock.sleep(settings.sequence.settle_s)
        begun = devices.clock.monotonic()
        with self._file.open("wb") as stream:
            size = capture(devices.camera, stream).size
        took = devices.clock.monotonic() - begun
        self.timings.append((wanted, took))
        mosaic = read_raw(self._file)
        self.focal_px = stated_focal_px(self._file, mosaic)
        self._file.unlink()
        return Shot(colour, wanted, mosaic, took, size)

    def restore(self) -> None:
        """Set the shutter time of the settings again."""
        if self._shutter_s != self._settings.camera.shutter_s:
            self._devices.camera.configure(self._settings.camera.exposure)
            self._shutter_s = self._settings.camera.shutter_s

    @contextmanager
    def muted(self) -> Generator[None]:
        """Blank the projector's picture meanwhile."""
        projector = self._devices.projector
        if projector is None:
            raise DeviceError("the projector is not under control (lab.projector.control)")
        projector.set_muted(True)
        try:
            if not projector.muted():
                raise DeviceError("the projector does not mute its picture")
            yield
        finally:
            projector.set_muted(False)


def stated_focal_px(path: Path, mosaic: Mosaic) -> float | None:
    """Return the focal length in half-size px that a raw file states; None where it states none.

    Exif 2.32: FocalLength in mm times FocalPlaneXResolution in pixels to the unit of FocalPlaneResolutionUnit, pixels
    of a picture of the size that Exif states, which is taken to be the visible one to a hundredth.
    """
    from drivers.tiff import TiffDamaged, TiffTag, is_tiff, read_directories
    from foundation.files import read_whole

    data = read_whole(path)
    if not is_tiff(data):
        return None
    try:
        directories = read_directories(data)
    except TiffDamaged:
        return None
    for directory in directories:
        focal, density = (directory.numbers(tag) for tag in (TiffTag.FOCAL_LENGTH, TiffTag.FOCAL_PLANE_X_RESOLUTION))
        unit = (directory.integers(TiffTag.FOCAL_PLANE_RESOLUTION_UNIT) or (2,))[0]
        mm = {2: 25.4, 3: 10.0, 4: 1.0}.get(unit)
        if focal and density and mm and focal[0] > 0 and density[0] > 0:
            pixels = focal[0] * density[0] / mm
            # A lens without contacts states 50 mm or 0; no picture is narrower than a twentieth of its focal length.
            return pixels / 2 if 0.1 * mosaic.counts.shape[1] < pixels < 20 * mosaic.counts.shape[1] else None
    return None
