"""What a simulated EOS body is made of: the form of its table of facts, what all of them share, and Canon's structures.

- `OPERATIONS` are those that `sim.camera.eos` answers, in the 60D's order, and no others: a real body has more
  (uploads, live view, formatting).
- `EVENTS_EX` are the record types that the 60D names in GetDeviceInfoEx.

Source: a recorded EOS 60D (firmware 1.1.0); libgphoto2 2.5.34 for the structures.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from drivers.canon.records import DeviceInfoEx, ImageFormat
from drivers.ptp.codes import EosEvent, EventCode, Operation, Property
from drivers.ptp.datasets import DeviceInfo

NO_LIST = 1
"""Kind of a list record: the property has no list; with few exceptions it cannot be set."""
LIST = 3
"""Kind of a list record: the property can be set to what the list holds; to nothing while it is empty."""
FREE = 7
"""Kind of a list record: no list; text, times and structures."""


@dataclass(frozen=True)
class PropertySpec:
    """A property as a body sends it when it is asked for everything.

    - `code`: one of `drivers.ptp.codes.Property`, or a number without a name.
    - `value`: as it travels; None where it is sent on request only, `b""` where the state machine computes it.
    - `kind`: `NO_LIST`, `LIST` or `FREE`.
    - `choices`: what it can be set to, in the body's order.
    - `formats`: the same for image formats.
    """

    code: int
    value: bytes | None
    kind: int = NO_LIST
    choices: tuple[int, ...] = ()
    formats: tuple[ImageFormat, ...] = ()


@dataclass(frozen=True)
class EosModel:
    """An EOS body as the wire shows it.

    - `info`: its DeviceInfo; the serial number is the state machine's to add.
    - `usb`: vendor and product.
    - `properties`: every property, as the body stands when it is switched on with its dial at M and the lens on manual
      focus.
    - `shutter_codes`, `aperture_codes`: what the lists of shutter times and apertures hold where the dial lets them be
      set.
    - `burst`: raw frames that its memory holds.
    - `frames_per_s`: pace of continuous drive.
    - `frame_bytes`: what it reckons with for one frame; sizes of real raw files vary.
    - `write_s`: time from the end of an exposure until the file is ready.
    - `shots_per_charge`: frames that a full battery lasts for.
    - `wide_objects`: whether objects are announced by the records with sizes of 64 bits.
    - `borrowed`: what is not known of this very body, and where it was taken from.
    """

    info: DeviceInfo
    usb: tuple[int, int]
    properties: tuple[PropertySpec, ...]
    shutter_codes: tuple[int, ...]
    aperture_codes: tuple[int, ...]
    burst: int
    frames_per_s: float
    frame_bytes: int
    write_s: float
    shots_per_charge: int
    borrowed: tuple[str, ...]
    wide_objects: bool = False

    @property
    def model(self) -> str:
        """Its name, as in DeviceInfo."""
        return self.info.model

    @property
    def info_ex(self) -> DeviceInfoEx:
        """Its answer to GetDeviceInfoEx."""
        return DeviceInfoEx(EVENTS_EX, tuple(spec.code for spec in self.properties), (0, 1, 2, 4))


OPERATIONS = (
    Operation.GET_DEVICE_PROP_DESC,
    Operation.GET_DEVICE_PROP_VALUE,
    Operation.SET_DEVICE_PROP_VALUE,
    Operation.GET_DEVICE_INFO,
    Operation.OPEN_SESSION,
    Operation.CLOSE_SESSION,
    Operation.GET_NUM_OBJECTS,
    Operation.GET_STORAGE_IDS,
    Operation.EOS_GET_STORAGE_IDS,
    Operation.GET_STORAGE_INFO,
    Operation.EOS_GET_STORAGE_INFO,
    Operation.GET_OBJECT_HANDLES,
    Operation.GET_OBJECT_INFO,
    Operation.GET_OBJECT,
    Operation.EOS_GET_OBJECT,
    Operation.GET_THUMB,
    Operation.GET_PARTIAL_OBJECT,
    Operation.EOS_GET_PARTIAL_OBJECT,
    Operation.DELETE_OBJECT,
    Operation.EOS_DELETE_OBJECT,
    Operation.EOS_SET_DEVICE_PROP_VALUE_EX,
    Operation.EOS_REQUEST_DEVICE_PROP_VALUE,
    Operation.EOS_GET_DEVICE_INFO_EX,
    Operation.EOS_GET_OBJECT_INFO_EX,
    Operation.EOS_REMOTE_RELEASE,
    Operation.EOS_SET_EVENT_MODE,
    Operation.EOS_SET_REMOTE_MODE,
    Operation.EOS_GET_REMOTE_MODE,
    Operation.EOS_GET_EVENT,
    Operation.EOS_TRANSFER_COMPLETE,
    Operation.EOS_CANCEL_TRANSFER,
    Operation.EOS_RESET_TRANSFER,
    Operation.EOS_KEEP_DEVICE_ON,
    Operation.EOS_SET_UI_LOCK,
    Operation.EOS_RESET_UI_LOCK,
    Operation.EOS_PC_HDD_CAPACITY,
    Operation.EOS_AF_CANCEL,
    Operation.EOS_REMOTE_RELEASE_ON,
    Operation.EOS_REMOTE_RELEASE_OFF,
    Operation.EOS_RESET_MIRROR_LOCKUP_STATE,
)
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
    """Return numbers of 32 bits behind their length in bytes, itself included: how Canon packs many structures."""
    return struct.pack(f"<{1 + len(numbers)}I", 4 + 4 * len(numbers), *numbers)


HALF_STOPS = 0x0101
"""Custom function: exposure is set in half stops, not thirds."""
MIRROR_LOCKUP = 0x060F
"""Custom function: the first press lifts the mirror, on bodies that do not have it in the menu (group 3)."""


def custom_functions(group: int, functions: Mapping[int, int]) -> bytes:
    """Return one group of custom functions (property 0xd1a0): number of a function → its setting."""
    settings = [number for function, setting in functions.items() for number in (function, 1, setting)]
    return structure(1, group, 8 + 4 * len(settings), len(functions), *settings)


FOCUS_POINTS = 9
"""As the 60D has them, in a cross."""
FOCUS_CENTRE = 4
"""Number of the one in the middle, of 0 to 8."""


def focus_points(found: Iterable[int]) -> bytes:
    """Return where the body is in focus (property 0xd1d3): of nine points in a cross, those numbered in `found`.

    The layout is the 60D's, as libgphoto2 reads it: length, length − 4, version, points, points in use, two frame
    sizes, then of all points heights, widths, x and y from the frame's centre, then a bit for each that is in focus.
    """
    xs = (-1720, -860, -860, 0, 0, 0, 860, 860, 1720)
    ys = (0, 489, -489, 792, 0, -792, 489, -489, 0)
    numbers = struct.pack(f"<18H{2 * FOCUS_POINTS}h", *(100,) * (2 * FOCUS_POINTS), *xs, *ys)
    bits = sum(1 << point for point in found)
    head = struct.pack("<2H4H", FOCUS_POINTS, FOCUS_POINTS, 5184, 3456, 5184, 3456)
    body = struct.pack("<H", 0) + head + numbers + struct.pack("<II", bits, 0)
    length = 4 + 2 + len(body)
    return struct.pack("<IH", length, length - 4) + body
