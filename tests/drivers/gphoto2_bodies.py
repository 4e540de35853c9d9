"""Bodies of other makers as libgphoto2 shows them, and a gphoto2 module that has them for cameras.

What they show is taken from libgphoto2 at 813de344e (2026-07-24), camlibs/ptp2/cameras: nikon-z7.txt, nikon-d7100.txt,
sony-a7m4.txt, sony-a6400.txt, sony-a6000.txt; names, labels and values of the settings that matter here, long lists
cut. Of the A6000, whose dump is older than its shutter setting, the list is the A6400's.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

from drivers.camera import ExposureSettings
from drivers.gphoto2_camera import BodySetting, parse_number
from foundation.clock import Clock
from tests.contracts.camera import SeededFilm

ON_OFF = ("On", "Off")
SONY_SPEEDS = (
    "30", "25", "20", "15", "13", "10", "8", "6", "5", "4", "32/10", "25/10", "2", "16/10", "13/10", "1", "8/10",
    "6/10", "5/10", "4/10", "1/3", "1/4", "1/5", "1/6", "1/8", "1/10", "1/13", "1/15", "1/20", "1/25", "1/30", "1/40",
    "1/50", "1/60", "1/80", "1/100", "1/125", "1/160", "1/200", "1/250", "1/4000", "Bulb",
)  # fmt: skip
NIKON_SPEEDS_2 = (
    "1/8000", "1/6400", "1/4000", "1/250", "1/200", "1/160", "1/125", "1/100", "1/80", "1/60", "1/50", "1/30", "1/15",
    "1/8", "1/4", "1/2", "1", "2", "4", "8", "15", "30", "Bulb", "Time", "x 200",
)  # fmt: skip
NIKON_SPEEDS = (
    "0.0001s", "0.0001s", "0.0002s", "0.0040s", "0.0050s", "0.0062s", "0.0080s", "0.0100s", "0.0125s", "0.0166s",
    "0.0200s", "0.0333s", "0.0666s", "0.1250s", "0.2500s", "0.5000s", "1.0000s", "2.0000s", "4.0000s", "8.0000s",
    "15.0000s", "30.0000s", "Bulb", "Time",
)  # fmt: skip


def _tree(*settings: BodySetting) -> dict[str, BodySetting]:
    return {setting.name: setting for setting in settings}


NIKON_Z7 = _tree(
    BodySetting("recordingmedia", "Card", ("Card", "SDRAM", "Unknown value 0002")),
    BodySetting("capturetarget", "Internal RAM", ("Internal RAM", "Memory card")),
    BodySetting("autofocus", "Off", ON_OFF),
    BodySetting("acpower", "Off", ON_OFF, fixed=True),
    BodySetting("batterylevel", "80%", fixed=True),
    BodySetting("iso", "100", ("32", "40", "50", "64", "80", "100", "125", "160", "200", "250", "320", "400", "25600")),
    BodySetting("isoauto", "On", ON_OFF),
    BodySetting("autoiso", "Off", ON_OFF),
    BodySetting("rawcompression", "Lossless", ("Lossless", "Lossy", "Unknown value 0002")),
    BodySetting("longexpnr", "Off", ON_OFF),
    BodySetting(
        "f-number", "f/5.6", ("f/4", "f/4.5", "f/5", "f/5.6", "f/6.3", "f/7.1", "f/8", "f/9", "f/10", "f/11", "f/22")
    ),
    BodySetting(
        "imagequality",
        "NEF+Fine",
        ("JPEG Basic", "JPEG Normal", "JPEG Fine", "Unknown value 0003", "NEF (Raw)", "NEF+Basic", "NEF+Fine"),
    ),
    BodySetting("focusmode", "Manual", ("Manual", "AF-S", "AF-C", "Unknown value 8013")),
    BodySetting("expprogram", "M", ("M", "P", "A", "S", "Auto", "Unknown value 8050"), fixed=True),
    BodySetting("capturemode", "Single Shot", ("Single Shot", "Burst", "Continuous Low Speed", "Timer")),
    BodySetting("shutterspeed", "0.0025s", NIKON_SPEEDS),
    BodySetting("shutterspeed2", "1/400", NIKON_SPEEDS_2),
    BodySetting("bracketing", "Off", ON_OFF),
    BodySetting("serialnumber", "6001234"),
    BodySetting("manufacturer", "Nikon Corporation"),
    BodySetting("cameramodel", "Z 7"),
    BodySetting("deviceversion", "V1.00"),
)
NIKON_D7100 = NIKON_Z7 | _tree(
    BodySetting("capturetarget", "Memory card", ("Internal RAM", "Memory card")),
    BodySetting("imagequality", "JPEG Normal", ("JPEG Basic", "JPEG Normal", "JPEG Fine", "NEF (Raw)", "NEF+Fine")),
    BodySetting("focusmode", "Manual", ("Manual", "AF-S", "AF-C", "AF-A", "Unknown value 8013")),
    BodySetting("focusmode2", "MF (fixed)", ("AF-S", "AF-C", "AF-A", "MF (fixed)", "MF (selection)")),
    BodySetting("cameramodel", "D7100"),
)
del NIKON_D7100["rawcompression"], NIKON_D7100["autofocus"]
SONY_A7M4 = _tree(
    BodySetting("capturetarget", "sdram", ("sdram", "card+sdram", "card")),
    BodySetting("iso", "Auto ISO"),
    BodySetting(
        "f-number", "f/8", ("f/1", "f/1.4", "f/2", "f/2.8", "f/4", "f/5.6", "f/8", "f/9", "f/10", "f/11", "f/64")
    ),
    BodySetting(
        "imagequality",
        "RAW+JPEG (X.Fine)",
        ("RAW", "RAW+JPEG (X.Fine)", "RAW+JPEG (Fine)", "RAW+JPEG (Std)", "Extra Fine", "Fine", "Standard"),
    ),
    BodySetting("focusmode", "Manual", ("Undefined", "Manual", "Automatic", "Automatic Macro", "AF-A", "AF-C", "DMF")),
    BodySetting("expprogram", "M", ("M", "P", "A", "S", "Creative"), fixed=True),
    BodySetting("capturemode", "Single Shot", ("Single Shot", "Continuous Hi+ Speed", "Burst", "Selftimer 2s")),
    BodySetting("shutterspeed", "4/10", SONY_SPEEDS),
    BodySetting("serialnumber", "00000000000000003282933000123456"),
    BodySetting("manufacturer", "Sony Corporation"),
    BodySetting("cameramodel", "ILCE-7M4"),
    BodySetting("deviceversion", "1.0"),
)
SONY_A6400 = SONY_A7M4 | _tree(
    BodySetting("capturetarget", "sdram", ("sdram", "card+sdram")),
    BodySetting("batterylevel", "100%", fixed=True),
    BodySetting(
        "iso",
        "1250",
        ("Auto ISO", "25", "50", "64", "80", "100", "125", "160", "200", "100 Multi Frame Noise Reduction"),
    ),
    BodySetting("f-number", "4.5", bounds=(0.0, 655.35)),
    BodySetting("cameramodel", "ILCE-6400"),
)
SONY_A6000 = SONY_A6400 | _tree(
    BodySetting("imagequality", "Fine", ("Standard", "Fine", "RAW", "RAW+JPEG")),
    BodySetting("focusmode", "Manual", ("Manual", "Automatic", "Automatic Macro", "Unknown value 8004")),
    BodySetting("cameramodel", "ILCE-6000"),
)
del SONY_A6000["capturetarget"], SONY_A6000["batterylevel"]

BODIES: Mapping[str, dict[str, BodySetting]] = {
    "Nikon Z 7": NIKON_Z7,
    "Nikon D7100": NIKON_D7100,
    "Sony A7 IV": SONY_A7M4,
    "Sony A6400": SONY_A6400,
    "Sony A6000": SONY_A6000,
}


class GPhotoFault(Exception):
    """Replaces gphoto2.GPhoto2Error."""

    def __init__(self, code: int, string: str = "a fault") -> None:
        super().__init__(string)
        self.code, self.string = code, string


class Widget:
    """A setting as gphoto2 returns it: a copy, which must be given back to set it."""

    def __init__(self, setting: BodySetting, value: object) -> None:
        self.setting, self.value = setting, value

    def get_type(self) -> str:
        return (
            "range"
            if self.setting.bounds
            else "radio"
            if self.setting.choices or self.setting.name == "iso"
            else "text"
        )

    def get_value(self) -> object:
        return self.value

    def set_value(self, value: object) -> None:
        if isinstance(value, str) == (self.setting.bounds is not None):
            raise TypeError(f"{value!r} is of the wrong type for {self.setting.name}")
        self.value = value

    def get_readonly(self) -> int:
        return int(self.setting.fixed)

    def get_range(self) -> list[float]:
        assert self.setting.bounds is not None
        return [*self.setting.bounds, 0.01]

    def count_choices(self) -> int:
        return len(self.setting.choices)

    def get_choice(self, index: int) -> str:
        return self.setting.choices[index]


@dataclass
class FakeBody:
    """A body behind libgphoto2: its settings, the files of a release, and its faults.

    `settles_after`: readings until a new value is visible; `stubborn` settings never change.
    """

    tree: dict[str, BodySetting]
    film: SeededFilm
    clock: Clock
    suffix: str = "nef"
    settles_after: int = 0
    stubborn: frozenset[str] = frozenset()
    fails: list[int] = field(default_factory=list[int])
    files: dict[str, bytes] = field(default_factory=dict[str, bytes])
    pending: dict[str, tuple[int, BodySetting]] = field(default_factory=dict[str, tuple[int, BodySetting]])
    number: int = 0
    openings: int = 0

    # Methods of gphoto2.Camera.

    def init(self) -> None:
        self.openings += 1

    def get_single_config(self, name: str) -> Widget:
        self._fault()
        if name in self.pending:
            looks, setting = self.pending[name]
            if looks <= 0:
                self.tree[name] = setting
                del self.pending[name]
            else:
                self.pending[name] = looks - 1, setting
        if name not in self.tree:
            raise GPhotoFault(-2, "bad parameters")
        setting = self.tree[name]
        return Widget(setting, float(setting.value) if setting.bounds else setting.value)

    def set_single_config(self, name: str, widget: Widget) -> None:
        self._fault()
        setting = self.tree[name]
        assert not setting.fixed, f"{name} is read-only"
        value = f"{widget.value:.9g}" if isinstance(widget.value, float) else str(widget.value)
        assert not setting.choices or value in setting.choices, f"{value} is not offered for {name}"
        if name not in self.stubborn:
            self.pending[name] = self.settles_after, replace(setting, value=value)

    def capture(self, kind: int) -> SimpleNamespace:
        self._fault()
        for name, (_, setting) in list(self.pending.items()):
            self.tree[name] = setting
        self.pending.clear()
        into = io.BytesIO()
        self.film.expose(self.exposure(), self.clock.now(), into)
        name = f"capt{self.number:04d}.{self.suffix}"
        self.number += 1
        self.files[name] = into.getvalue()
        return SimpleNamespace(folder="/", name=name)

    def file_get(self, folder: str, name: str, kind: int) -> SimpleNamespace:
        self._fault()
        return SimpleNamespace(get_data_and_size=lambda: memoryview(self.files[name]))

    def file_delete(self, folder: str, name: str) -> None:
        self._fault()
        del self.files[name]

    def get_storageinfo(self) -> list[SimpleNamespace]:
        if "capturetarget" not in self.tree:
            raise GPhotoFault(-6, "unsupported operation")
        return [SimpleNamespace(fields=8, freekbytes=3_000_000), SimpleNamespace(fields=0, freekbytes=7)]

    def exposure(self) -> ExposureSettings:
        """Return the present exposure settings."""
        speed = self.tree.get("shutterspeed2", self.tree["shutterspeed"]).value
        iso, aperture, shutter = (
            parse_number(text) for text in (self.tree["iso"].value, self.tree["f-number"].value, speed)
        )
        assert iso is not None
        assert aperture is not None
        assert shutter is not None
        return ExposureSettings(round(iso), aperture, shutter)

    def _fault(self) -> None:
        if self.fails:
            raise GPhotoFault(self.fails.pop(0))


def fake_module(body: FakeBody) -> Any:
    """Return a replacement of the module gphoto2 with one camera."""
    open_body: Callable[[], FakeBody] = lambda: body  # noqa: E731 - it stands for a class
    return SimpleNamespace(
        Camera=open_body,
        GPhoto2Error=GPhotoFault,
        GP_CAPTURE_IMAGE=0,
        GP_FILE_TYPE_NORMAL=1,
        GP_WIDGET_RADIO="radio",
        GP_WIDGET_MENU="menu",
        GP_WIDGET_RANGE="range",
        GP_STORAGEINFO_FREESPACEKBYTES=8,
        GP_ERROR_BAD_PARAMETERS=-2,
        GP_ERROR_NOT_SUPPORTED=-6,
        GP_ERROR_TIMEOUT=-10,
        GP_ERROR_IO_USB_CLAIM=-53,
        GP_ERROR_IO_LOCK=-60,
        GP_ERROR_CAMERA_BUSY=-110,
        GP_ERROR_MODEL_NOT_FOUND=-105,
        GP_ERROR_UNKNOWN_PORT=-5,
        GP_ERROR_IO_USB_FIND=-52,
        GP_ERROR_IO=-7,
        GP_ERROR_IO_READ=-34,
        GP_ERROR_IO_WRITE=-35,
        GP_ERROR_IO_INIT=-31,
    )
