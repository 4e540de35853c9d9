"""Open the devices of the settings (`rig = "lab"` or `rig = "simulated"`), and close them in any case."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import ExitStack, contextmanager

from acquisition.run.devices import Devices
from experiment.chart.model import Chart
from experiment.config import LabSettings
from experiment.session.folder import Session
from foundation.errors import ConfigurationError


@contextmanager
def open_rig(
    settings: LabSettings,
    chart: Chart,
    session: Session | None = None,
    *,
    opens_display: bool = True,
) -> Generator[Devices]:
    """Open every device of the settings; close all devices at the end.

    `session`: the resumed session; None for a new session or a check. `opens_display`: whether to open the display,
    which then shows black; false in a dry run.
    """
    if settings.rig == "imported":
        raise ConfigurationError(
            'rig is "imported", expected "lab" or "simulated": frames were taken by other means; start a new session'
        )
    with ExitStack() as opened:
        # Drivers and the simulated laboratory are imported only if they are needed.
        if settings.rig == "lab":
            from acquisition.run.rig.lab import open_lab

            yield open_lab(settings, session, opened, opens_display)
        else:
            from acquisition.run.rig.simulated import open_simulated

            yield open_simulated(settings, chart, session, opened)


def known_frame_bytes(settings: LabSettings) -> int | None:
    """Return the size of simulated raw files, bytes; None for a real camera."""
    if settings.rig != "simulated":
        return None
    from acquisition.run.rig.simulated import simulated_frame_bytes

    return simulated_frame_bytes(settings)
