"""Driver of cameras through libgphoto2, for makers without a driver of our own; see `drivers.camera.Camera`.

python-gphoto2 is optional and imported only when a camera is opened. After a fault the connection is closed, and the
next call opens a new one. A frame that was being transferred is lost and may be taken again.

libgphoto2 has several names for some settings; see `first_setting`. The values are labels of libgphoto2 in English.
Every setting is read back. A body is refused if it offers no raw format, focuses automatically, or has another setting
that would spoil a series of frames. Settings that a body does not report are ignored.

Source: libgphoto2 2.5.34, camlibs/ptp2/config.c (names and labels), camlibs/ptp2/cameras (settings of bodies).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, BinaryIO

from drivers.camera import CameraIdentity, CapturedFrame, ExposureSettings, Supplies
from foundation.clock import SYSTEM_CLOCK, Clock
from foundation.errors import RUN_AGAIN, ConfigurationError, DeviceError, DeviceRefused, LinkClosed, LinkTimeout

if TYPE_CHECKING:
    import gphoto2


# Accepted relative difference between a label and a requested value. An example is 6 s, listed as 6.3 s by libgphoto2.
TOLERANCE = 0.06
# Accepted relative difference between two labels of the same value. An example is 1/60 s, truncated to 0.0166 s.
EQUAL_TOLERANCE = 0.011
_MAX_LISTED = 30  # Most choices that a message lists

# Names of settings in libgphoto2, the preferred name first.
RAW_FORMAT = ("imageformat", "imagequality")  # Canon, Fuji and Olympus; Nikon and Sony
ISO = ("iso",)
APERTURE = ("aperture", "f-number")
# Nikon bodies have both names. The second is not exact: it lists 1/6400 s as 0.0001 s.
SHUTTER = ("shutterspeed2", "shutterspeed")
TARGET = ("capturetarget",)
HOST_TARGETS = ("Internal RAM", "sdram")  # Labels of TARGET that send frames only to the host, not to the card

_RAW_LABELS = ("RAW", "NEF (Raw)", "Raw", "NEF", "RAW (Uncompressed)", "RAW (Lossless)")
_NOT_RAW_SUFFIXES = (".jpg", ".jpeg", ".hif", ".heif", ".heic", ".tif", ".tiff", ".mov", ".mp4")
# Settings that the user makes on the camera: names in libgphoto2, accepted labels, remedy. A body may have both names.
_USER_SETTINGS: tuple[tuple[tuple[str, ...], tuple[str, ...], str], ...] = (
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
# Settings that would change the raw values: name in libgphoto2, accepted labels, effect of the other labels.
_DISTURBING_SETTINGS: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("isoauto", ("Off",), "the body would choose the ISO speed"),
    ("autoiso", ("Off",), "the body would choose the ISO speed"),
    ("bracketing", ("Off",), "every frame would be exposed differently"),
    ("longexpnr", ("Off",), "the body would subtract its own dark frame"),
    ("autofocus", ("Off",), "the body would focus before each frame"),
    ("rawcompression", ("Lossless", "Uncompressed"), "raw values would be rounded"),
)
_BATTERY_WORDS = {"low": 0.0, "empty": 0.0, "full": 1.0}


@dataclass(frozen=True)
class BodySetting:
    """A setting of a body and its present value.

    - `name`: name in libgphoto2, such as ``f-number``.
    - `value`: a label, or a number as text.
    - `choices`: permitted labels; empty if the body lists none.
    - `bounds`: smallest and largest permitted number, None if the setting is not a range.
    - `fixed`: whether the setting is read-only.
    """

    name: str
    value: str
    choices: tuple[str, ...] = ()
    bounds: tuple[float, float] | None = None
    fixed: bool = False

    @property
    def has_no_number(self) -> bool:
        """True if neither its value nor a choice is a number."""
        return self.bounds is None and all(parse_number(label) is None for label in (self.value, *self.choices))

    def describe_choices(self) -> str:
        """Return the permitted values as text for a message."""
        if self.bounds is not None:
            return f"{self.bounds[0]:g} to {self.bounds[1]:g}"
        labels = ", ".join(self.choices[:_MAX_LISTED]) + (" …" if len(self.choices) > _MAX_LISTED else "")
        return labels or f"nothing (present value: {self.value or 'none'})"


Body = Callable[[str], BodySetting | None]  # Returns the setting with a name; None if the body does not have it


def first_setting(body: Body, names: Iterable[str]) -> BodySetting | None:
    """Return the first setting of `names` that a body has; settings with choices or bounds are preferred."""
    present = [setting for name in names if (setting := body(name)) is not None]
    return next((setting for setting in present if setting.choices or setting.bounds), present[0] if present else None)


def plan_settings(body: Body, settings: ExposureSettings) -> dict[str, str]:
    """Return the values of the settings for a series of raw frames, in the order in which they are set."""
    faults: list[str] = []
    values: dict[str, str] = {}
    for names, allowed, remedy in _USER_SETTINGS:
        states = [setting for name in names if (setting := body(name)) is not None and setting.value]
        if states and not any(setting.value in allowed for setting in states):
            faults.append(f"{states[0].name} is {states[0].value}: {remedy}")
    for name, labels, effect in _DISTURBING_SETTINGS:
        setting = body(name)
        if setting is None or setting.value in labels or not setting.choices:
            continue
        label = next((label for label in labels if label in setting.choices), None)
        if label is None or setting.fixed:
            faults.append(f"{name} is {setting.value}, so {effect}: set it to {labels[0]} on the camera")
        else:
            values[name] = label
    _select(first_setting(body, TARGET), HOST_TARGETS, values, faults)
    raw = first_setting(body, RAW_FORMAT)
    if raw is None:
        faults.append(
            f"a raw format cannot be set: the body has neither {' nor '.join(RAW_FORMAT)}; set it to raw alone "
            "by hand and take the frames with another program, then use `acquire import`"
        )
    _select(raw, _RAW_LABELS, values, faults)
    for names, value in (
        (ISO, float(settings.iso)),
        (APERTURE, settings.aperture),
        (SHUTTER, settings.shutter_s),
    ):
        setting = first_setting(body, names)
        if value is None:
            if setting is not None and parse_number(setting.value) is not None:
                faults.append(f"the lens offers apertures and is set to {setting.value}: set one as f-number")
            continue
        if names is APERTURE and setting is not None and setting.has_no_number:
            faults.append(f'aperture {value:g} cannot be set, because the lens reports none: set aperture = "none"')
            continue
        label = None if setting is None else find_label(setting, value)
        if setting is None:
            faults.append(f"{' or '.join(names)} {value:g} cannot be set: the body has no such setting")
        elif label is None:
            faults.append(
                f"{setting.name} {value:g} is not offered (offered: {setting.describe_choices()}): set one of these"
            )
        else:
            values[setting.name] = label
    if faults:
        raise DeviceRefused("the camera cannot take the series", remedy="; ".join(faults))
    return values


def find_label(setting: BodySetting, number: float) -> str | None:
    """Return the label that sets a setting to `number`; None if no label is close enough."""
    if setting.fixed:
        return setting.value if are_equal(setting.value, f"{number:.9g}", TOLERANCE) else None
    if setting.bounds is not None:
        lowest, highest = setting.bounds
        return f"{number:.9g}" if lowest <= number <= highest else None
    if not setting.choices:
        # Some bodies list no choices for a writable setting.
        return f"{number:.9g}"
    candidates = {label: candidate for label in setting.choices if (candidate := parse_number(label)) is not None}
    labels = [label for label, candidate in candidates.items() if abs(candidate / number - 1) <= TOLERANCE]
    return min(labels, key=lambda label: abs(candidates[label] / number - 1), default=None)


def are_equal(first: str, second: str, tolerance: float = EQUAL_TOLERANCE) -> bool:
    """Return whether two labels are equal: the same text, or the same number in another format."""
    if first == second:
        return True
    first_number, second_number = parse_number(first), parse_number(second)
    return first_number is not None and second_number is not None and abs(first_number / second_number - 1) <= tolerance


def parse_number(label: str) -> float | None:
    """Return the number in a label such as ``f/5.6``, ``0,0400s``, ``32/10``, ``1/60`` or ``100``.

    None for labels with other text, such as ``100 Multi Frame Noise Reduction`` or ``x 200``.
    """
    dividend, _, divisor = label.lower().replace(",", ".").removeprefix("f/").removesuffix("s").partition("/")
    try:
        number = float(dividend) / float(divisor or 1)
    except (ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < float("inf") else None


def battery_level(text: str) -> float | None:
    """Return the battery charge in a label such as ``80%`` or ``Low``, 0 to 1; None for another label."""
    label = text.strip().lower()
    if label in _BATTERY_WORDS:
        return _BATTERY_WORDS[label]
    if label.endswith("%") and label[:-1].strip().isdecimal():
        return min(int(label[:-1]), 100) / 100
    return None


def _select(setting: BodySetting | None, labels: tuple[str, ...], values: dict[str, str], faults: list[str]) -> None:
    """Add the first offered label to `values`; if no label is offered or already set, add a fault."""
    if setting is None:
        return
    offered_label = next((label for label in labels if label in setting.choices), None)
    if offered_label is not None and not setting.fixed:
        values[setting.name] = offered_label
    elif setting.value not in labels:
        faults.append(
            f"{setting.name} offers {setting.describe_choices()}, expected one of {', '.join(labels)}: set it on the "
            "camera"
        )


# Time in which a body must report a new value, seconds. A Sony body changes values step by step.
SETTLE_LIMIT_S = 5.0

BUSY_TRIES = 5  # Most requests for a file from a body that is busy, because it may still be writing
BUSY_PAUSE_S = 1.0  # Pause between two of these requests, seconds
_POLL_S = 0.1  # Pause between two readings of a new value, seconds

_IDENTITY = {
    "maker": ("manufacturer",),
    "model": ("cameramodel",),
    "serial": ("eosserialnumber", "serialnumber"),
    "firmware": ("deviceversion",),
}


class Gphoto2Camera:
    """A `drivers.camera.Camera` through libgphoto2.

    Parameters
    ----------
    port
        Port as named by libgphoto2, such as ``usb:001,005`` or ``ptpip:192.168.1.1``; None selects the first detected
        camera.
    model
        Model as named by libgphoto2; ``PTP/IP Camera`` on a network. None detects the model, which works only on USB.
    """

    def __init__(self, port: str | None = None, model: str | None = None, clock: Clock = SYSTEM_CLOCK) -> None:
        self._port = port
        self._model = model
        self._clock = clock
        self._camera: gphoto2.Camera | None = None
        self._settings: ExposureSettings | None = None
        self._exposed: tuple[gphoto2.CameraFilePath, datetime] | None = None
        self._closed = False
        load_library()

    def identity(self) -> CameraIdentity:
        """Return maker, model, serial number and firmware; an empty text if the body does not report a value."""
        with self._connection() as camera:
            return CameraIdentity(**{field: _read_text(camera, names) for field, names in _IDENTITY.items()})

    def configure(self, settings: ExposureSettings) -> None:
        """Set and verify exposure, raw format and destination."""
        self._settings = None
        with self._connection() as camera:
            self._apply(camera, settings)
        self._settings = settings

    def shutter_speeds(self) -> tuple[float, ...]:
        """Return the shutter times that libgphoto2 lists, in seconds, ascending; empty if it lists none."""
        with self._connection() as camera:
            setting = first_setting(lambda name: _read_setting(camera, name), SHUTTER)
            numbers = (parse_number(label) for label in (setting.choices if setting is not None else ()))
            return tuple(sorted({number for number in numbers if number is not None}))

    def supplies(self) -> Supplies:
        """Return battery charge and free space on the cards; see `drivers.camera.ReportsSupplies`."""
        with self._connection() as camera:
            power = _read_text(camera, ("acpower",))
            target = first_setting(lambda name: _read_setting(camera, name), TARGET)
            # If the host is not the present target but is offered, `configure` will set it.
            to_host = target is None or any(label in (target.value, *target.choices) for label in HOST_TARGETS)
            return Supplies(
                battery_level(_read_text(camera, ("batterylevel",))),
                {"On": True, "Off": False}.get(power),
                _card_free_bytes(camera),
                to_host,
            )

    def expose(self) -> datetime:
        """Release the shutter, wait until libgphoto2 reports the file, and return the time of the release (UTC).

        An earlier frame that was not downloaded is dropped.
        """
        settings = self._settings
        if settings is None:
            raise DeviceRefused("the camera has no exposure settings; call configure before the first exposure")
        gp = load_library()
        is_new_connection = self._camera is None
        with self._connection() as camera:
            self._delete_exposed(camera)
            if is_new_connection:
                self._apply(camera, settings)
            released_at = self._clock.now()
            path = camera.capture(gp.GP_CAPTURE_IMAGE)
            self._exposed = path, released_at
            if path.name.lower().endswith(_NOT_RAW_SUFFIXES):
                self._delete_exposed(camera)
                raise DeviceRefused(f"the camera wrote {path.name}, expected a raw file; set raw alone by hand")
        return released_at

    def download(self, into: BinaryIO) -> CapturedFrame:
        """Write the raw file of the last exposure to `into`, complete and unchanged.

        If only writing to `into` failed, the call may be repeated. A fault of the connection loses the frame.
        """
        if self._exposed is None:
            raise DeviceError("the camera has no exposed frame; expose again")
        path, released_at = self._exposed
        with self._connection() as camera:
            # `file` owns the bytes and must live until they are written.
            file = self._fetch_file(camera, path)
            size = into.write(file.get_data_and_size())
            self._delete_exposed(camera)
        return CapturedFrame(path.name, size, released_at)

    def close(self) -> None:
        """Release the camera; a second call does nothing."""
        self._closed = True
        self._close_connection()

    def _fetch_file(self, camera: gphoto2.Camera, path: gphoto2.CameraFilePath) -> gphoto2.CameraFile:
        gp = load_library()
        for _ in range(BUSY_TRIES - 1):
            try:
                return camera.file_get(path.folder, path.name, gp.GP_FILE_TYPE_NORMAL)
            except gp.GPhoto2Error as error:
                if error.code != gp.GP_ERROR_CAMERA_BUSY:
                    raise
            self._clock.sleep(BUSY_PAUSE_S)
        return camera.file_get(path.folder, path.name, gp.GP_FILE_TYPE_NORMAL)

    def _delete_exposed(self, camera: gphoto2.Camera) -> None:
        """Delete the exposed frame, if any, so that the camera's memory does not fill up."""
        exposed, self._exposed = self._exposed, None
        if exposed is not None:
            path, _ = exposed
            with contextlib.suppress(load_library().GPhoto2Error):  # the file may be deleted already
                camera.file_delete(path.folder, path.name)

    def _close_connection(self) -> None:
        self._exposed = None
        # libgphoto2 disconnects when the last reference is gone. An explicit `exit` that fails would be repeated then,
        # and could close file descriptors of other files.
        self._camera = None

    @contextmanager
    def _connection(self) -> Generator[gphoto2.Camera]:
        if self._closed:
            raise DeviceError("the camera has been closed; open the rig again")
        gp = load_library()
        try:
            if self._camera is None:
                self._camera = self._open_camera()
            yield self._camera
        except gp.GPhoto2Error as error:
            self._close_connection()
            raise _translate_error(error, self._port or "the camera") from error

    def _open_camera(self) -> gphoto2.Camera:
        gp = load_library()
        camera = gp.Camera()
        if self._port is not None:
            ports = gp.PortInfoList()
            ports.load()
            with _translate_lookup_errors(f"port {self._port!r}", "such as usb:001,004 or ptpip:192.168.1.20"):
                camera.set_port_info(ports[ports.lookup_path(self._port)])
        if self._model is not None:
            models = gp.CameraAbilitiesList()
            models.load()
            with _translate_lookup_errors(f"model {self._model!r}", "gphoto2 --list-cameras lists all models"):
                camera.set_abilities(models[models.lookup_model(self._model)])
        camera.init()
        return camera

    def _apply(self, camera: gphoto2.Camera, settings: ExposureSettings) -> None:
        for name, label in plan_settings(lambda name: _read_setting(camera, name), settings).items():
            self._set(camera, name, label)

    def _set(self, camera: gphoto2.Camera, name: str, label: str) -> None:
        gp = load_library()
        widget = camera.get_single_config(name)
        if are_equal(_format_value(widget.get_value()), label):
            return
        widget.set_value(float(label) if widget.get_type() == gp.GP_WIDGET_RANGE else label)
        camera.set_single_config(name, widget)
        end = self._clock.monotonic() + SETTLE_LIMIT_S
        while True:
            reported = _format_value(camera.get_single_config(name).get_value())
            if are_equal(reported, label):
                return
            if self._clock.monotonic() >= end:
                raise DeviceRefused(f"{name} is {reported} on the camera, expected {label} as set; set it by hand")
            self._clock.sleep(_POLL_S)


def load_library():
    """Return python-gphoto2."""
    try:
        import gphoto2
    except ImportError as error:
        raise ConfigurationError("python-gphoto2 is not installed; install it with: pip install gphoto2") from error
    return gphoto2


@contextmanager
def _translate_lookup_errors(subject: str, remedy: str) -> Generator[None]:
    """Convert the error for an unknown port or model to a ConfigurationError that lists the detected cameras."""
    gp = load_library()
    try:
        yield
    except gp.GPhoto2Error as error:
        raise ConfigurationError(
            f"libgphoto2 has no {subject} ({remedy}; detected: {_detected_cameras()})",
            remedy="set one of these, or omit the setting",
        ) from error


def _detected_cameras() -> str:
    cameras = load_library().Camera.autodetect()
    names = [f"{cameras.get_name(index)} at {cameras.get_value(index)}" for index in range(cameras.count())]
    return "; ".join(names) or "none"


def _translate_error(error: gphoto2.GPhoto2Error, label: str) -> DeviceError:
    gp = load_library()
    fault = f"{label}: libgphoto2 reports {error.string} ({error.code})"
    match error.code:
        case gp.GP_ERROR_TIMEOUT:
            return LinkTimeout(f"{fault}; check that the camera is on and awake")
        case gp.GP_ERROR_IO_USB_CLAIM | gp.GP_ERROR_IO_LOCK:
            return LinkClosed(f"{fault}; close the other program that uses it, such as the desktop's photo importer")
        case gp.GP_ERROR_CAMERA_BUSY:
            return DeviceError(f"{fault}; repeat the frame when the camera is idle")
        case gp.GP_ERROR_MODEL_NOT_FOUND | gp.GP_ERROR_UNKNOWN_PORT | gp.GP_ERROR_IO_USB_FIND:
            return LinkClosed(
                f"{fault} (detected: {_detected_cameras()})",
                remedy="connect the camera, switch it on, or set its port and model",
            )
        case gp.GP_ERROR_IO | gp.GP_ERROR_IO_READ | gp.GP_ERROR_IO_WRITE | gp.GP_ERROR_IO_INIT:
            return LinkClosed(f"{fault}; check the cable and the USB permission, switch the camera off and on")
        case _:
            return DeviceError(f"{fault}; switch the camera off and on, {RUN_AGAIN}")


def _read_text(camera: gphoto2.Camera, names: Iterable[str]) -> str:
    settings = (_read_setting(camera, name) for name in names)
    return next((setting.value for setting in settings if setting is not None and setting.value), "")


def _read_setting(camera: gphoto2.Camera, name: str) -> BodySetting | None:
    gp = load_library()
    try:
        widget = camera.get_single_config(name)
    except gp.GPhoto2Error as error:
        if error.code != gp.GP_ERROR_BAD_PARAMETERS:
            raise
        return None
    widget_type = widget.get_type()
    choices: tuple[str, ...] = ()
    bounds: tuple[float, float] | None = None
    if widget_type in (gp.GP_WIDGET_RADIO, gp.GP_WIDGET_MENU):
        choices = tuple(widget.get_choice(index) for index in range(widget.count_choices()))
    elif widget_type == gp.GP_WIDGET_RANGE:
        lowest, highest, _ = widget.get_range()
        bounds = lowest, highest
    return BodySetting(name, _format_value(widget.get_value()), choices, bounds, bool(widget.get_readonly()))


def _format_value(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _card_free_bytes(camera: gphoto2.Camera) -> int | None:
    gp = load_library()
    try:
        stores = camera.get_storageinfo()
    except gp.GPhoto2Error as error:
        if error.code != gp.GP_ERROR_NOT_SUPPORTED:
            raise
        return None
    free = [1024 * store.freekbytes for store in stores if store.fields & gp.GP_STORAGEINFO_FREESPACEKBYTES]
    return sum(free) if free else None
