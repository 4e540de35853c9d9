"""EOS bodies of the simulated camera: identification, properties, and lists of allowed values.

There is no public recording of the PTP data of an EOS 550D or 6D Mark II. Unknown values are copied from an EOS 60D,
for which there is a recording. Properties are in the order in which the 60D sends them.

Sources: a recorded EOS 60D (firmware 1.1.0); settings of an EOS 550D (firmware 1.0.9) and a 6D Mark II (1.0.2) that
users of libgphoto2 published; libgphoto2 2.5.34 for structures; specifications of Canon for battery and burst.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from types import MappingProxyType

from drivers import canon
from drivers.canon import RAW_ONLY, DeviceInfoEx, ImageFile, ImageFormat, number_value, text_value
from drivers.ptp.codes import (
    VENDOR_CANON_USB,
    AeMode,
    CaptureDestination,
    DriveMode,
    EosEvent,
    EventCode,
    FocusMode,
    ObjectFormat,
    Property,
    WhiteBalance,
)
from drivers.ptp.protocol import DeviceInfo
from sim.world.sensors import Body

# Kinds of the record that lists the allowed values of a property.
NO_LIST = 1  # Without list; the property can usually not be set.
LIST = 3  # With the list of all allowed values.
FREE = 7  # Without list, for texts, times and structures.


@dataclass(frozen=True)
class PropertySpec:
    """A property as a body reports it."""

    code: int  # A `drivers.ptp.codes.Property`, or a number without name
    # Encoded value. None if it is sent only on request, `b""` if it is calculated from the state of the camera.
    value: bytes | None
    kind: int = NO_LIST  # `NO_LIST`, `LIST` or `FREE`
    choices: tuple[int, ...] = ()  # Allowed values, in the order of the body
    formats: tuple[ImageFormat, ...] = ()  # Allowed image formats


@dataclass(frozen=True)
class EosModel:
    """Properties of an EOS body that PTP reports, and its speed and battery."""

    info: DeviceInfo  # DeviceInfo, without operations and serial number
    usb: tuple[int, int]  # USB vendor and product
    properties: tuple[PropertySpec, ...]  # At power-on, with the mode dial at M and manual focus
    shutter_codes: tuple[int, ...]  # Allowed shutter times in modes M and Tv
    aperture_codes: tuple[int, ...]  # Allowed apertures; empty for a lens without contacts
    burst: int  # Number of raw frames that the memory of the body can hold
    frame_bytes: int  # Expected size of a frame, for the number of free shots
    write_s: float  # Time from the end of an exposure until the file is ready
    shots_per_charge: int  # Frames per battery charge
    wide_objects: bool = False  # Whether object events have sizes of 64 bits

    @property
    def model(self) -> str:
        """Model name in DeviceInfo."""
        return self.info.model

    @property
    def info_ex(self) -> DeviceInfoEx:
        """Answer to GetDeviceInfoEx."""
        return DeviceInfoEx(EVENTS_EX, tuple(spec.code for spec in self.properties), (0, 1, 2, 4))


EVENTS = (
    EventCode.REQUEST_OBJECT_TRANSFER,
    EventCode.STORE_ADDED,
    EventCode.STORE_REMOVED,
    EventCode.OBJECT_REMOVED,
    EventCode.OBJECT_ADDED,
    EventCode.OBJECT_INFO_CHANGED,
    EventCode.EOS_REQUEST_GET_EVENT,
)
EVENTS_EX = (
    EosEvent.OBJECT_ADDED,
    EosEvent.OBJECT_REMOVED,
    EosEvent.REQUEST_GET_OBJECT_INFO,
    EosEvent.STORAGE_STATUS_CHANGED,
    EosEvent.STORAGE_INFO_CHANGED,
    EosEvent.REQUEST_OBJECT_TRANSFER,
    EosEvent.OBJECT_INFO_CHANGED,
    EosEvent.OBJECT_CONTENT_CHANGED,
    EosEvent.PROPERTY_CHANGED,
    EosEvent.AVAILABLE_LIST_CHANGED,
    EosEvent.CAMERA_STATUS_CHANGED,
    EosEvent.WILL_SOON_SHUT_DOWN,
    EosEvent.SHUTDOWN_TIMER_UPDATED,
    EosEvent.REQUEST_CANCEL_TRANSFER,
    EosEvent.REQUEST_OBJECT_TRANSFER_DT,
    EosEvent.REQUEST_CANCEL_TRANSFER_DT,
    0xC1A0,
    0xC1A1,
)
STANDARD_PROPERTIES = (
    Property.DEVICE_FRIENDLY_NAME,
    Property.PERCEIVED_DEVICE_TYPE,
    Property.SESSION_INITIATOR,
    Property.USE_DEVICE_STAGE,
    Property.BATTERY_LEVEL,
)


def structure(*numbers: int) -> bytes:
    """Return 32-bit numbers after their total length in bytes, the layout of many Canon structures."""
    return struct.pack(f"<{1 + len(numbers)}I", 4 + 4 * len(numbers), *numbers)


HALF_STOPS = 0x0101  # Custom function: exposure in half stops instead of third stops.
MIRROR_LOCKUP = 0x060F  # Custom function: the first press of the release raises the mirror.


def custom_functions(group: int, functions: Mapping[int, int]) -> bytes:
    """Encode one group of custom functions (property 0xd1a0); `functions` are settings by function number."""
    settings = [number for function, setting in functions.items() for number in (function, 1, setting)]
    return structure(1, group, 8 + 4 * len(settings), len(functions), *settings)


def focus_points() -> bytes:
    """Return nine focus points, none of them in focus (property 0xd1d3), in the layout of the 60D.

    libgphoto2 reads this layout: length, length − 4, version, number of points, number of points in use, two frame
    sizes; then heights, widths, x and y of all points, from the centre of the frame; then one bit for each point that
    is in focus.
    """
    xs = (-1720, -860, -860, 0, 0, 0, 860, 860, 1720)
    ys = (0, 489, -489, 792, 0, -792, 489, -489, 0)
    points = len(xs)
    numbers = struct.pack(f"<18H{2 * points}h", *(100,) * (2 * points), *xs, *ys)
    head = struct.pack("<2H4H", points, points, 5184, 3456, 5184, 3456)
    body = struct.pack("<H", 0) + head + numbers + struct.pack("<II", 0, 0)
    length = 4 + 2 + len(body)
    return struct.pack("<IH", length, length - 4) + body


_IMAGE_FORMATS = (
    ObjectFormat.ASSOCIATION,
    ObjectFormat.SCRIPT,
    ObjectFormat.DPOF,
    ObjectFormat.AVI,
    ObjectFormat.WAV,
    ObjectFormat.EXIF_JPEG,
    ObjectFormat.CRW,
    ObjectFormat.CR2,
    0xBF02,
    0x3800,
    ObjectFormat.MOV,
)


def _device_info(model: str, version: str, manufacturer: str, extension_version: int) -> DeviceInfo:
    return DeviceInfo(
        vendor_extension_id=6,
        vendor_extension_version=extension_version,
        events=tuple(EVENTS),
        properties=tuple(STANDARD_PROPERTIES),
        capture_formats=(ObjectFormat.EXIF_JPEG,),
        image_formats=_IMAGE_FORMATS,
        manufacturer=manufacturer,
        model=model,
        device_version=version,
    )


def _stops(scale: canon.Scale, first: int, last: int, thirds: bool = True) -> tuple[int, ...]:
    fractions = (0, 3, 5) if thirds else (0, 4)
    return tuple(step.code for step in scale.steps if first <= step.code <= last and step.code % 8 in fractions)


_TEMPERATURES_K = tuple(range(2500, 10001, 100))
_WHITE_SHIFTS = tuple(number & 0xFFFFFFFF for number in range(-9, 10))


def _thirds(first: int, last: int) -> tuple[int, ...]:
    # Codes of thirds of a stop, from `first` to `last` stops. The unit of a code is an eighth of a stop.
    return tuple(code & 0xFF for code in range(8 * first, 8 * last + 1) if code % 8 in (0, 3, 5))


def _jpegs(*sizes: tuple[int, bool]) -> tuple[ImageFile, ...]:
    # JPEG formats. Each argument is a size number, and whether this size also has normal quality, not only fine.
    return tuple(ImageFile(1, size, quality) for size, normal in sizes for quality in ((3, 2) if normal else (3,)))


def _raw(size: int = 0) -> ImageFile:
    return ImageFile(6, size, 4)


@dataclass(frozen=True)
class _Choices:
    """Properties that differ between the bodies; lists have the order of the body."""

    model_id: int
    formats: tuple[ImageFormat, ...]
    iso: tuple[int, ...]
    white_balance: tuple[int, ...]
    drive: tuple[int, ...]
    picture_styles: tuple[int, ...]
    bracketing: tuple[int, ...]
    compensation: tuple[int, ...]
    outputs: tuple[int, ...]
    temperatures: tuple[int, ...]
    auto_power_off_s: int
    lens: str
    half_stops: bool = False
    mirror_lockup_in_menu: bool = False


def _properties(body: _Choices) -> tuple[PropertySpec, ...]:
    number = number_value

    def listed(code: int, value: int, choices: tuple[int, ...]) -> PropertySpec:
        return PropertySpec(code, number(value), LIST, choices)

    def fixed(code: int, value: int) -> PropertySpec:
        return PropertySpec(code, number(value))

    style = structure(0, 3, 0, 0, 0, 0)
    user_style = structure(0x81, 0, 3, 0, 0, 0, 0)
    lockup = (listed(Property.EOS_MIRROR_UP_SETTING, 0, (0, 1)),) if body.mirror_lockup_in_menu else ()
    return (
        fixed(Property.EOS_AE_MODE, AeMode.MANUAL),
        listed(Property.EOS_FOCUS_MODE, FocusMode.MANUAL, (FocusMode.ONE_SHOT, FocusMode.AI_FOCUS, FocusMode.AI_SERVO)),
        listed(Property.EOS_DRIVE_MODE, DriveMode.SINGLE, body.drive),
        listed(Property.EOS_METERING_MODE, 3, (3, 4, 1, 5)),
        listed(Property.EOS_WHITE_BALANCE, WhiteBalance.AUTO, body.white_balance),
        listed(Property.EOS_COLOUR_TEMPERATURE, 5200, body.temperatures),
        listed(0xD10B, 0, _WHITE_SHIFTS),
        listed(0xD10C, 0, _WHITE_SHIFTS),
        listed(0xD10D, 0, (0, 1, 2, 3)),
        listed(0xD10E, 0, (0, 1, 2, 3)),
        listed(Property.EOS_COLOUR_SPACE, 1, (1, 2)),
        PropertySpec(Property.EOS_AVAILABLE_SHOTS, b""),
        fixed(Property.EOS_AUTO_POWER_OFF, body.auto_power_off_s),
        fixed(Property.EOS_MODEL_ID, body.model_id),
        fixed(Property.EOS_PTP_EXTENSION_VERSION, 0x100),
        PropertySpec(0xD11A, None),
        listed(Property.EOS_PICTURE_STYLE, body.picture_styles[0], body.picture_styles),
        PropertySpec(Property.EOS_OWNER, None, FREE),
        listed(Property.EOS_APERTURE, 0x38, ()),
        listed(Property.EOS_SHUTTER_SPEED, 0x68, ()),
        listed(Property.EOS_ISO_SPEED, body.iso[1], body.iso),
        listed(Property.EOS_EXPOSURE_COMPENSATION, 0, body.compensation),
        fixed(Property.EOS_BRACKET_MODE, 0),
        PropertySpec(Property.EOS_BATTERY_POWER, b""),
        fixed(Property.EOS_BATTERY_SELECT, 0),
        PropertySpec(Property.EOS_CAMERA_TIME, b"", FREE),
        PropertySpec(Property.EOS_IMAGE_FORMAT, RAW_ONLY.encode(), LIST, formats=body.formats),
        PropertySpec(Property.EOS_IMAGE_FORMAT_SD, RAW_ONLY.encode(), LIST, formats=body.formats),
        *(PropertySpec(code, style, FREE) for code in range(0xD150, 0xD156)),
        *(PropertySpec(code, user_style, FREE) for code in range(0xD160, 0xD163)),
        *(PropertySpec(code, None, FREE) for code in range(0xD170, 0xD173)),
        listed(Property.EOS_CAPTURE_DESTINATION, CaptureDestination.CARD, ()),
        *lockup,
        PropertySpec(Property.EOS_CUSTOM_FUNCTIONS, custom_functions(1, {HALF_STOPS: int(body.half_stops)}), FREE),
        PropertySpec(0xD1A1, structure(2, 1, 0x14, 2, 0x00030002), FREE),
        fixed(Property.EOS_LENS_STATUS, 1),
        fixed(Property.EOS_TEMPERATURE_STATUS, 0),
        listed(Property.EOS_EVF_OUTPUT_DEVICE, 0, body.outputs),
        listed(Property.EOS_EVF_MODE, 1, (0, 1)),
        PropertySpec(0xD1B2, number(0), FREE),
        PropertySpec(0xD1B3, number(0), FREE),
        listed(Property.EOS_QUICK_REVIEW_TIME, 2, (0, 2, 4, 8, 0xFF)),
        PropertySpec(Property.EOS_SHUTTER_COUNTER, b""),
        PropertySpec(Property.EOS_CURRENT_STORAGE, b""),
        PropertySpec(Property.EOS_CURRENT_FOLDER, b""),
        PropertySpec(Property.EOS_SERIAL_NUMBER, None),
        PropertySpec(Property.EOS_ARTIST, None, FREE),
        PropertySpec(Property.EOS_COPYRIGHT, None, FREE),
        listed(Property.EOS_AEB, 0, body.bracketing),
        PropertySpec(Property.EOS_FOCUS_INFO, focus_points(), FREE),
        PropertySpec(Property.EOS_LENS_NAME, text_value(body.lens).ljust(68, b"\0")),
        fixed(Property.EOS_MIRROR_DOWN_STATUS, 0),
        listed(Property.EOS_AUTO_LIGHTING_OPTIMIZER, 0, (0, 1, 2, 3)),
        fixed(Property.EOS_FLASH_CHARGING_STATE, 0),
        PropertySpec(Property.EOS_MIRROR_LOCKUP_STATE, number(0), FREE),
    )


_COMMON_WHITE = (
    WhiteBalance.DAYLIGHT,
    WhiteBalance.SHADE,
    WhiteBalance.CLOUDY,
    WhiteBalance.TUNGSTEN,
    WhiteBalance.FLUORESCENT,
    WhiteBalance.FLASH,
    WhiteBalance.MANUAL,
)
# Codes of the picture styles: six styles of Canon, then three of the user (libgphoto2).
_STYLES = (0x81, 0x82, 0x83, 0x84, 0x85, 0x86, 0x21, 0x22, 0x23)
_BULB = 0x0C  # Code of the shutter time B (bulb).

_CHOICES_550D = _Choices(
    model_id=0x80000270,
    formats=(
        *(ImageFormat((jpeg,)) for jpeg in _jpegs((0, True), (1, True), (2, True))),
        ImageFormat((_raw(), ImageFile(1, 0, 3))),
        ImageFormat((_raw(),)),
    ),
    iso=(0x00, 0x48, 0x50, 0x58, 0x60, 0x68, 0x70, 0x78),
    white_balance=(WhiteBalance.AUTO, *_COMMON_WHITE),
    drive=(DriveMode.SINGLE, DriveMode.CONTINUOUS, DriveMode.TIMER_10_S, DriveMode.TIMER_2_S),
    picture_styles=_STYLES,
    bracketing=_thirds(0, 2),
    compensation=(),
    outputs=(1, 2),
    temperatures=(),
    auto_power_off_s=30,
    lens="EF-S18-55mm f/3.5-5.6 IS",
)

# An EOS 550D with factory settings: third stops, no highlight priority, power off after 30 s. Assumed equal to the 60D:
# vendor extension id, operations, events, third-stop apertures, white balance shifts, structures, order of properties,
# capture destinations 2, 4, 6, and the reports of camera time and counters.
EOS_550D = EosModel(
    info=_device_info("Canon EOS 550D", "3-1.0.9", "Canon Inc.", 200),
    usb=(VENDOR_CANON_USB, 0x31EA),
    properties=_properties(_CHOICES_550D),
    shutter_codes=(_BULB, *_stops(canon.SHUTTER, 0x10, 0x98)),
    aperture_codes=_stops(canon.APERTURE, 0x25, 0x50),
    burst=6,
    frame_bytes=25 << 20,
    write_s=0.783,
    shots_per_charge=440,
)

# The EOS 550D with the published settings: half stops, no ISO 100 (probably highlight priority), and a largest aperture
# of f/4.
EOS_550D_AS_LISTED = replace(
    EOS_550D,
    properties=_properties(
        replace(
            _CHOICES_550D, iso=(0x00, 0x50, 0x58, 0x60, 0x68, 0x70, 0x78), bracketing=(0, 4, 8, 12, 16), half_stops=True
        )
    ),
    shutter_codes=(_BULB, *_stops(canon.SHUTTER, 0x10, 0x98, thirds=False)),
    aperture_codes=_stops(canon.APERTURE, 0x28, 0x54, thirds=False),
)

_JPEGS_6D2 = _jpegs((0, True), (1, True), (14, True), (15, False))

# An EOS 6D Mark II. Bulb is on its mode dial, not in its list of shutter times. mRAW and sRAW can be selected, but
# frames have full size. Assumed equal to the 60D: vendor extension id, operations, events, structures, order of
# properties, nine focus points (the 6D Mark II has 45), capture destinations 2, 4, 6, and object events of 32 bits.
# Shutter times and apertures are third stops in the range of the published settings. Mirror lockup is property 0xd13a
# in libgphoto2, but is missing in the published settings.
EOS_6D_MARK_II = EosModel(
    info=_device_info("Canon EOS 6D Mark II", "3-1.0.2", "Canon.Inc", 100),
    usb=(VENDOR_CANON_USB, 0x32CA),
    properties=_properties(
        _Choices(
            model_id=0x80000406,
            formats=(
                *(ImageFormat((jpeg,)) for jpeg in _JPEGS_6D2),
                *(ImageFormat((_raw(size), jpeg)) for size, jpeg in product((0, 1, 2), _JPEGS_6D2)),
                *(ImageFormat((_raw(size),)) for size in (0, 1, 2)),
            ),
            iso=(0x00, *_stops(canon.ISO, 0x48, 0x8D)),
            white_balance=(WhiteBalance.AUTO, WhiteBalance.AUTO_WHITE, *_COMMON_WHITE, WhiteBalance.KELVIN),
            drive=(
                DriveMode.SINGLE,
                DriveMode.CONTINUOUS_HIGH,
                DriveMode.CONTINUOUS_LOW,
                DriveMode.SINGLE_SILENT,
                DriveMode.CONTINUOUS_SILENT,
                DriveMode.TIMER_10_S,
                DriveMode.TIMER_2_S,
                DriveMode.TIMER_CONTINUOUS,
            ),
            picture_styles=(0x87, 0x81, 0x82, 0x83, 0x88, *_STYLES[3:]),
            bracketing=_thirds(0, 3),
            compensation=_thirds(-5, 5),
            outputs=tuple(range(12)),
            temperatures=_TEMPERATURES_K,
            auto_power_off_s=60,
            lens="EF50mm f/1.8 STM",
            mirror_lockup_in_menu=True,
        )
    ),
    shutter_codes=_stops(canon.SHUTTER, 0x10, 0x98),
    aperture_codes=_stops(canon.APERTURE, 0x15, 0x50),
    burst=21,
    frame_bytes=35 << 20,
    write_s=0.617,
    shots_per_charge=1200,
)

# An EOS 550D with the small frames of the test sensor.
TEST_BODY = replace(
    EOS_550D,
    info=replace(EOS_550D.info, model="CroP Test"),
    frame_bytes=1 << 20,
    write_s=0.113,
)

# Bodies by the name in settings and commands, as in `sim.world.sensors.BODIES`.
EOS_BODIES: Mapping[str, EosModel] = MappingProxyType(
    {"EOS 550D": EOS_550D, "EOS 6D Mark II": EOS_6D_MARK_II, "Test": TEST_BODY}
)


def eos_with(sensor: Body, name: str) -> EosModel:
    """Return the EOS body `name`, by default an EOS 550D, which reports maker and model of the camera of `sensor`."""
    body = EOS_BODIES.get(name, EOS_550D)
    maker, model = body.info.manufacturer, sensor.model
    if "canon" not in sensor.maker.lower():
        # The driver requires the word Canon in the maker. The first word of the maker starts the name of the camera.
        maker, model = f"{sensor.camera.split(' ')[0]} (simulated Canon EOS)", sensor.camera
    return replace(body, info=replace(body.info, manufacturer=maker, model=model))
