"""The simulated EOS's release: focus, the press, drive modes and brackets, and the frame until it is a file.

The rules stand in `sim.camera.eos`.
"""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import Enum
from io import BytesIO

from drivers.camera import ExposureSettings
from drivers.canon import apex
from drivers.canon.records import ImageFormat, Notice, ObjectEvent
from drivers.ptp.codes import (
    AeMode,
    CameraStatus,
    CaptureDestination,
    DriveMode,
    EosEvent,
    FocusMode,
    ObjectFormat,
    Property,
    ReleaseButton,
    ResponseCode,
)
from foundation.errors import CropError, DeviceError, DeviceRefused
from sim.camera.eos_files import EosFiles
from sim.camera.eos_model import FOCUS_CENTRE, focus_points
from sim.camera.eos_state import BULB, CARD, FOLDER, Arguments, OperationRefusal, OperationResult, StoredObject

_TIMERS_S: dict[int, float] = {
    DriveMode.TIMER_10_S: 10.0,
    DriveMode.TIMER_2_S: 2.0,
    DriveMode.TIMER_CONTINUOUS: 10.0,
}
_CONTINUOUS = (
    DriveMode.CONTINUOUS,
    DriveMode.CONTINUOUS_HIGH,
    DriveMode.CONTINUOUS_LOW,
    DriveMode.CONTINUOUS_SILENT,
)
_AUTO_ISO = 400
"""ISO speed where the body may choose (assumed; there is no meter)."""
_METERED_S = 1 / 60
"""Shutter time where the body may choose (assumed; there is no meter)."""
_METERED_APERTURE = 5.6
"""Aperture where the body may choose (assumed; there is no meter)."""
_FORMATS_BY_SUFFIX = {".crw": ObjectFormat.CRW, ".cr3": ObjectFormat.CR3}
_JPEG_SIZE = (160, 240)
"""Height and width, px: enough for the file's name, and next to nothing to encode."""


class _Refusal(Enum):
    """Why a full press takes no picture: the response to RemoteReleaseOn, and the result of RemoteRelease."""

    BUSY = (ResponseCode.DEVICE_BUSY, 0x2019)
    NO_FOCUS = (ResponseCode.DEVICE_BUSY, 1)
    MIRROR_LOCKUP = (ResponseCode.DEVICE_BUSY, 3)
    MEMORY_FULL = (ResponseCode.DEVICE_BUSY, 7)
    STORE_FULL = (ResponseCode.STORE_FULL, 7)
    BATTERY_EMPTY = (ResponseCode.EOS_LOW_BATTERY, ResponseCode.EOS_LOW_BATTERY)
    EXPOSURE = (ResponseCode.GENERAL_ERROR, ResponseCode.GENERAL_ERROR)

    def __init__(self, response: int, result: int) -> None:
        self.response = response
        self.result = result


@dataclass(frozen=True)
class _Frame:
    """A picture under way: what the film makes of it (None where it failed) and where it goes."""

    number: int
    taken_at: datetime
    raw: Future[bytes | None]
    formats: ImageFormat
    destination: int


class EosRelease(EosFiles):
    """What a finger on the release does, at the camera or far away."""

    def _remote_release_on(self, arguments: Arguments) -> OperationResult:
        self._require_remote()
        if not 1 <= arguments.one <= ReleaseButton.HALF_AND_FULL:
            raise OperationRefusal(ResponseCode.INVALID_PARAMETER)
        if self._is_busy:
            raise OperationRefusal(ResponseCode.DEVICE_BUSY)
        automatic = arguments.two == 0
        if arguments.one & ReleaseButton.HALF and automatic:
            self._focus()
        if arguments.one & ReleaseButton.FULL:
            refusal = self._full_press(automatic)
            if refusal is not None:
                raise OperationRefusal(refusal.response)
        return OperationResult()

    def _remote_release_off(self, arguments: Arguments) -> OperationResult:
        self._require_remote()
        if not 1 <= arguments.one <= ReleaseButton.HALF_AND_FULL:
            raise OperationRefusal(ResponseCode.INVALID_PARAMETER)
        self._let_go(arguments.one)
        return OperationResult()

    def _remote_release(self, _: Arguments) -> OperationResult:
        self._require_remote()
        self._focus()
        refusal = self._full_press(automatic=True)
        self._let_go(ReleaseButton.HALF_AND_FULL)
        return OperationResult(parameters=(0 if refusal is None else refusal.result,))

    @property
    def _has_autofocus(self) -> bool:
        return self._number_of(Property.EOS_FOCUS_MODE) != FocusMode.MANUAL

    def _focus(self) -> None:
        if self._has_autofocus:
            self._focused = self._finds_focus
            self._change(Property.EOS_FOCUS_INFO, focus_points((FOCUS_CENTRE,) if self._focused else ()))

    def _cancel_focus(self, _: Arguments) -> OperationResult:
        self._focused = False
        return OperationResult()

    def _full_press(self, automatic: bool) -> _Refusal | None:
        settings = self._settings()
        refusal = self._refusal(automatic, settings)
        if refusal is not None:
            return refusal
        now = self._clock.monotonic()
        self._pressed_at = now
        drive = self._number_of(Property.EOS_DRIVE_MODE)
        bracketing = self._number_of(Property.EOS_AEB)
        if self._number_of(Property.EOS_SHUTTER_SPEED) == BULB:
            self._bulb_since = now, self._clock.now()
            self._record(Notice(EosEvent.CAMERA_STATUS_CHANGED, CameraStatus.BUSY))
            return None
        # A bracket comes whole, except in single drive, where each press takes one of its three.
        whole = bracketing and (drive in _CONTINUOUS or drive in _TIMERS_S)
        opens_at = now + _TIMERS_S.get(drive, 0.0)
        for _ in range(3 if whole else 1):
            opens_at = self._plan(opens_at, self._bracketed(settings, bracketing))
        self._move()
        return None

    def _refusal(self, automatic: bool, settings: ExposureSettings) -> _Refusal | None:
        destination = self._number_of(Property.EOS_CAPTURE_DESTINATION)
        if self._is_busy:
            return _Refusal.BUSY
        if self._battery <= 0:
            return _Refusal.BATTERY_EMPTY
        if self._mirror_lockup:
            return _Refusal.MIRROR_LOCKUP
        if automatic and self._has_autofocus and not self._focused:
            return _Refusal.NO_FOCUS
        if destination & CaptureDestination.HOST and self._frames_waiting() >= self.body.burst:
            return _Refusal.MEMORY_FULL
        if not self._available_shots():
            return _Refusal.STORE_FULL
        if self._number_of(Property.EOS_SHUTTER_SPEED) != BULB:
            try:
                self._film.accept(settings)
            except DeviceRefused:
                return _Refusal.EXPOSURE
        return None

    def _let_go(self, button: int) -> None:
        if button & ReleaseButton.HALF:
            self._focused = False
        if not button & ReleaseButton.FULL or self._pressed_at is None:
            return
        now = self._clock.monotonic()
        if self._bulb_since is not None:
            since, opened = self._bulb_since
            self._bulb_since = None
            settings = self._settings()
            held = ExposureSettings(settings.iso, settings.aperture, max(now - since, 1e-3))
            self._expose(held, opened, now)
        elif self._number_of(Property.EOS_DRIVE_MODE) in _CONTINUOUS and not self._number_of(Property.EOS_AEB):
            self._continue_series(now)
        self._pressed_at = None
        self._move()

    def _continue_series(self, now: float) -> None:
        """Take the further frames of continuous drive that the time of the press was good for."""
        assert self._pressed_at is not None
        settings = self._settings()
        pace = max(1 / self.body.frames_per_s, settings.shutter_s)
        room = min(self.body.burst - self._frames_waiting(), self._available_shots()) - 1
        for number in range(1, min(int((now - self._pressed_at) / pace), room) + 1):
            self._plan(self._pressed_at + number * pace, settings)

    def _settings(self) -> ExposureSettings:
        """Return the exposure that is set, in nominal values; where the body would measure, what it is assumed to."""
        iso = self._number_of(Property.EOS_ISO_SPEED)
        aperture = self._number_of(Property.EOS_APERTURE)
        shutter = self._number_of(Property.EOS_SHUTTER_SPEED)
        mode = self._number_of(Property.EOS_AE_MODE)
        return ExposureSettings(
            round(apex.ISO.value(iso)) if iso else _AUTO_ISO,
            apex.APERTURE.value(aperture)
            if aperture and mode in (AeMode.MANUAL, AeMode.APERTURE_PRIORITY, AeMode.BULB)
            else _METERED_APERTURE,
            apex.SHUTTER.value(shutter)
            if shutter and shutter != BULB and mode in (AeMode.MANUAL, AeMode.SHUTTER_PRIORITY)
            else _METERED_S,
        )

    def _bracketed(self, settings: ExposureSettings, bracketing: int) -> ExposureSettings:
        """Return the next of a bracket's three exposures: as set, under, over."""
        if not bracketing:
            return settings
        stops = (0, -bracketing, bracketing)[self._bracket_step] / 8
        self._bracket_step = (self._bracket_step + 1) % 3
        return ExposureSettings(settings.iso, settings.aperture, settings.shutter_s * 2**stops)

    # The shutter.

    def _plan(self, opens_at: float, settings: ExposureSettings) -> float:
        """Open the shutter at a time; return when it can open again."""
        self._unfinished += 1
        if self._unfinished == 1:
            self._record(Notice(EosEvent.CAMERA_STATUS_CHANGED, CameraStatus.BUSY))

        def open_shutter() -> None:
            late = timedelta(seconds=self._clock.monotonic() - opens_at)
            self._unfinished -= 1
            self._expose(settings, self._clock.now() - late, opens_at + settings.shutter_s)

        self._at(opens_at, open_shutter)
        return opens_at + max(settings.shutter_s, 1 / self.body.frames_per_s)

    def _expose(self, settings: ExposureSettings, opened: datetime, closes_at: float) -> None:
        self._unfinished += 1
        self._shutter_count += 1
        self._battery = max(self._battery - 1 / self.body.shots_per_charge, 0.0)
        self._number = self._number % 9999 + 1
        frame = _Frame(
            self._number,
            opened + self._time_offset,
            self._develop(settings, opened),
            ImageFormat.decode(self._properties[Property.EOS_IMAGE_FORMAT].value),
            self._number_of(Property.EOS_CAPTURE_DESTINATION),
        )
        self._at(closes_at + self.body.write_s, lambda: self._written(frame))

    def _develop(self, settings: ExposureSettings, opened: datetime) -> Future[bytes | None]:
        def develop() -> bytes | None:
            into = BytesIO()
            try:
                self._film.accept(settings)
                self._film.expose(settings, opened, into)
            except (DeviceError, CropError):
                # A film that has no such picture is a camera whose frame never comes.
                return None
            return into.getvalue()

        if self._executor is not None:
            return self._executor.submit(develop)
        done: Future[bytes | None] = Future()
        done.set_result(develop())
        return done

    def _written(self, frame: _Frame) -> None:
        """Announce a frame's files; where the film takes longer than the body would, look again soon."""
        if not frame.raw.done():
            self._at(self._clock.monotonic() + 0.01, lambda: self._written(frame))
            return
        raw = frame.raw.result()
        self._unfinished -= 1
        if raw is not None:
            suffix = self._film.suffix.lower()
            for index, file in enumerate(frame.formats.files):
                name = f"IMG_{frame.number:04d}"
                if file.is_raw:
                    kind = _FORMATS_BY_SUFFIX.get(suffix, ObjectFormat.CR2)
                    self._deliver(frame, index, f"{name}{suffix.upper()}", kind, raw)
                else:
                    self._deliver(frame, index, f"{name}.JPG", ObjectFormat.EXIF_JPEG, _small_jpeg(name))
        self._report(Property.EOS_AVAILABLE_SHOTS, Property.EOS_SHUTTER_COUNTER, Property.EOS_BATTERY_POWER)
        if not self._is_busy:
            self._record(Notice(EosEvent.CAMERA_STATUS_CHANGED, CameraStatus.IDLE))
        self._idle_since = self._clock.monotonic()

    def _deliver(self, frame: _Frame, index: int, name: str, kind: int, data: bytes) -> None:
        wide = self.body.wide_objects
        if frame.destination != CaptureDestination.HOST and self._card is not None:
            handle = FOLDER | frame.number << 4 | index + 1
            item = StoredObject(handle, CARD, kind, name, frame.taken_at, FOLDER, data)
            self._card.objects[handle] = item
            self._record(ObjectEvent(EosEvent.OBJECT_ADDED_64 if wide else EosEvent.OBJECT_ADDED, item.entry))
            self._record(Notice(EosEvent.STORAGE_INFO_CHANGED, CARD))
        if frame.destination & CaptureDestination.HOST:
            handle = next(self._handles)
            self._memory[handle] = StoredObject(handle, 0, kind, name, frame.taken_at, data=data)
            self._host_bytes = max(self._host_bytes - len(data), 0)
            self._offer_transfer(self._memory[handle])


def _small_jpeg(name: str) -> bytes:
    """Return a JPEG file of a grey picture with its own name on it: what stands in for a rendered frame."""
    import cv2
    import numpy as np

    picture = np.full((*_JPEG_SIZE, 3), 118, dtype=np.uint8)
    picture = cv2.putText(picture, name, (20, 90), cv2.FONT_HERSHEY_SIMPLEX, 1.0, (255, 255, 255))
    return cv2.imencode(".jpg", picture)[1].tobytes()
