"""Contract tests of every camera; a suite supplies its camera with the fixture `bench`.

The camera uses a `SeededFilm`, so each frame can be compared with the exposed one.
"""

from __future__ import annotations

import io
import math
import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import BinaryIO

import pytest

from drivers.camera import Camera, CameraIdentity, ExposureSettings, capture
from foundation.errors import DeviceError, DeviceRefused, StorageError

# Settings that every camera under test offers.
SETTINGS = ExposureSettings(iso=100, aperture=8, shutter_s=1 / 60)


class SeededFilm:
    """A `sim.camera.film.Film` with a different noise image for each frame, which it stores."""

    suffix = ".cr2"

    def __init__(self, size: int = 600, seed: int = 1) -> None:
        self._chance = random.Random(seed)
        self._size = size
        self.frames: list[bytes] = []
        self.settings: list[ExposureSettings] = []

    def accept(self, settings: ExposureSettings) -> None:
        if settings.iso == 110:
            raise DeviceRefused("the film offers iso 100 … 6400, but not 110")

    def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> int:
        self.settings.append(settings)
        # Sometimes the size fills whole packets.
        size = self._size if len(self.frames) % 7 else 512 * (1 + self._size // 512)
        self.frames.append(self._chance.randbytes(size))
        return into.write(self.frames[-1])


@dataclass(frozen=True)
class Bench:
    """A camera under test, its film, and the expected values.

    `keeps_names`: frames have the names given by the camera. `develop` updates `film` if it is a copy.
    """

    camera: Camera
    film: SeededFilm
    identity: CameraIdentity
    now: Callable[[], datetime]
    keeps_names: bool = True
    develop: Callable[[], None] = lambda: None

    def frames(self) -> list[bytes]:
        """Return all exposed frames."""
        self.develop()
        return self.film.frames


class CameraContract:
    """Subclass it as ``TestX`` and supply the fixture `bench`."""

    def test_names_itself(self, bench: Bench) -> None:
        assert bench.camera.identity() == bench.identity
        assert bench.camera.identity() == bench.identity

    def test_refuses_exposure_before_configuration(self, bench: Bench) -> None:
        with pytest.raises(DeviceRefused):
            bench.camera.expose()
        with pytest.raises(DeviceError):
            bench.camera.download(io.BytesIO())
        assert bench.frames() == []

    def test_delivers_exposed_frames(self, bench: Bench) -> None:
        bench.camera.configure(SETTINGS)
        names: list[str] = []
        for number in range(4):
            into = io.BytesIO()
            start = bench.now()
            captured = capture(bench.camera, into)
            assert into.getvalue() == bench.frames()[number]
            assert captured.size == len(bench.frames()[number])
            assert captured.released_at.utcoffset() == timedelta(0)
            assert start <= captured.released_at.astimezone(UTC) <= bench.now()
            names.append(captured.name)
        assert len(bench.frames()) == 4
        assert len(set(names)) == 4
        assert all(name.lower().endswith(bench.film.suffix) for name in names)
        if bench.keeps_names:
            assert names == ["IMG_0001.CR2", "IMG_0002.CR2", "IMG_0003.CR2", "IMG_0004.CR2"]

    def test_exposure_ends_before_download(self, bench: Bench) -> None:
        bench.camera.configure(SETTINGS)
        start = bench.now()
        released_at = bench.camera.expose()
        assert start <= released_at <= bench.now()
        assert len(bench.frames()) == 1
        into = io.BytesIO()
        captured = bench.camera.download(into)
        assert captured.released_at == released_at
        assert [into.getvalue()] == bench.frames()
        with pytest.raises(DeviceError):
            bench.camera.download(io.BytesIO())

    def test_repeats_failed_download(self, bench: Bench) -> None:
        class Full(io.BytesIO):
            def write(self, data: object) -> int:
                raise StorageError("the disk is full")

        bench.camera.configure(SETTINGS)
        bench.camera.expose()
        for _ in range(2):
            with pytest.raises(StorageError):
                bench.camera.download(Full())
        into = io.BytesIO()
        bench.camera.download(into)
        assert [into.getvalue()] == bench.frames()

    def test_next_exposure_replaces_one_without_download(self, bench: Bench) -> None:
        bench.camera.configure(SETTINGS)
        bench.camera.expose()
        bench.camera.expose()
        into = io.BytesIO()
        bench.camera.download(into)
        assert into.getvalue() == bench.frames()[1]
        with pytest.raises(DeviceError):
            bench.camera.download(io.BytesIO())

    def test_exposes_with_the_settings(self, bench: Bench) -> None:
        applied = [SETTINGS, replace(SETTINGS, iso=200), replace(SETTINGS, aperture=11.0, shutter_s=1 / 125), SETTINGS]
        for settings in applied:
            bench.camera.configure(settings)
            capture(bench.camera, io.BytesIO())
        bench.develop()
        assert bench.film.settings == applied

    def test_lists_usable_shutter_times(self, bench: Bench) -> None:
        bench.camera.configure(SETTINGS)
        speeds = bench.camera.shutter_speeds()
        assert speeds == tuple(sorted(set(speeds)))
        assert all(0 < speed < math.inf for speed in speeds)
        assert any(abs(speed / SETTINGS.shutter_s - 1) < 0.01 for speed in speeds)
        for speed in speeds[:: len(speeds) // 5]:
            bench.camera.configure(replace(SETTINGS, shutter_s=speed))

    def test_appends_at_position_of_stream(self, bench: Bench) -> None:
        bench.camera.configure(SETTINGS)
        into = io.BytesIO(b"before")
        into.seek(0, io.SEEK_END)
        captured = capture(bench.camera, into)
        assert into.getvalue() == b"before" + bench.frames()[0]
        assert captured.size == len(bench.frames()[0])

    def test_refuses_unavailable_setting_and_stays_usable(self, bench: Bench) -> None:
        with pytest.raises(DeviceRefused, match="100"):
            bench.camera.configure(replace(SETTINGS, iso=110))
        assert bench.frames() == []
        bench.camera.configure(SETTINGS)
        into = io.BytesIO()
        capture(bench.camera, into)
        assert into.getvalue() == bench.frames()[-1]

    def test_closed_camera_refuses_exposure(self, bench: Bench) -> None:
        bench.camera.configure(SETTINGS)
        bench.camera.close()
        bench.camera.close()
        with pytest.raises(DeviceError):
            bench.camera.expose()
        assert bench.frames() == []
