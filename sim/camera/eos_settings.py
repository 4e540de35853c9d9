"""The simulated EOS's settings, as an initiator reaches them: Canon's own properties, and the standard's few.

Source: a recorded EOS 60D; ISO 15740:2013 for the standard's properties.
"""

from __future__ import annotations

from datetime import UTC, datetime

from drivers.canon.records import IMAGE_FORMAT_PROPERTIES, ImageFormat, PropertySetting, number_of
from drivers.ptp.codes import DataType, Property, ResponseCode
from drivers.ptp.datasets import DevicePropDesc, EnumerationForm, Value, decode_value, encode_value
from foundation.errors import ProtocolError
from sim.camera.eos_model import FREE, LIST
from sim.camera.eos_state import Arguments, OperationRefusal, OperationResult, PropertyState, SimulatedEosState

_FREELY_SET = (Property.EOS_OWNER, Property.EOS_ARTIST, Property.EOS_COPYRIGHT, Property.EOS_CAMERA_TIME)


class EosSettings(SimulatedEosState):
    """What an initiator can ask of a body's settings, and set."""

    def _set_device_prop_value_ex(self, arguments: Arguments) -> OperationResult:
        self._require_remote()
        try:
            setting = PropertySetting.decode(arguments.data or b"")
        except ProtocolError:
            raise OperationRefusal(ResponseCode.INVALID_DEVICE_PROP_FORMAT) from None
        known = self._properties.get(setting.code)
        if known is None:
            raise OperationRefusal(ResponseCode.DEVICE_PROP_NOT_SUPPORTED)
        # The recorded 60D answers 2019 to a value that its list does not hold, not 201c.
        if self._is_busy or not self._allows(setting, known):
            raise OperationRefusal(ResponseCode.DEVICE_BUSY)
        self._store(setting.code, setting.value)
        return OperationResult()

    def _allows(self, setting: PropertySetting, known: PropertyState) -> bool:
        try:
            if setting.code in IMAGE_FORMAT_PROPERTIES:
                return ImageFormat.decode(setting.value) in known.formats
            if known.kind == LIST:
                return number_of(setting.value) in known.choices
        except ProtocolError:
            raise OperationRefusal(ResponseCode.INVALID_DEVICE_PROP_FORMAT) from None
        return known.kind == FREE and setting.code in _FREELY_SET

    def _store(self, code: int, value: bytes) -> None:
        if code == Property.EOS_CAMERA_TIME:
            self._time_offset = datetime.fromtimestamp(number_of(value), UTC) - self._clock.now()
            self._report(code)
            return
        if code in (Property.EOS_IMAGE_FORMAT, Property.EOS_IMAGE_FORMAT_SD):
            self._change(Property.EOS_IMAGE_FORMAT, value)
            self._change(Property.EOS_IMAGE_FORMAT_SD, value)
            return
        if code == Property.EOS_MIRROR_UP_SETTING:
            self._mirror_lockup = bool(number_of(value))
        if code == Property.EOS_AEB:
            self._bracket_step = 0
        self._change(code, value)
        if code == Property.EOS_CAPTURE_DESTINATION:
            self._report(Property.EOS_AVAILABLE_SHOTS, Property.EOS_CURRENT_STORAGE, Property.EOS_CURRENT_FOLDER)

    def _request_device_prop_value(self, arguments: Arguments) -> OperationResult:
        if arguments.one not in self._properties:
            raise OperationRefusal(ResponseCode.GENERAL_ERROR)
        self._report(arguments.one)
        return OperationResult()

    def _description(self, code: int) -> DevicePropDesc:
        match code:
            case Property.BATTERY_LEVEL:
                percent = round(100 * self._battery)
                levels = EnumerationForm((100, 75, 50, 25, 0), widened=True)
                return DevicePropDesc(code, DataType.UINT8, False, percent, percent, levels)
            case Property.DEVICE_FRIENDLY_NAME:
                return DevicePropDesc(code, DataType.STRING, False, self.body.model, self.body.model)
            case Property.PERCEIVED_DEVICE_TYPE:
                return DevicePropDesc(code, DataType.UINT32, False, 1, 1)
            case Property.SESSION_INITIATOR:
                return DevicePropDesc(code, DataType.STRING, True, "Unknown Initiator", self._initiator)
            case Property.USE_DEVICE_STAGE:
                return DevicePropDesc(code, DataType.UINT8, False, 1, 1)
            case _:
                raise OperationRefusal(ResponseCode.DEVICE_PROP_NOT_SUPPORTED)

    def _get_device_prop_desc(self, arguments: Arguments) -> OperationResult:
        return OperationResult(self._description(arguments.one).encode())

    def _get_device_prop_value(self, arguments: Arguments) -> OperationResult:
        description = self._description(arguments.one)
        return OperationResult(encode_value(description.data_type, description.current))

    def _set_device_prop_value(self, arguments: Arguments) -> OperationResult:
        description = self._description(arguments.one)
        if not description.writable:
            raise OperationRefusal(ResponseCode.ACCESS_DENIED)
        try:
            value: Value = decode_value(description.data_type, arguments.data or b"")
        except ProtocolError:
            raise OperationRefusal(ResponseCode.INVALID_DEVICE_PROP_FORMAT) from None
        self._initiator = str(value)
        return OperationResult()
