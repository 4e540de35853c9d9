"""The way through libgphoto2, against the simulated EOS on the loopback: another initiator than ours, in real time."""

from __future__ import annotations

import io
import json
import os
import select
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO

import pytest

from drivers.camera import CameraIdentity, ExposureSettings, capture
from drivers.gphoto2_camera import Gphoto2Camera
from foundation.clock import SystemClock
from foundation.errors import ConfigurationError, DeviceError, DeviceRefused, LinkError
from tests.contracts.camera import SETTINGS, Bench, CameraContract, SeededFilm
from tests.drivers.gphoto2_server import FILM_BYTES

pytestmark = pytest.mark.slow

pytest.importorskip("gphoto2", reason="the extra `gphoto2` is not installed")

MODEL = "PTP/IP Camera"


class FarFilm(SeededFilm):
    """The film in the other process: exposed here again as that one says it was."""

    def __init__(self, reports: int) -> None:
        super().__init__(FILM_BYTES)
        self._reports = reports
        self._rest = b""

    def catch_up(self) -> None:
        while select.select([self._reports], [], [], 0)[0] and (piece := os.read(self._reports, 4096)):
            self._rest += piece
        *lines, self._rest = self._rest.split(b"\n")
        for line in lines:
            self.expose(ExposureSettings(**json.loads(line)), SystemClock().now(), io.BytesIO())


class Bodies:
    """Simulated bodies in another process, one at a time."""

    def __init__(self, orders: IO[bytes], reports: IO[bytes]) -> None:
        self._orders, self._reports = orders, reports

    @contextmanager
    def served(self, port: int = 0, mode: str = "prepared") -> Generator[tuple[str, FarFilm]]:
        """Serve a simulated EOS; give libgphoto2's name of its port, and its film."""
        self._order(f"{port} {mode}")
        try:
            yield self._reports.readline().decode().strip(), FarFilm(self._reports.fileno())
        finally:
            self._order("end")
            assert any(line == b"ended\n" for line in self._reports)

    def _order(self, line: str) -> None:
        self._orders.write(f"{line}\n".encode())
        self._orders.flush()


@pytest.fixture(scope="module")
def bodies() -> Generator[Bodies]:
    command = [sys.executable, "-m", "tests.drivers.gphoto2_server"]
    folder = Path(__file__).parents[3]
    # Lines are looked for with nothing kept back: a film reads the same pipe.
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=folder, stdin=pipe, stdout=pipe, bufsize=0) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        yield Bodies(process.stdin, process.stdout)
        process.stdin.close()


class TestContract(CameraContract):
    @pytest.fixture
    def bench(self, bodies: Bodies) -> Generator[Bench]:
        with bodies.served() as (port, film):
            camera = Gphoto2Camera(port, MODEL)
            identity = CameraIdentity("Canon Inc.", "Canon EOS 550D", "0000000001", "3-1.0.9")
            yield Bench(camera, film, identity, SystemClock().now, keeps_names=False, develop=film.catch_up)
            camera.close()


def test_a_body_that_is_not_set_up_is_refused_with_all_reasons_at_once(bodies: Bodies) -> None:
    with bodies.served(mode="unprepared") as (port, _):
        camera = Gphoto2Camera(port, MODEL)
        with pytest.raises(DeviceRefused):
            camera.configure(SETTINGS)
        camera.close()


def test_a_lens_without_contacts_takes_frames_and_no_aperture(bodies: Bodies) -> None:
    with bodies.served(mode="no contacts") as (port, film):
        camera = Gphoto2Camera(port, MODEL)
        with pytest.raises(DeviceRefused, match=r'aperture .* cannot be set.*set aperture = "none"'):
            camera.configure(SETTINGS)
        bare = replace(SETTINGS, aperture=None)
        camera.configure(bare)
        into = io.BytesIO()
        capture(camera, into)
        camera.close()
        film.catch_up()
    assert [into.getvalue()] == film.frames
    assert film.settings == [bare]


def test_a_lost_connection_is_renewed_by_the_next_call(bodies: Bodies) -> None:
    with bodies.served() as (port, _):
        camera = Gphoto2Camera(port, MODEL)
        camera.configure(SETTINGS)
    with pytest.raises(DeviceError):
        capture(camera, io.BytesIO())
    with bodies.served(int(port.rpartition(":")[2])) as (_, film):
        into = io.BytesIO()
        capture(camera, into)
        film.catch_up()
        assert [into.getvalue()] == film.frames
        camera.close()


def test_no_camera_is_said_with_what_helps() -> None:
    with pytest.raises(LinkError, match="ptpip:127"):
        Gphoto2Camera("ptpip:127.0.0.1:1:1", MODEL).identity()


@pytest.mark.parametrize(
    ("port", "model", "words"),
    [
        (None, "Nonsense 5", r"knows no model 'Nonsense 5' \(gphoto2 --list-cameras .*found: "),
        ("nonsense", None, r"knows no port 'nonsense' \(such as usb:001,004.*found: "),
    ],
)
def test_what_libgphoto2_does_not_know_is_a_mistake_of_the_settings(
    port: str | None, model: str | None, words: str
) -> None:
    with pytest.raises(ConfigurationError, match=words):
        Gphoto2Camera(port, model).identity()


def test_no_camera_at_all_says_what_was_found() -> None:
    with pytest.raises(LinkError):
        Gphoto2Camera("usb:777,777").identity()


def test_a_missing_library_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gphoto2", None)
    with pytest.raises(ConfigurationError, match="pip install gphoto2"):
        Gphoto2Camera()
