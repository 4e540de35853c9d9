"""gphoto2 takes photographs with the simulated camera over PTP/IP, as an independent initiator.

The system's gphoto2 and python-gphoto2 are used if installed; they contain two versions of libgphoto2. Each has its own
home folder, because libgphoto2 stores settings there.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest

from drivers import canon
from drivers.camera import ExposureSettings
from drivers.canon import RAW_ONLY, ImageFile, ImageFormat
from drivers.presenter import WHITE
from drivers.ptp.codes import Property
from drivers.raw.rawfile import read_raw
from foundation.clock import SystemClock
from sim.buses.ptp import serve_ptpip
from sim.camera.bodies import EOS_6D_MARK_II, EOS_550D_AS_LISTED, TEST_BODY
from sim.camera.eos import SimulatedEos
from sim.camera.film import Film, WorldFilm
from sim.world.rendering import Print
from sim.world.sensors import BODIES
from sim.world.world import Room, World

pytestmark = pytest.mark.slow

LIMIT_S = 60


class RecordingFilm:
    """A film that records its frames."""

    def __init__(self, film: Film) -> None:
        self._film = film
        self.frames: list[bytes] = []
        self.exposures: list[ExposureSettings] = []

    @property
    def suffix(self) -> str:
        return self._film.suffix

    def accept(self, settings: ExposureSettings) -> None:
        self._film.accept(settings)

    def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> None:
        start = into.tell()
        self._film.expose(settings, released_at, into)
        into.seek(start)
        self.frames.append(into.read())
        self.exposures.append(settings)


class Served:
    """A simulated camera on the network, with a gphoto2 that uses it."""

    def __init__(self, eos: SimulatedEos, film: RecordingFilm, port: int, folder: Path) -> None:
        self.eos = eos
        self.film = film
        self.path = f"ptpip:127.0.0.1:{port}:{port}"
        self.folder = folder

    def gphoto2(self, *arguments: str) -> str:
        """Run gphoto2 in the folder of the test and return its output."""
        return gphoto2(self.path, self.folder, *arguments)

    def current(self, setting: str) -> str:
        return re.findall(r"^Current: (.*)$", self.gphoto2("--get-config", setting), re.MULTILINE)[0]

    def choices(self, setting: str) -> list[str]:
        """Return the choices of gphoto2 for a setting."""
        return re.findall(r"^Choice: \d+ (.*)$", self.gphoto2("--get-config", setting), re.MULTILINE)


def _environment(folder: Path) -> dict[str, str]:
    """Return the environment for the gphoto2 of Debian: settings in `folder`, and its own libraries.

    After its import, python-gphoto2 points every libgphoto2 started here to its own drivers.
    """
    variables = {name: value for name, value in os.environ.items() if name not in ("CAMLIBS", "IOLIBS")}
    return variables | {"HOME": str(folder), "LC_ALL": "C"}


def gphoto2(path: str, folder: Path, *arguments: str) -> str:
    program = shutil.which("gphoto2")
    if program is None:
        pytest.skip("gphoto2 is not installed")
    process = subprocess.run(
        [program, "--camera", "PTP/IP Camera", "--port", path, *arguments],
        cwd=folder, env=_environment(folder), capture_output=True, text=True,
        timeout=LIMIT_S, check=False,
    )  # fmt: skip
    assert process.returncode == 0, process.stdout + process.stderr
    return process.stdout


@pytest.fixture(scope="session")
def world() -> World:
    rgb = np.array([[0, 0, 0], [248, 0, 0], [0, 248, 0], [0, 0, 248], [120, 120, 120]], dtype=np.uint8)
    left = 10 + 32.0 * np.arange(5)
    boxes = np.stack([left, np.full(5, 40.0), left + 25, np.full(5, 80.0)], axis=-1)
    return World(Print((180, 125), boxes, rgb), BODIES["Test"], Room(lamp_drift_per_hour=0))  # pyrefly: ignore[bad-argument-type]


@pytest.fixture
def served(world: World, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Served]:
    """Return a served camera; the parameter is another body than the test body."""
    body = getattr(request, "param", TEST_BODY)
    film = RecordingFilm(WorldFilm(world, lambda: WHITE, lambda: 1.0, "1", {}))
    with ThreadPoolExecutor(1) as executor:
        eos = SimulatedEos(body, film, SystemClock(), serial="1", auto_power_off_s=0, executor=executor)
        with serve_ptpip(eos, 0) as server:
            yield Served(eos, film, server.address[1], tmp_path)


def test_summary(served: Served) -> None:
    summary = served.gphoto2("--summary")
    for line in (
        "Manufacturer: Canon Inc.",
        "Model: CroP Test",
        "Canon EOS Capture",
        "StorageDescription: SD",
        # As printed by gphoto2 for a real EOS 550D: the levels are widened to 16 bits.
        "Battery Level(0x5001):(read only) (type=0x2) Enumeration [100,0,75,0,50] value: 100% (100)",
    ):
        assert line in summary


def test_lists_and_sets_settings(served: Served) -> None:
    settings = served.gphoto2("--list-config").split()
    for setting in ("iso", "shutterspeed", "aperture", "imageformat", "capturetarget", "autoexposuremode", "focusmode"):
        assert any(entry.endswith(f"/{setting}") for entry in settings)
    assert served.choices("iso") == ["Auto", *(str(100 << stop) for stop in range(7))]
    served.gphoto2("--set-config", "iso=400", "--set-config", "shutterspeed=1/50", "--set-config", "aperture=11")
    assert [served.current(name) for name in ("iso", "shutterspeed", "aperture")] == ["400", "1/50", "11"]
    assert served.current("autoexposuremode") == "Manual"
    assert served.current("focusmode") == "Manual"


@pytest.mark.parametrize("served", [EOS_550D_AS_LISTED], indirect=True)
def test_lists_equal_real_550d(served: Served) -> None:
    # libgphoto2, cameras/canon-eos550d.txt: output for a real camera.
    assert served.choices("aperture") == ["4", "4.5", "5.6", "6.7", "8", "9.5", "11", "13", "16", "19", "22", "27"]
    assert served.choices("imageformat") == [
        "Large Fine JPEG", "Large Normal JPEG", "Medium Fine JPEG", "Medium Normal JPEG", "Small Fine JPEG",
        "Small Normal JPEG", "RAW + Large Fine JPEG", "RAW",
    ]  # fmt: skip
    assert served.choices("drivemode") == ["Single", "Continuous", "Timer 10 sec", "Timer 2 sec"]
    assert served.choices("aeb") == ["off", "+/- 1/2", "+/- 1", "+/- 1 1/2", "+/- 2"]
    assert served.choices("reviewtime") == ["None", "2 seconds", "4 seconds", "8 seconds", "Hold"]
    assert served.current("model") == "2147484272"
    assert served.current("lensname") == "EF-S18-55mm f/3.5-5.6 IS"


@pytest.mark.parametrize("served", [replace(TEST_BODY, aperture_codes=())], indirect=True)
def test_shows_lens_without_contacts(served: Served) -> None:
    assert served.current("aperture") == "implicit auto"
    assert served.choices("aperture") == ["implicit auto"]
    served.gphoto2("--capture-image-and-download", "--filename", "frame.%C")
    assert [file.read_bytes() for file in served.folder.glob("frame.*")] == served.film.frames
    assert [settings.aperture for settings in served.film.exposures] == [None]


@pytest.mark.parametrize("served", [EOS_6D_MARK_II], indirect=True)
def test_lists_equal_real_6d_mark_ii(served: Served) -> None:
    # libgphoto2, cameras/canon-eos6d-mark2.txt.
    assert served.current("model") == "2147484678"
    formats = served.choices("imageformat")
    assert len(formats) == 31
    assert formats[28:] == ["RAW", "mRAW", "sRAW"]
    assert served.choices("exposurecompensation")[:4] == ["-5", "-4.6", "-4.3", "-4"]
    assert len(served.choices("exposurecompensation")) == 31
    assert served.choices("aeb")[-1] == "+/- 3"


def test_downloads_frame_unchanged(served: Served) -> None:
    served.gphoto2("--set-config", "shutterspeed=1/4", "--capture-image-and-download", "--filename", "frame.%C")
    (file,) = served.folder.glob("frame.*")
    assert [file.read_bytes()] == served.film.frames
    assert served.film.exposures == [ExposureSettings(100, 8.0, 0.25)]
    mosaic = read_raw(file)
    assert (mosaic.counts.shape, mosaic.iso, mosaic.aperture, mosaic.shutter_s) == ((557, 800), 100, 8.0, 0.25)


def test_downloads_raw_and_jpeg_from_card(served: Served) -> None:
    served.eos.set_menu(Property.EOS_IMAGE_FORMAT, ImageFormat((*RAW_ONLY.files, ImageFile(1, 0, 3))))
    served.gphoto2("--set-config", "capturetarget=1", "--capture-image-and-download", "--keep", "--filename", "%f.%C")
    assert [(served.folder / "IMG_0001.DNG").read_bytes()] == served.film.frames
    served.gphoto2("--get-all-files", "--force-overwrite")
    assert {file.name for file in served.folder.glob("IMG*")} == {"IMG_0001.DNG", "IMG_0001.JPG"}
    assert [(served.folder / "IMG_0001.DNG").read_bytes()] == served.film.frames
    assert "IMG_0001.JPG" in served.gphoto2("--list-files")
    served.gphoto2("--delete-all-files", "--recurse")
    assert "IMG_0001" not in served.gphoto2("--list-files")


def test_python_gphoto2_takes_photographs(served: Served) -> None:
    if importlib.util.find_spec("gphoto2") is None:
        pytest.skip("python-gphoto2 is not installed")
    script = """
import sys, gphoto2 as gp
ports = gp.PortInfoList()
ports.load()
camera = gp.Camera()
camera.set_port_info(ports[ports.lookup_path(sys.argv[1])])
abilities = gp.CameraAbilitiesList()
abilities.load()
camera.set_abilities(abilities[abilities.lookup_model("PTP/IP Camera")])
camera.init()
for name, value in (("iso", "200"), ("shutterspeed", "1/30")):
    widget = camera.get_single_config(name)
    widget.set_value(value)
    camera.set_single_config(name, widget)
for number in range(2):
    path = camera.capture(gp.GP_CAPTURE_IMAGE)
    camera.file_get(path.folder, path.name, gp.GP_FILE_TYPE_NORMAL).save(f"frame{number}")
camera.exit()
"""
    process = subprocess.run(
        [sys.executable, "-c", script, served.path],
        cwd=served.folder, env=os.environ | {"HOME": str(served.folder)}, capture_output=True, text=True,
        timeout=LIMIT_S, check=False,
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    assert [(served.folder / f"frame{number}").read_bytes() for number in range(2)] == served.film.frames
    assert served.film.exposures == [ExposureSettings(200, 8.0, canon.SHUTTER.value(0x60))] * 2
