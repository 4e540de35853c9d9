"""Open the rig that the settings name, and close it whatever happens.

`rig = "lab"` opens the devices that LAB.toml names, `rig = "simulated"` builds the simulated lab.
"""

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
    shows: bool = True,
) -> Generator[Devices]:
    """Open every device that the settings name; close them all at the end, whatever the end.

    `session`: the session that is taken up; None for a new one, and for a check, which records nothing. `shows`:
    whether the light is opened, which is black then; what a dry run asks it shows nothing.
    """
    if settings.rig == "imported":
        raise ConfigurationError(
            'rig = "imported" marks a session whose frames were taken by other means; nothing more can be taken of it'
        )
    with ExitStack() as opened:
        # The drivers of a real lab and the simulated world are each loaded where they are opened, and not otherwise.
        if settings.rig == "lab":
            from acquisition.run.rig.lab import open_lab

            yield open_lab(settings, session, opened, shows)
        else:
            from acquisition.run.rig.simulated import open_simulated

            yield open_simulated(settings, chart, session, opened)


def known_frame_bytes(settings: LabSettings) -> int | None:
    """Return the size of the raw files of a simulated rig, bytes; None where a real camera decides it."""
    if settings.rig != "simulated":
        return None
    from acquisition.run.rig.simulated import simulated_frame_bytes

    return simulated_frame_bytes(settings)
