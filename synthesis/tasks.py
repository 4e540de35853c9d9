"""From what the user names to a table that can be computed: camera, lights, chart, and the record of them all."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from acquisition.chart.layout import design_chart
from acquisition.lights.illuminations import plan_illuminations
from sim.world.body_settings import find_body
from sim.world.sensitivities import describe_sensitivities, read_sensitivities
from synthesis.settings import NOT_COMPUTED, TableSettings, room_of
from synthesis.table import TableTask


def table_task(camera: str, settings: TableSettings, where: str) -> TableTask:
    """Return the table of a camera under the 707 lights of the simulated projector.

    Parameters
    ----------
    camera
        As `sim.world.body_settings.find_body` takes it.
    settings
        The rest.
    where
        What the settings were read from, for messages.

    Raises
    ------
    InputError, FormatError
        The camera is unknown, or its file cannot be used.
    ConfigurationError
        A setting cannot be used.
    """
    body = find_body(camera, settings.camera, where)
    room = room_of(settings, where)
    chart = design_chart(settings.chart.bits, settings.chart.page, settings.chart.seed)
    record: dict[str, Any] = {
        "by": "sim table",
        "how": "no frame was taken: counts of the photosites under each cell were computed from spectra and a model of "
        "the sensor, and sampled as those of a frame",
        "sensitivities": describe_sensitivities(read_sensitivities(body.sensitivities)),
        "lights": {"from": "simulated projector", "count": 0},
        "body": asdict(body),
        "exposure": settings.exposure.model_dump(mode="json"),
        "room": {name: value for name, value in asdict(room).items() if name not in (*NOT_COMPUTED, "seed")},
        "chart": settings.chart.model_dump(mode="json"),
        "window": settings.window,
        "seed": settings.seed,
    }
    lights = plan_illuminations()
    record["lights"]["count"] = len(lights)
    return TableTask(chart, body, room, settings.exposed, lights, settings.window, record)
