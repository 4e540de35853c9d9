"""A Canon EOS body as the suite's `Camera`: one raw frame after another, for hours, without a human.

Rules that hold inside:

- A connection that fails is renewed, a limited number of times and for a limited time in one call (`CanonLimits`):
  reset, closed, opened again wherever the body is now, and given the settings again. `drivers.canon.body` is one
  connection. Then the call fails, with its first cause: longer patience is the caller's, who can say what is awaited.
- A release is never repeated once it may have happened: after a fault the frame is looked for in the camera's memory,
  and what is not found there is an error. So no frame is ever taken for another one's.
- What waits in the memory before a release belongs to nobody any more, and is thrown away.
- The exposed frame stays in the memory until it has been downloaded whole, or the next is exposed: a cable that fails
  and a file that cannot be written cost a download, not a frame. Once downloaded, the memory is emptied.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from typing import BinaryIO, TypeVar

from drivers.camera import CameraIdentity, CapturedFrame, ExposureSettings, Supplies
from drivers.canon.body import EosBody, WaitingObject, plan, shutter_speeds
from drivers.ptp.codes import ObjectFormat, ResponseCode
from drivers.ptp.session import PASSING, OperationDeclined, Transport
from foundation.clock import Clock, SystemClock
from foundation.errors import DeviceError, DeviceRefused, LinkClosed, LinkError, LinkTimeout, ProtocolError

REDISCOVERY_S = 10.0
"""The same on a new connection, on which the body sends its whole state at once."""

_SYSTEM_CLOCK = SystemClock()
_CERTAIN_SHARE = 0.9
"""Share of the nominal shutter time that passes at least: 1/6 s is really 0.149 s."""
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 5.0
"""Pauses between attempts to find the camera again, doubled from one to the other: soon for a cable put back, seldom
enough that a body which starts is left alone."""
_STUCK = (
    *PASSING,
    ResponseCode.UNDEFINED,
    ResponseCode.GENERAL_ERROR,
    ResponseCode.SESSION_NOT_OPEN,
    ResponseCode.INVALID_TRANSACTION_ID,
    ResponseCode.INCOMPLETE_TRANSFER,
    ResponseCode.TRANSACTION_CANCELLED,
)
"""Responses that a new session may cure."""
_SUFFIXES: dict[int, str] = {ObjectFormat.CRW: ".CRW", ObjectFormat.CR2: ".CR2", ObjectFormat.CR3: ".CR3"}
_REMEDY = (
    "check the cable and the battery, switch the camera off and on, and end other programs that use it (photo "
    "importers of the desktop do so by themselves); then run again"
)

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class CanonLimits:
    """How long one call to a body may go on against trouble before it fails; chosen, not measured.

    - `recoveries`: how often a call renews the connection: a fault that comes back more often lasts.
    - `recovery_s`: seconds after the first fault of a call in which the connection may be renewed; a body that was
      switched off and on, or put back on its cable, is there within 10 s.
    - `frame_s`: seconds after its exposure within which a frame may be announced, beside as much time again as it was
      exposed: so long a dark frame takes that some bodies subtract.
    """

    recoveries: int = 3
    recovery_s: float = 30.0
    frame_s: float = 30.0


_LIMITS = CanonLimits()


@dataclass
class _Shot:
    """A release that has happened, or may have.

    `announced` is its frame once the body has named it, `fetched` what a download has begun with; objects that are
    `absent` cannot be its frame.
    """

    body: EosBody
    released_at: datetime
    not_before: float
    until: float
    shutter_s: float
    announced: WaitingObject | None = None
    fetched: WaitingObject | None = None
    absent: set[int] = field(default_factory=set[int])


class CanonEos:
    """A `drivers.camera.Camera` over PTP, whatever the cable."""

    def __init__(
        self, open_transport: Callable[[], Transport], clock: Clock = _SYSTEM_CLOCK, limits: CanonLimits = _LIMITS
    ) -> None:
        self._open_transport = open_transport
        self._clock = clock
        self._limits = limits
        self._fault: DeviceError | None = None
        self._renewable_until = math.inf
        self._transport: Transport | None = None
        self._body: EosBody | None = None
        self._identity: CameraIdentity | None = None
        self._settings: ExposureSettings | None = None
        self._shot: _Shot | None = None
        self._closed = False

    def identity(self) -> CameraIdentity:
        """Return maker, model, serial number and firmware."""
        self._begin()
        return self._carry_out(EosBody.identity)

    def supplies(self) -> Supplies:
        """Return what is left of battery and card; see `drivers.camera.ReportsSupplies`."""
        self._begin()
        return self._carry_out(EosBody.supplies)

    def configure(self, settings: ExposureSettings) -> None:
        """Set and verify the exposure, raw format and destination; a frame that was not downloaded is dropped."""

        def configured(body: EosBody) -> None:
            body.make_ready()
            _apply(body, settings)

        self._begin()
        self._settings = self._shot = None
        self._carry_out(configured)
        self._settings = settings

    def shutter_speeds(self) -> tuple[float, ...]:
        """Return the shutter times that the body offers now, as engraved, seconds, rising; empty if it lists none."""

        def listed(body: EosBody) -> tuple[float, ...]:
            body.drain()
            return shutter_speeds(body.state)

        self._begin()
        return self._carry_out(listed)

    def expose(self) -> datetime:
        """Release the shutter without autofocus; return when it was released, UTC, once the body announces the frame.

        A frame that was exposed before and has not been downloaded is dropped.
        """
        settings = self._settings
        if settings is None:
            raise DeviceRefused("the camera has no exposure settings; configure it before the first exposure")
        self._begin()
        self._shot = None
        shot = self._release(settings)
        try:
            self._carry_out(lambda body: self._await_frame(body, shot))
        except Exception:
            self._empty()
            raise
        self._shot = shot
        return shot.released_at

    def download(self, into: BinaryIO) -> CapturedFrame:
        """Write the raw file of the frame exposed last, whole and unchanged, to `into`.

        A download that failed, for whatever reason, may be tried again with a new stream as long as the body holds the
        frame in its memory: until the next exposure, or until it is switched off.
        """
        shot = self._shot
        if shot is None:
            raise DeviceError("no exposed frame waits in the camera to be downloaded; expose it again")
        self._begin()
        start = into.tell()
        frame = self._carry_out(lambda body: self._receive(body, shot, into, start))
        self._shot = None
        self._empty()
        return CapturedFrame(_file_name(frame), frame.size, shot.released_at)

    def idle(self) -> None:
        """Fetch what has happened while nothing was asked, and keep the body awake; call it now and then in a pause."""
        self._begin()
        self._carry_out(EosBody.drain)

    def close(self) -> None:
        """Give the camera back to its user; a second call does nothing."""
        self._closed = True
        self._shot = None
        body = self._body
        if body is not None:
            try:
                body.disconnect()
            except DeviceError as error:
                self._drop(error)
            else:
                self._drop(None)

    def _begin(self) -> None:
        """Begin a call: it has had no fault yet."""
        self._fault, self._renewable_until = None, math.inf

    def _carry_out(self, action: Callable[[EosBody], _Result]) -> _Result:
        """Return what `action` does with a connected body, over a new connection if this one fails."""
        renewals = 0
        was_busy = False
        while True:
            body = self._connected()
            try:
                return action(body)
            except DeviceError as error:
                if not _curable(error):
                    raise
                self._lose(error)
                # A body that is busy in every session is kept so by its own settings, not by a fault.
                busy = isinstance(error, OperationDeclined) and error.code == ResponseCode.DEVICE_BUSY
                late = self._clock.monotonic() >= self._renewable_until
                if renewals == self._limits.recoveries or late or (busy and was_busy):
                    kind = DeviceRefused if busy else DeviceError
                    times = "once" if renewals == 1 else f"{renewals} times"
                    raise kind(self._given_up(error, f"the connection was renewed {times} without success")) from error
                was_busy = busy
                renewals += 1

    def _lose(self, fault: DeviceError) -> None:
        """Drop a connection that failed at its work, and keep the first such fault of a call.

        What ails a new connection before it is made follows from the old one's end, and is no first cause.
        """
        if self._fault is None:
            self._fault = fault
            self._renewable_until = self._clock.monotonic() + self._limits.recovery_s
        self._drop(fault)

    def _given_up(self, last: DeviceError, tried: str) -> str:
        """Return why a call ends, its first cause first, for whatever came of that says less."""
        first = self._fault or last
        at_last = "" if str(first) == str(last) else f"; at last: {last}"
        return f"{first}; {tried}{at_last}; {_REMEDY}"

    def _release(self, settings: ExposureSettings) -> _Shot:
        """Return the release that has happened, or may have; one that the body declines has not."""

        def released(body: EosBody) -> _Shot:
            body.make_ready()
            _apply(body, settings)  # sends nothing unless a dial was turned
            now = self._clock.monotonic()
            exposed = now + _CERTAIN_SHARE * settings.shutter_s
            until = now + 2 * settings.shutter_s + self._limits.frame_s
            shot = _Shot(body, self._clock.now(), exposed, until, settings.shutter_s, absent=set(body.state.waiting))
            try:
                body.release()
            except (LinkError, ProtocolError) as error:
                self._lose(error)
            return shot

        return self._carry_out(released)

    def _await_frame(self, body: EosBody, shot: _Shot) -> WaitingObject:
        """Return the frame of a release when the body has announced it; the same one whenever it is asked again."""
        renewed = body is not shot.body
        until = self._clock.monotonic() + shot.shutter_s + REDISCOVERY_S if renewed else shot.until
        known = shot.announced

        def wanted(waiting: WaitingObject) -> bool:
            if known is not None and (waiting.name, waiting.size) != (known.name, known.size):
                return False  # taken since, by a finger on the camera
            return waiting.is_raw and waiting.handle not in shot.absent

        try:
            shot.announced = body.await_object(shot.not_before, until, wanted)
        except LinkTimeout as error:
            if not renewed:
                raise  # its announcement may be lost: a new connection hears it again
            self._shot = None
            raise DeviceError(f"{error}, and holds none in its memory; take it again") from error
        return shot.announced

    def _receive(self, body: EosBody, shot: _Shot, into: BinaryIO, start: int) -> WaitingObject:
        """Return the frame of a release when it is complete in `into`, from `start` on."""
        while True:
            frame = self._await_frame(body, shot)
            # What has come of the same object before a fault is good: pieces are written whole.
            offset = into.tell() - start if frame == shot.fetched else 0
            into.seek(start + offset)
            into.truncate()
            shot.fetched = frame
            try:
                body.fetch(frame, into, offset)
            except OperationDeclined as error:
                if error.code != ResponseCode.INVALID_OBJECT_HANDLE:
                    raise
                shot.absent.add(frame.handle)
                shot.announced = None
                body.free(frame)
                continue
            return frame

    def _empty(self) -> None:
        """Let the body forget what waits; where that fails the next call sees to it over a new connection."""
        if self._body is not None:
            try:
                self._body.free_waiting()
                self._body.drain()
                self._body.free_waiting()
            except DeviceError as error:
                self._drop(error)

    def _connected(self) -> EosBody:
        """Return the connected body, after a fault on a new connection and with its settings."""
        if self._closed:
            raise DeviceError("the camera has been closed; open the rig again")
        if self._body is not None:
            return self._body
        first = self._identity is None
        begun = self._clock.monotonic()
        end = min(self._renewable_until, begun + self._limits.recovery_s)
        pause = _FIRST_PAUSE_S
        while True:
            try:
                return self._connect()
            except DeviceError as error:
                # While it comes back a body may be absent, or in the hands of the desktop.
                curable = not first if self._transport is None else _curable(error)
                self._drop(error)
                if not curable:
                    raise
                if self._clock.monotonic() + pause > end:
                    waited = f"no connection for {self._clock.monotonic() - begun:.0f} s"
                    raise DeviceError(self._given_up(error, waited)) from error
            self._clock.sleep(pause)
            pause = min(2 * pause, _LONGEST_PAUSE_S)

    def _connect(self) -> EosBody:
        self._transport = self._open_transport()
        body = EosBody(self._transport, self._clock)
        body.connect()
        found, known = body.identity(), self._identity
        if known is not None and (found.model, found.serial) != (known.model, known.serial):
            raise DeviceRefused(
                f"in place of the {known.model} with serial number {known.serial} there is now a {found.model} with "
                f"{found.serial}; connect the first one again"
            )
        if self._settings is not None:
            _apply(body, self._settings)
        self._identity = found
        self._body = body
        return body

    def _drop(self, fault: DeviceError | None) -> None:
        """Close the cable, with a reset where the body may still be in the midst of something."""
        transport, self._transport, self._body = self._transport, None, None
        if transport is not None:
            if fault is not None and not isinstance(fault, LinkClosed):
                with contextlib.suppress(DeviceError):
                    transport.reset()
            transport.close()


def _apply(body: EosBody, settings: ExposureSettings) -> None:
    for code, value in plan(body.state, settings).items():
        body.set(code, value)


def _curable(error: DeviceError) -> bool:
    """Return whether a new connection may help."""
    return isinstance(error, LinkError | ProtocolError) or (
        isinstance(error, OperationDeclined) and error.code in _STUCK
    )


def _file_name(frame: WaitingObject) -> str:
    """Return the camera's name for a file, with nothing in it that a file name cannot hold, and a suffix."""
    name = re.sub(r"[^A-Za-z0-9._-]", "_", frame.name).strip(".") or f"{frame.handle:08X}"
    # Some bodies announce a file without its name, or without the suffix, but with its format.
    return name if "." in name else name + _SUFFIXES.get(frame.format, "")
