"""The settings of a camera as libgphoto2 names them, and what a series of raw frames wants of them.

Rules that hold inside:

- Values only: what a body shows goes in, what it is to be given comes out. libgphoto2 is asked in
  `drivers.gphoto2_camera.camera`.
- libgphoto2 names one thing differently for each maker, and one maker's bodies differ: the first of some names that a
  body has is used. Labels are those of libgphoto2's own tables, untranslated.
- Nothing is taken for settable that the body does not show. A raw format that cannot be asked for is refused, and so
  is what is known to spoil a series; what a body does not show at all is no problem.

Source: libgphoto2 2.5.34, camlibs/ptp2/config.c (names and labels), camlibs/ptp2/cameras (what bodies of each maker
show).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from drivers.camera import ExposureSettings
from foundation.errors import DeviceRefused

TOLERANCE = 0.06
"""Relative difference allowed between a label and the value wanted: libgphoto2 lists 6.3 s where the dial shows 6."""
SAME = 0.011
"""Relative difference between two labels of one value: a Nikon's 1/60 is listed as 0.0166 s too, cut off there."""
_LISTED = 30
"""Choices that a message lists, at most."""

RAW_FORMAT = ("imageformat", "imagequality")
"""Canon, Fuji and Olympus have the former, Nikon and Sony the latter."""
ISO = ("iso",)
APERTURE = ("aperture", "f-number")
SHUTTER = ("shutterspeed2", "shutterspeed")
"""A Nikon has both, and only the former is exact: the latter lists 1/6400 s as 0.0001 s."""
TARGET = ("capturetarget",)
HOST_TARGETS = ("Internal RAM", "sdram")
"""Frames go to the host and leave nothing on the card."""

_RAW_LABELS = ("RAW", "NEF (Raw)", "Raw", "NEF", "RAW (Uncompressed)", "RAW (Lossless)")
_NOT_RAW_SUFFIXES = (".jpg", ".jpeg", ".hif", ".heif", ".heic", ".tif", ".tiff", ".mov", ".mp4")
_STATES: tuple[tuple[tuple[str, ...], tuple[str, ...], str], ...] = (
    (("autoexposuremode", "expprogram"), ("Manual", "M"), "turn the mode dial to M"),
    (
        ("focusmode", "focusmode2"),
        ("Manual", "Manual Reverse", "MF", "MF (fixed)", "MF (selection)"),
        "set the lens or the body to MF and focus by hand",
    ),
    (
        ("drivemode", "capturemode"),
        ("Single", "Single silent", "Single Shot", "Quiet Release"),
        "set single shooting",
    ),
)
"""Names of a state, labels of which one must be shown, and the remedy; a body may show a state under two names."""
_SWITCHES: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("isoauto", ("Off",), "the body would choose the ISO speed"),
    ("autoiso", ("Off",), "the body would choose the ISO speed"),
    ("bracketing", ("Off",), "every frame would be exposed differently"),
    ("longexpnr", ("Off",), "the body would subtract a dark frame of its own"),
    ("autofocus", ("Off",), "the body would focus before each frame"),
    ("rawcompression", ("Lossless", "Uncompressed"), "raw values would be rounded"),
)
"""Names of what must be off, the labels for that, and what it would do."""
_BATTERY_WORDS = {"low": 0.0, "empty": 0.0, "full": 1.0}


@dataclass(frozen=True)
class BodySetting:
    """A setting as a body shows it now.

    - `name`: libgphoto2's, such as ``f-number``.
    - `value`: what is set: a label, or a number as text.
    - `choices`: what it can be set to; empty where the body lists nothing.
    - `bounds`: least and greatest number that it can be set to, where it is a range.
    - `fixed`: whether it cannot be set.
    """

    name: str
    value: str
    choices: tuple[str, ...] = ()
    bounds: tuple[float, float] | None = None
    fixed: bool = False

    def offered(self) -> str:
        """Return what it can be set to, as a message lists it."""
        if self.bounds is not None:
            return f"{self.bounds[0]:g} to {self.bounds[1]:g}"
        listed = ", ".join(self.choices[:_LISTED]) + (" …" if len(self.choices) > _LISTED else "")
        return listed or f"nothing (it stands at {self.value or 'nothing'})"


Body = Callable[[str], BodySetting | None]
"""Gives a body's setting of a name, None where it has none."""


def first_of(body: Body, names: Iterable[str]) -> BodySetting | None:
    """Return the first of some settings that a body has; of several, one that has something to choose from."""
    found = [setting for name in names if (setting := body(name)) is not None]
    return next((setting for setting in found if setting.choices or setting.bounds), found[0] if found else None)


def plan(body: Body, settings: ExposureSettings) -> dict[str, str]:
    """Return which setting gets which value for a series of raw frames, in the order of setting."""
    refused: list[str] = []
    wanted: dict[str, str] = {}
    for names, allowed, remedy in _STATES:
        shown = [setting for name in names if (setting := body(name)) is not None and setting.value]
        if shown and not any(setting.value in allowed for setting in shown):
            refused.append(f"{shown[0].name} is {shown[0].value}: {remedy}")
    for name, labels, harm in _SWITCHES:
        setting = body(name)
        if setting is None or setting.value in labels or not setting.choices:
            continue
        label = next((label for label in labels if label in setting.choices), None)
        if label is None or setting.fixed:
            refused.append(f"{name} is {setting.value}, so that {harm}: set it to {labels[0]} on the camera")
        else:
            wanted[name] = label
    _choose(first_of(body, TARGET), HOST_TARGETS, wanted, refused)
    raw = first_of(body, RAW_FORMAT)
    if raw is None:
        refused.append(
            f"a raw format cannot be asked for: the body shows neither {' nor '.join(RAW_FORMAT)}; set it to raw alone "
            "by hand and take the frames with another program, then use `acquire import`"
        )
    _choose(raw, _RAW_LABELS, wanted, refused)
    for names, value in (
        (ISO, float(settings.iso)),
        (APERTURE, settings.aperture),
        (SHUTTER, settings.shutter_s),
    ):
        setting = first_of(body, names)
        label = None if setting is None else label_of(setting, value)
        if setting is None:
            refused.append(f"{' or '.join(names)} {value:g} cannot be asked for: the body does not show it")
        elif label is None:
            refused.append(f"{setting.name} {value:g} is not offered; offered are {setting.offered()}")
        else:
            wanted[setting.name] = label
    if refused:
        raise DeviceRefused(f"the camera cannot take the series: {'; '.join(refused)}")
    return wanted


def label_of(setting: BodySetting, wanted: float) -> str | None:
    """Return the label that sets a setting to a number, None where none comes near enough."""
    if setting.fixed:
        return setting.value if is_same(setting.value, f"{wanted:.9g}", TOLERANCE) else None
    if setting.bounds is not None:
        least, greatest = setting.bounds
        return f"{wanted:.9g}" if least <= wanted <= greatest else None
    if not setting.choices:
        # Some bodies list nothing for what can be set all the same; what comes of it is read back.
        return f"{wanted:.9g}"
    numbers = {label: number for label in setting.choices if (number := number_of(label)) is not None}
    near = [label for label, number in numbers.items() if abs(number / wanted - 1) <= TOLERANCE]
    return min(near, key=lambda label: abs(numbers[label] / wanted - 1), default=None)


def is_same(label: str, other: str, tolerance: float = SAME) -> bool:
    """Return whether two labels mean the same: the same text, or the same number written differently."""
    if label == other:
        return True
    number, second = number_of(label), number_of(other)
    return number is not None and second is not None and abs(number / second - 1) <= tolerance


def number_of(label: str) -> float | None:
    """Return the number in a label: ``f/5.6``, ``0,0400s``, ``32/10``, ``1/60``, ``100``; None where it is none.

    Labels with more in them than a number, such as ``100 Multi Frame Noise Reduction`` or ``x 200``, are none.
    """
    over, _, under = label.lower().replace(",", ".").removeprefix("f/").removesuffix("s").partition("/")
    try:
        number = float(over) / float(under or 1)
    except (ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < float("inf") else None


def battery_level(text: str) -> float | None:
    """Return the charge in a label such as ``80%`` or ``Low``, 0 … 1; None where it says none."""
    found = text.strip().lower()
    if found in _BATTERY_WORDS:
        return _BATTERY_WORDS[found]
    if found.endswith("%") and found[:-1].strip().isdecimal():
        return min(int(found[:-1]), 100) / 100
    return None


def is_no_raw_file(name: str) -> bool:
    """Return whether a file that a camera made is a picture or film, not raw, by its suffix."""
    return name.lower().endswith(_NOT_RAW_SUFFIXES)


def _choose(setting: BodySetting | None, labels: tuple[str, ...], wanted: dict[str, str], refused: list[str]) -> None:
    """Note which of some labels a setting is to have; a body that has it already need not offer it."""
    if setting is None:
        return
    found = next((label for label in labels if label in setting.choices), None)
    if found is not None and not setting.fixed:
        wanted[setting.name] = found
    elif setting.value not in labels:
        refused.append(f"{setting.name} offers {setting.offered()}, none of {', '.join(labels)} that can be set")
