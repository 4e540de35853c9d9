"""Who learns that a run lives: systemd, and a dead man's switch; their silence tells that it does not.

Signs come from the steps of the run itself, a frame, a try in a pause: a run that hangs gives none.
"""

from __future__ import annotations

import math
import os
import socket
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from typing import Final

from acquisition.run.notices import Notices
from foundation.clock import Clock

ALIVE_S: Final = 60.0
"""Between two signs to a dead man's switch: services of that kind count minutes."""

WATCHDOG_SHARE: Final = 0.25
"""Of the watchdog's time, between two signs at least: sd_watchdog_enabled(3) recommends half of it at most."""


class Life:
    """Gives signs of life of a run; close it at the end.

    `target`: the dead man's switch, a URL or a command; empty: none. `environment`: what a service manager has set.
    """

    def __init__(
        self,
        target: str,
        session: str,
        warn: Callable[[str], object],
        clock: Clock,
        environment: Mapping[str, str] = os.environ,
    ) -> None:
        self._notices = Notices(target, session, warn)
        self._clock = clock
        self._manager = environment.get("NOTIFY_SOCKET", "")
        self._watchdog_s = _watchdog_s(environment)
        self._told = self._fed = -math.inf

    def ready(self) -> None:
        """Tell that devices and session are open, and the run is at work."""
        self._to_manager("READY=1")
        self.sign("at work")

    def sign(self, doing: str) -> None:
        """Tell what the run does now, as often as is wanted."""
        now = self._clock.monotonic()
        if now - self._fed >= self._watchdog_s * WATCHDOG_SHARE:
            self._fed = now
            self._to_manager(f"WATCHDOG=1\nSTATUS={' '.join(doing.split())}")
        if now - self._told >= ALIVE_S:
            self._told = now
            self._notices.tell("alive", doing, datetime.now(UTC))
        self._notices.say_failures()

    def end(self, how: str, sentence: str) -> None:
        """Tell how the run ended; nothing follows."""
        self._to_manager(f"STOPPING=1\nSTATUS={how}: {' '.join(sentence.split())}")
        self._notices.tell(how, sentence, datetime.now(UTC))

    def close(self) -> None:
        """Let what was told be delivered."""
        self._notices.close()

    def _to_manager(self, text: str) -> None:
        """Send a datagram as sd_notify(3) describes; a manager that does not take it hurts nobody."""
        if self._manager[:1] in ("/", "@"):
            address = self._manager.replace("@", "\0", 1) if self._manager.startswith("@") else self._manager
            with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as link:
                link.setblocking(False)
                link.sendto(text.encode(), address)


def _watchdog_s(environment: Mapping[str, str]) -> float:
    """Return after how many seconds of silence this process is ended; 0 where nobody does."""
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return 0.0
    try:
        return int(environment.get("WATCHDOG_USEC", "0")) / 1e6
    except ValueError:
        return 0.0
