"""Camera through libgphoto2, against the simulated EOS over loopback in real time, and against scripted bodies."""

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

from drivers import gphoto2_camera
from drivers.camera import CameraIdentity, ExposureSettings, ReportsSupplies, Supplies, capture
from drivers.gphoto2_camera import BodySetting, Gphoto2Camera, parse_number, plan_settings
from foundation.clock import SimulatedClock, SystemClock
from foundation.errors import ConfigurationError, DeviceError, DeviceRefused, LinkError
from tests.contracts.camera import SETTINGS, Bench, CameraContract, SeededFilm
from tests.drivers.gphoto2_bodies import (
    BODIES,
    NIKON_D7100,
    NIKON_Z7,
    SONY_A7M4,
    SONY_A6000,
    SONY_A6400,
    FakeBody,
    fake_module,
)
from tests.drivers.gphoto2_server import FILM_BYTES

pytest.importorskip("gphoto2", reason="the extra `gphoto2` is not installed")

MODEL = "PTP/IP Camera"


class FarFilm(SeededFilm):
    """The film of the other process: repeats its exposures here."""

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
    def served(self, port: int = 0) -> Generator[tuple[str, FarFilm]]:
        """Serve a simulated EOS; yield libgphoto2's name of its port, and its film."""
        self._order(str(port))
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
    folder = Path(__file__).parents[2]
    # Unbuffered, because a film reads the same pipe.
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=folder, stdin=pipe, stdout=pipe, bufsize=0) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        yield Bodies(process.stdin, process.stdout)
        process.stdin.close()


@pytest.mark.slow
class TestContract(CameraContract):
    @pytest.fixture
    def bench(self, bodies: Bodies) -> Generator[Bench]:
        with bodies.served() as (port, film):
            camera = Gphoto2Camera(port, MODEL)
            identity = CameraIdentity("Canon Inc.", "Canon EOS 550D", "0000000001", "3-1.0.9")
            yield Bench(camera, film, identity, SystemClock().now, keeps_names=False, develop=film.catch_up)
            camera.close()


@pytest.mark.slow
def test_next_call_renews_a_lost_connection(bodies: Bodies) -> None:
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


@pytest.mark.slow
def test_missing_network_camera_is_a_link_error() -> None:
    with pytest.raises(LinkError, match="ptpip:127"):
        Gphoto2Camera("ptpip:127.0.0.1:1:1", MODEL).identity()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("port", "model", "reason"),
    [
        (None, "Nonsense 5", r"has no model 'Nonsense 5' \(gphoto2 --list-cameras .*detected: "),
        ("nonsense", None, r"has no port 'nonsense' \(such as usb:001,004.*detected: "),
    ],
)
def test_refuses_unknown_model_and_port(port: str | None, model: str | None, reason: str) -> None:
    with pytest.raises(ConfigurationError, match=reason):
        Gphoto2Camera(port, model).identity()


@pytest.mark.slow
def test_missing_camera_is_a_link_error() -> None:
    with pytest.raises(LinkError):
        Gphoto2Camera("usb:777,777").identity()


@pytest.mark.slow
def test_missing_library_error_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gphoto2", None)
    with pytest.raises(ConfigurationError, match="pip install gphoto2"):
        Gphoto2Camera()


class NoisyFilm(SeededFilm):
    """A film of bodies with raw files of other makers."""

    suffix = ".nef"

    def accept(self, settings: ExposureSettings) -> None:
        """Accept every exposure."""


class Fake:
    """Our camera with a fake libgphoto2."""

    def __init__(self, patch: pytest.MonkeyPatch, name: str, **given: object) -> None:
        self.clock = SimulatedClock()
        self.film = NoisyFilm()
        self.body = FakeBody(dict(BODIES[name]), self.film, self.clock, **given)  # pyrefly: ignore[bad-argument-type]
        module = fake_module(self.body)
        patch.setattr(gphoto2_camera, "load_library", lambda: module)
        self.camera = Gphoto2Camera(clock=self.clock)


@pytest.fixture(params=list(BODIES))
def fake(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Fake:
    return Fake(monkeypatch, request.param)


class TestContractOfScriptedBodies(CameraContract):
    @pytest.fixture
    def bench(self, fake: Fake) -> Bench:
        tree = fake.body.tree
        if not tree["iso"].choices:
            tree["iso"] = replace(tree["iso"], choices=("Auto ISO", "100", "200"))
        identity = CameraIdentity(
            *(tree[name].value for name in ("manufacturer", "cameramodel", "serialnumber", "deviceversion"))
        )
        return Bench(fake.camera, fake.film, identity, fake.clock.now, keeps_names=False)


def test_plans_nikon_settings() -> None:
    assert plan_settings(NIKON_Z7.get, SETTINGS) == {
        "isoauto": "Off",
        "capturetarget": "Internal RAM",
        "imagequality": "NEF (Raw)",
        "iso": "100",
        "f-number": "f/8",
        "shutterspeed2": "1/60",
    }
    assert plan_settings(NIKON_D7100.get, replace(SETTINGS, shutter_s=0.5))["shutterspeed2"] == "1/2"
    # The other list truncates short times: 1/6400 s and 1/8000 s are both "0.0001s".
    assert plan_settings(NIKON_D7100.get, replace(SETTINGS, shutter_s=1 / 6400))["shutterspeed2"] == "1/6400"


def test_plans_sony_settings() -> None:
    assert plan_settings(SONY_A7M4.get, replace(SETTINGS, shutter_s=0.5)) == {
        "capturetarget": "sdram",
        "imagequality": "RAW",
        "iso": "100",
        "f-number": "f/8",
        "shutterspeed": "5/10",
    }
    older = plan_settings(SONY_A6400.get, replace(SETTINGS, aperture=5.6, shutter_s=3.2))
    assert (older["f-number"], older["shutterspeed"], older["iso"]) == ("5.6", "32/10", "100")
    assert "capturetarget" not in plan_settings(SONY_A6000.get, SETTINGS)


SPOILED: list[tuple[dict[str, BodySetting], BodySetting | str, str]] = [
    (
        NIKON_Z7,
        BodySetting("bracketing", "On", ("On", "Off"), fixed=True),
        "bracketing is On, so every frame would",
    ),
    (NIKON_Z7, BodySetting("rawcompression", "Lossy", ("Lossy",)), "rawcompression is Lossy, so raw values"),
    (
        NIKON_Z7,
        BodySetting("imagequality", "JPEG Fine", ("JPEG Basic", "JPEG Fine", "NEF+Fine")),
        r"imagequality offers JPEG Basic, JPEG Fine, NEF\+Fine, expected one of RAW, NEF \(Raw\)",
    ),
    (
        NIKON_Z7,
        BodySetting("imagequality", "JPEG Fine", ("JPEG Fine", "NEF (Raw)"), fixed=True),
        r"imagequality offers JPEG Fine, NEF \(Raw\), expected one of RAW",
    ),
    (NIKON_Z7, "imagequality", "a raw format cannot be set: the body has neither imageformat nor imagequality"),
    (NIKON_Z7, "f-number", "aperture or f-number 8 cannot be set: the body has no such setting"),
    (
        NIKON_Z7,
        BodySetting("f-number", "f/1.8", ("f/1.8", "f/2")),
        r"f-number 8 is not offered \(offered: f/1.8, f/2\)",
    ),
    (
        NIKON_Z7,
        BodySetting("capturetarget", "Memory card", ("Memory card",)),
        "capturetarget offers Memory card, expected one of",
    ),
    (SONY_A7M4, BodySetting("expprogram", "Unknown value 8000", ("M", "P")), "expprogram is Unknown value 8000"),
    (SONY_A7M4, BodySetting("focusmode", "DMF", ("Manual", "DMF")), "focusmode is DMF"),
    (SONY_A7M4, BodySetting("capturemode", "Bracketing WB Hi", ("Single Shot",)), "capturemode is Bracketing WB Hi"),
    (
        SONY_A6400,
        BodySetting("f-number", "4.5", bounds=(3.5, 5.6)),
        r"f-number 8 is not offered \(offered: 3.5 to 5.6\)",
    ),
]


@pytest.mark.parametrize(("tree", "spoiled", "reason"), SPOILED)
def test_refuses_settings_that_spoil_a_series(
    tree: dict[str, BodySetting], spoiled: BodySetting | str, reason: str
) -> None:
    plan_settings(tree.get, SETTINGS)
    changed = dict(tree)
    if isinstance(spoiled, str):
        del changed[spoiled]
    else:
        changed[spoiled.name] = spoiled
    with pytest.raises(DeviceRefused, match=reason):
        plan_settings(changed.get, SETTINGS)


def test_reports_all_faults_at_once() -> None:
    with pytest.raises(DeviceRefused, match=r"iso 100.*f-number 8.*shutterspeed"):
        plan_settings(lambda name: None, SETTINGS)


def test_accepts_a_lens_without_contacts() -> None:
    # As libgphoto2 shows a Canon's aperture of code 0: "implicit auto" as the only choice (printed by gphoto2
    # 2.5.28 for the simulated body).
    for value, choices in (("implicit auto", ("implicit auto",)), ("f/0", ()), ("", ())):
        bare = (NIKON_Z7 | {"f-number": BodySetting("f-number", value, choices)}).get
        assert "f-number" not in plan_settings(bare, replace(SETTINGS, aperture=None))
        with pytest.raises(DeviceRefused, match=r'aperture 8 cannot be set.*aperture = "none"'):
            plan_settings(bare, SETTINGS)
    with pytest.raises(DeviceRefused, match=r"f/5\.6.*f-number"):
        plan_settings(NIKON_Z7.get, replace(SETTINGS, aperture=None))


@pytest.mark.parametrize(
    ("label", "number"),
    [
        ("1/2", 0.5), ("0.5000s", 0.5), ("0,5000s", 0.5), ("5/10", 0.5), ("f/5.6", 5.6), ("f/3,5", 3.5), ("100", 100),
        ("Bulb", None), ("Time", None), ("x 200", None), ("Auto ISO", None), ("100 Multi Frame Noise Reduction", None),
        ("1/0", None), ("0", None), ("-1", None), ("", None), ("inf", None), ("nan", None),
        ("Unknown value 8000", None),
    ],
)  # fmt: skip
def test_parses_numbers_in_labels(label: str, number: float | None) -> None:
    assert parse_number(label) == number


def test_waits_for_a_dial_that_turns_step_by_step(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = Fake(monkeypatch, "Sony A6400", settles_after=8)
    fake.camera.configure(SETTINGS)
    assert fake.body.exposure() == ExposureSettings(100, 8.0, 1 / 60)
    assert 0.5 < fake.clock.monotonic() < 10


def test_refuses_a_setting_that_the_body_ignores(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = Fake(monkeypatch, "Nikon Z 7", stubborn=frozenset({"imagequality"}))
    with pytest.raises(DeviceRefused, match=r"NEF\+Fine on the camera, expected NEF \(Raw\)"):
        fake.camera.configure(SETTINGS)


@pytest.mark.parametrize("suffix", ["jpg", "JPG", "hif"])
def test_refuses_an_image_instead_of_a_raw_file(monkeypatch: pytest.MonkeyPatch, suffix: str) -> None:
    fake = Fake(monkeypatch, "Sony A7 IV", suffix=suffix)
    fake.camera.configure(SETTINGS)
    with pytest.raises(DeviceRefused, match=r"capt0000\..*expected a raw file"):
        fake.camera.expose()
    assert fake.body.files == {}, "it does not stay in the camera's memory"
    with pytest.raises(DeviceError):
        fake.camera.download(io.BytesIO())


@pytest.mark.parametrize("code", [-7, -10, -34, -110, -1])
def test_takes_the_next_frame_after_any_fault(fake: Fake, code: int) -> None:
    fake.camera.configure(SETTINGS)
    for _ in range(3):
        fake.body.fails.append(code)
        with pytest.raises(DeviceError):
            fake.camera.expose()
        into = io.BytesIO()
        capture(fake.camera, into)
        assert into.getvalue() == fake.film.frames[-1]
    assert fake.body.openings == 4


def test_repeats_a_file_request_to_a_busy_body(fake: Fake) -> None:
    fake.camera.configure(SETTINGS)
    fake.camera.expose()
    fake.body.fails.extend([-110] * 4)
    into = io.BytesIO()
    fake.camera.download(into)
    assert [into.getvalue()] == fake.film.frames
    fake.camera.expose()
    fake.body.fails.extend([-110] * 5)
    with pytest.raises(DeviceError):
        fake.camera.download(io.BytesIO())


def test_failed_download_reports_the_lost_frame(fake: Fake) -> None:
    fake.camera.configure(SETTINGS)
    fake.camera.expose()
    fake.body.fails.append(-34)
    with pytest.raises(DeviceError):
        fake.camera.download(io.BytesIO())
    with pytest.raises(DeviceError):
        fake.camera.download(io.BytesIO())


def test_reports_battery_and_card_capacity(monkeypatch: pytest.MonkeyPatch) -> None:
    nikon = Fake(monkeypatch, "Nikon D7100")
    assert isinstance(nikon.camera, ReportsSupplies)
    assert nikon.body.tree["capturetarget"].value == "Memory card"
    for _ in range(2):
        assert nikon.camera.supplies() == Supplies(0.8, False, 3_072_000_000, saves_to_host=True)
        nikon.camera.configure(SETTINGS)
    nikon.body.tree["capturetarget"] = BodySetting("capturetarget", "Memory card", ("Memory card",))
    assert not nikon.camera.supplies().saves_to_host
    assert Fake(monkeypatch, "Sony A6000").camera.supplies() == Supplies(None, None, None, saves_to_host=True)


VIRTUAL = """
import io, json, sys
from drivers.camera import ExposureSettings
from drivers.gphoto2_camera import Gphoto2Camera
from foundation.errors import DeviceError

camera = Gphoto2Camera()
said = {"identity": vars(camera.identity()), "speeds": camera.shutter_speeds(), "supplies": vars(camera.supplies())}
settings = ExposureSettings(100, 8, 0.1)
try:
    camera.configure(settings)
except DeviceError as error:
    said["refused"] = str(error)
# Skip the refusal: the virtual camera writes a JPEG.
camera._settings = settings
camera._apply = lambda *_: None
try:
    camera.expose()
except DeviceError as error:
    said["made"] = str(error)
for name, label in (("f-number", "f/8"), ("shutterspeed", "1.0000s")):
    with camera._connection() as body:
        camera._set(body, name, label)
        said[name] = body.get_single_config(name).get_value()
camera.close()
print(json.dumps(said))
"""


@pytest.mark.slow
def test_reads_the_virtual_camera_of_libgphoto2(tmp_path: Path) -> None:
    pytest.importorskip("gphoto2", reason="the extra `gphoto2` is not installed")
    (tmp_path / "IMG_0001.JPG").write_bytes(b"\xff\xd8\xff\xd9")
    # With this variable python-gphoto2 uses its virtual USB.
    done = subprocess.run(
        [sys.executable, "-c", VIRTUAL],
        cwd=Path(__file__).parents[2],
        env=os.environ | {"VCAMERADIR": str(tmp_path), "HOME": str(tmp_path)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if "detected: none" in done.stderr:
        pytest.skip("this build of libgphoto2 has no virtual camera")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout.splitlines()[-1])
    assert said["identity"]["model"] == "VC"
    assert said["speeds"] == [0.0001, 0.0012, 0.0025, 0.005, 0.01, 0.02, 0.05, 0.1, 1.0]
    assert said["supplies"]["battery"] == 0.5
    assert said["supplies"]["card_free_bytes"] > 1 << 20
    assert said["refused"].startswith(
        "the camera cannot take the series; a raw format cannot be set: the body has neither imageformat nor "
        "imagequality"
    )
    assert "iso 100 cannot be set" in said["refused"]
    assert "f-number" not in said["refused"], "the f-number can be set"
    assert "expected a raw file" in said["made"]
    assert (said["f-number"], said["shutterspeed"]) == ("f/8", "1.0000s")
