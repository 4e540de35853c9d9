"""How a run leaves the lab: the screen black, the lamp's fate decided and said, whatever ended it.

====================  =====================================  =========================================
what ended the run    the lamp                               because
====================  =====================================  =========================================
all frames are there  goes out (`sequence.switch_off`)       its hours are counted
it ended by itself    goes out                               nobody may be there till the morning; the
                      (`sequence.lamp_if_unfinished`)        next run warms it up again
somebody ended it     is left as it is                       somebody is there, and may go on at once
====================  =====================================  =========================================
"""

from __future__ import annotations

from contextlib import suppress
from enum import Enum
from typing import Final

from acquisition.run.devices import Devices
from acquisition.run.patience import Report
from drivers.presenter import BLACK
from drivers.projector import Power, Projector
from experiment.config import SequenceSettings
from foundation.clock import Clock
from foundation.errors import CropError, DeviceError

OBEYS_S: Final = 5.0
"""How long a projector may take to begin to switch off, after it has said that it will; they answer before they do."""
LOOK_S: Final = 0.5
"""Between two questions whether it has begun."""

TRIES: Final = 3
"""Tries at putting the lamp out: an answer that is lost once must not let it burn till the morning."""
AGAIN_S: Final = 2.0
"""Between two of them; a controller that was busy answers then."""

_BY_HAND: Final = "switch it off by hand"


class RunEnd(Enum):
    """What ended a run."""

    COMPLETE = "complete"
    UNFINISHED = "unfinished"
    INTERRUPTED = "interrupted"


def end_of(error: BaseException) -> RunEnd:
    """Return what ended a run that raised `error`: somebody, by Ctrl-C or a signal, or the run itself."""
    return RunEnd.INTERRUPTED if isinstance(error, KeyboardInterrupt) else RunEnd.UNFINISHED


def leave_lab(devices: Devices, end: RunEnd, sequence: SequenceSettings, report: Report) -> None:
    """Make the screen black, and let the lamp go out or burn on; what cannot be done is said, and raises nothing."""
    try:
        devices.presenter.show(BLACK)
    except DeviceError as error:
        _say(report, "screen", f"it could not be made black: {error}")
    _say(report, "lamp", lamp_fate(devices.projector, end, sequence, devices.clock))


def lamp_fate(projector: Projector | None, end: RunEnd, sequence: SequenceSettings, clock: Clock) -> str:
    """Let the lamp go out or burn on, and return in a sentence what it does now."""
    if projector is None:
        return f"the projector is not under control: {_BY_HAND}"
    if end is RunEnd.INTERRUPTED:
        # Somebody waits for the end: a projector that does not answer would hold it up.
        return f"it is left as it is, so that the next run needs no warm-up; else {_BY_HAND}"
    goes_out = sequence.switch_off if end is RunEnd.COMPLETE else sequence.lamp_if_unfinished == "off"
    for _ in range(TRIES - 1):
        with suppress(DeviceError):
            return _decided(projector, goes_out, clock)
        clock.sleep(AGAIN_S)
    try:
        return _decided(projector, goes_out, clock)
    except DeviceError as error:
        undone = "whether it burns is not known" if not goes_out else "it could not be switched off"
        return f"{undone}: {error}; {_BY_HAND}"


def _decided(projector: Projector, goes_out: bool, clock: Clock) -> str:
    power = projector.power()
    if power is not Power.ON and power is not Power.WARMING:
        return f"it is out already: the projector is in {power.value}"
    if not goes_out:
        return f"it burns on, so that the next run needs no warm-up; else {_BY_HAND}"
    projector.switch_off()
    until = clock.monotonic() + OBEYS_S
    while (power := projector.power()) is Power.ON and clock.monotonic() < until:
        clock.sleep(LOOK_S)
    if power is Power.ON:
        return f"it burns on though the projector was told to switch it off; {_BY_HAND}"
    return "it was switched off"


def _say(report: Report, what: str, sentence: str) -> None:
    # The run has its end already, and that counts: a full disk, for one.
    with suppress(CropError):
        report(what, sentence)
