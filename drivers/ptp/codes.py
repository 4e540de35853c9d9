"""Codes of PTP and their names: those of the standard, and those of Canon for EOS bodies.

All known responses and event records have a name, because they appear in messages to users. Other codes have a name
only if we use them. Canon's codes are valid only for EOS bodies, because other makers use the same numbers differently.

Sources: ISO 15740:2013, tables of clauses 10 to 13. Canon's extensions have no public standard. Their numbers were
recorded from devices, and their names are from libgphoto2.
"""

from __future__ import annotations

from enum import IntEnum


class Operation(IntEnum):
    """Operations that a host requests; codes from 0x9000 are Canon's."""

    GET_DEVICE_INFO = 0x1001
    OPEN_SESSION = 0x1002
    CLOSE_SESSION = 0x1003
    GET_STORAGE_IDS = 0x1004
    GET_STORAGE_INFO = 0x1005
    GET_NUM_OBJECTS = 0x1006
    GET_OBJECT_HANDLES = 0x1007
    GET_OBJECT_INFO = 0x1008
    GET_OBJECT = 0x1009
    GET_THUMB = 0x100A
    DELETE_OBJECT = 0x100B
    SEND_OBJECT_INFO = 0x100C
    SEND_OBJECT = 0x100D
    GET_DEVICE_PROP_DESC = 0x1014
    GET_DEVICE_PROP_VALUE = 0x1015
    SET_DEVICE_PROP_VALUE = 0x1016
    GET_PARTIAL_OBJECT = 0x101B

    EOS_GET_STORAGE_IDS = 0x9101
    EOS_GET_STORAGE_INFO = 0x9102
    EOS_GET_OBJECT = 0x9104
    EOS_DELETE_OBJECT = 0x9105
    EOS_GET_PARTIAL_OBJECT = 0x9107
    EOS_GET_DEVICE_INFO_EX = 0x9108
    EOS_GET_OBJECT_INFO_EX = 0x9109
    EOS_REMOTE_RELEASE = 0x910F
    EOS_SET_DEVICE_PROP_VALUE_EX = 0x9110
    EOS_GET_REMOTE_MODE = 0x9113
    EOS_SET_REMOTE_MODE = 0x9114
    EOS_SET_EVENT_MODE = 0x9115
    EOS_GET_EVENT = 0x9116
    EOS_TRANSFER_COMPLETE = 0x9117
    EOS_CANCEL_TRANSFER = 0x9118
    EOS_RESET_TRANSFER = 0x9119
    EOS_PC_HDD_CAPACITY = 0x911A
    EOS_SET_UI_LOCK = 0x911B
    EOS_RESET_UI_LOCK = 0x911C
    EOS_KEEP_DEVICE_ON = 0x911D
    EOS_BULB_START = 0x9125
    EOS_REQUEST_DEVICE_PROP_VALUE = 0x9127
    EOS_REMOTE_RELEASE_ON = 0x9128
    EOS_REMOTE_RELEASE_OFF = 0x9129
    EOS_RESET_MIRROR_LOCKUP_STATE = 0x9130
    EOS_AF_CANCEL = 0x9160


class ResponseCode(IntEnum):
    """Results of operations; codes from 0xa000 are Canon's."""

    UNDEFINED = 0x2000
    OK = 0x2001
    GENERAL_ERROR = 0x2002
    SESSION_NOT_OPEN = 0x2003
    INVALID_TRANSACTION_ID = 0x2004
    OPERATION_NOT_SUPPORTED = 0x2005
    PARAMETER_NOT_SUPPORTED = 0x2006
    INCOMPLETE_TRANSFER = 0x2007
    INVALID_STORAGE_ID = 0x2008
    INVALID_OBJECT_HANDLE = 0x2009
    DEVICE_PROP_NOT_SUPPORTED = 0x200A
    INVALID_OBJECT_FORMAT_CODE = 0x200B
    STORE_FULL = 0x200C
    OBJECT_WRITE_PROTECTED = 0x200D
    STORE_READ_ONLY = 0x200E
    ACCESS_DENIED = 0x200F
    NO_THUMBNAIL_PRESENT = 0x2010
    SELF_TEST_FAILED = 0x2011
    PARTIAL_DELETION = 0x2012
    STORE_NOT_AVAILABLE = 0x2013
    SPECIFICATION_BY_FORMAT_UNSUPPORTED = 0x2014
    NO_VALID_OBJECT_INFO = 0x2015
    INVALID_CODE_FORMAT = 0x2016
    UNKNOWN_VENDOR_CODE = 0x2017
    CAPTURE_ALREADY_TERMINATED = 0x2018
    DEVICE_BUSY = 0x2019
    INVALID_PARENT_OBJECT = 0x201A
    INVALID_DEVICE_PROP_FORMAT = 0x201B
    INVALID_DEVICE_PROP_VALUE = 0x201C
    INVALID_PARAMETER = 0x201D
    SESSION_ALREADY_OPEN = 0x201E
    TRANSACTION_CANCELLED = 0x201F
    SPECIFICATION_OF_DESTINATION_UNSUPPORTED = 0x2020

    EOS_UNKNOWN_COMMAND = 0xA001
    EOS_OPERATION_REFUSED = 0xA005
    EOS_LENS_COVER_CLOSED = 0xA006
    EOS_LOW_BATTERY = 0xA101
    EOS_OBJECT_NOT_READY = 0xA102
    EOS_CANNOT_MAKE_OBJECT = 0xA104
    EOS_MEMORY_STATUS_NOT_READY = 0xA106


class EventCode(IntEnum):
    """Events that a device sends; codes from 0xc000 are Canon's."""

    UNDEFINED = 0x4000
    OBJECT_ADDED = 0x4002
    OBJECT_REMOVED = 0x4003
    STORE_ADDED = 0x4004
    STORE_REMOVED = 0x4005
    OBJECT_INFO_CHANGED = 0x4007
    REQUEST_OBJECT_TRANSFER = 0x4009

    EOS_REQUEST_GET_EVENT = 0xC101


class EosEvent(IntEnum):
    """Types of the records in a reply to Canon's GetEvent."""

    END = 0
    OBJECT_ADDED = 0xC181
    OBJECT_REMOVED = 0xC182
    REQUEST_GET_OBJECT_INFO = 0xC183
    STORAGE_STATUS_CHANGED = 0xC184
    STORAGE_INFO_CHANGED = 0xC185
    REQUEST_OBJECT_TRANSFER = 0xC186
    OBJECT_INFO_CHANGED = 0xC187
    OBJECT_CONTENT_CHANGED = 0xC188
    PROPERTY_CHANGED = 0xC189
    AVAILABLE_LIST_CHANGED = 0xC18A
    CAMERA_STATUS_CHANGED = 0xC18B
    WILL_SOON_SHUT_DOWN = 0xC18D
    SHUTDOWN_TIMER_UPDATED = 0xC18E
    REQUEST_CANCEL_TRANSFER = 0xC18F
    REQUEST_OBJECT_TRANSFER_DT = 0xC190
    REQUEST_CANCEL_TRANSFER_DT = 0xC191
    STORE_ADDED = 0xC192
    STORE_REMOVED = 0xC193
    BULB_EXPOSURE_TIME = 0xC194
    RECORDING_TIME = 0xC195
    AF_RESULT = 0xC1A3
    CTG_INFO_CHECK_COMPLETE = 0xC1A4
    OLC_INFO_CHANGED = 0xC1A5
    OBJECT_ADDED_64 = 0xC1A7
    OBJECT_INFO_CHANGED_64 = 0xC1A8
    REQUEST_OBJECT_TRANSFER_64 = 0xC1A9
    OBJECT_ADDED_64_LFN = 0xC1B6
    OBJECT_INFO_CHANGED_64_LFN = 0xC1B7
    REQUEST_OBJECT_TRANSFER_64_LFN = 0xC1B8


class ObjectFormat(IntEnum):
    """Formats of objects; codes from 0xb100 are Canon's."""

    UNDEFINED = 0x3000
    ASSOCIATION = 0x3001
    SCRIPT = 0x3002
    DPOF = 0x3006
    WAV = 0x3008
    AVI = 0x300A
    EXIF_JPEG = 0x3801
    JFIF = 0x3808
    CRW = 0xB101
    CR2 = 0xB103
    MOV = 0xB104
    MOV2 = 0xB105
    CR3 = 0xB108


class Property(IntEnum):
    """Settings and states of a device; names with EOS are Canon's."""

    BATTERY_LEVEL = 0x5001

    USE_DEVICE_STAGE = 0xD303
    DEVICE_FRIENDLY_NAME = 0xD402
    SESSION_INITIATOR = 0xD406
    PERCEIVED_DEVICE_TYPE = 0xD407

    EOS_APERTURE = 0xD101
    EOS_SHUTTER_SPEED = 0xD102
    EOS_ISO_SPEED = 0xD103
    EOS_EXPOSURE_COMPENSATION = 0xD104
    EOS_AE_MODE = 0xD105
    EOS_DRIVE_MODE = 0xD106
    EOS_METERING_MODE = 0xD107
    EOS_FOCUS_MODE = 0xD108
    EOS_WHITE_BALANCE = 0xD109
    EOS_COLOUR_TEMPERATURE = 0xD10A
    EOS_COLOUR_SPACE = 0xD10F
    EOS_PICTURE_STYLE = 0xD110
    EOS_BATTERY_POWER = 0xD111
    EOS_BATTERY_SELECT = 0xD112
    EOS_CAMERA_TIME = 0xD113
    EOS_AUTO_POWER_OFF = 0xD114
    EOS_OWNER = 0xD115
    EOS_MODEL_ID = 0xD116
    EOS_PTP_EXTENSION_VERSION = 0xD119
    EOS_AVAILABLE_SHOTS = 0xD11B
    EOS_CAPTURE_DESTINATION = 0xD11C
    EOS_BRACKET_MODE = 0xD11D
    EOS_CURRENT_STORAGE = 0xD11E
    EOS_CURRENT_FOLDER = 0xD11F
    EOS_IMAGE_FORMAT = 0xD120
    EOS_IMAGE_FORMAT_CF = 0xD121
    EOS_IMAGE_FORMAT_SD = 0xD122
    EOS_IMAGE_FORMAT_EXT_HD = 0xD123
    EOS_MIRROR_UP_SETTING = 0xD13A
    EOS_HDR_SETTING = 0xD13D
    EOS_CUSTOM_FUNCTIONS = 0xD1A0
    EOS_LENS_STATUS = 0xD1A8
    EOS_QUICK_REVIEW_TIME = 0xD1A9
    EOS_TEMPERATURE_STATUS = 0xD1AB
    EOS_SHUTTER_COUNTER = 0xD1AC
    EOS_SERIAL_NUMBER = 0xD1AF
    EOS_EVF_OUTPUT_DEVICE = 0xD1B0
    EOS_EVF_MODE = 0xD1B1
    EOS_MIRROR_DOWN_STATUS = 0xD1BD
    EOS_MIRROR_LOCKUP_STATE = 0xD1BF
    EOS_FLASH_CHARGING_STATE = 0xD1C0
    EOS_AUTO_LIGHTING_OPTIMIZER = 0xD1C1
    EOS_ARTIST = 0xD1D0
    EOS_COPYRIGHT = 0xD1D1
    EOS_FOCUS_INFO = 0xD1D3
    EOS_LENS_NAME = 0xD1D8
    EOS_AEB = 0xD1D9


class DataType(IntEnum):
    """Types of property values; an array has the code of its items plus 0x4000."""

    INT8 = 0x0001
    UINT8 = 0x0002
    INT16 = 0x0003
    UINT16 = 0x0004
    INT32 = 0x0005
    UINT32 = 0x0006
    INT64 = 0x0007
    UINT64 = 0x0008
    INT128 = 0x0009
    UINT128 = 0x000A
    STRING = 0xFFFF


class StorageType(IntEnum):
    """Kinds of storage in a device."""

    UNDEFINED = 0
    REMOVABLE_RAM = 4


class FilesystemType(IntEnum):
    """File systems of a storage."""

    UNDEFINED = 0
    DCF = 3


class AeMode(IntEnum):
    """Position of the mode dial of an EOS body (property 0xd105); read-only on bodies with a dial."""

    PROGRAM = 0
    SHUTTER_PRIORITY = 1
    APERTURE_PRIORITY = 2
    MANUAL = 3
    BULB = 4
    CUSTOM = 7
    FULL_AUTO = 9


class FocusMode(IntEnum):
    """Focus mode of an EOS body (property 0xd108)."""

    ONE_SHOT = 0
    AI_SERVO = 1
    AI_FOCUS = 2
    MANUAL = 3


class DriveMode(IntEnum):
    """Drive mode of an EOS body (property 0xd106)."""

    SINGLE = 0x00
    CONTINUOUS = 0x01
    CONTINUOUS_HIGH = 0x04
    CONTINUOUS_LOW = 0x05
    TIMER_CONTINUOUS = 0x07
    TIMER_10_S = 0x10
    TIMER_2_S = 0x11
    SINGLE_SILENT = 0x13
    CONTINUOUS_SILENT = 0x14


class WhiteBalance(IntEnum):
    """White balance of an EOS body (property 0xd109); it does not change the counts of raw files."""

    AUTO = 0x00
    DAYLIGHT = 0x01
    CLOUDY = 0x02
    TUNGSTEN = 0x03
    FLUORESCENT = 0x04
    FLASH = 0x05
    MANUAL = 0x06
    SHADE = 0x08
    KELVIN = 0x09
    AUTO_WHITE = 0x17


class CaptureDestination(IntEnum):
    """Destination of frames (property 0xd11c); a body lists those that it offers."""

    CARD = 2
    HOST = 4
    CARD_AND_HOST = 6


class CameraStatus(IntEnum):
    """Whether an EOS body accepts commands (record 0xc18b)."""

    IDLE = 0
    BUSY = 1


class ReleaseButton(IntEnum):
    """Position of the release button (RemoteReleaseOn and RemoteReleaseOff, first parameter)."""

    HALF = 1
    FULL = 2
    HALF_AND_FULL = 3


VENDOR_CANON_USB = 0x04A9  # Canon's USB vendor id
