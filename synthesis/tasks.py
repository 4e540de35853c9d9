"""From what the user names to a table that can be computed: camera, lights, chart, and the record of them all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from calibration.citation import OriginRecord, with_changes
from experiment.chart.layout import design_chart
from experiment.config import CitationSettings
from experiment.lights.illuminations import plan_illuminations
from sim.spectral.sensitivities import describe_sensitivities, read_sensitivities
from sim.world.body_settings import find_body
from synthesis.light_spectra import LightSpectra, illuminations_of
from synthesis.settings import NOT_COMPUTED, TableSettings, room_of
from synthesis.table import TableTask


def table_task(camera: str, settings: TableSettings, where: str, lights: LightSpectra | None = None) -> TableTask:
    """Return the table of a camera under lights.

    `lights`: spectra; None for the 707 lights of the simulated projector.
    """
    body = find_body(camera, settings.camera, where)
    room = room_of(settings, where)
    chart = design_chart(settings.chart.bits, settings.chart.page, settings.chart.seed)
    seen = read_sensitivities(body.sensitivities)
    record: dict[str, Any] = {
        "by": "sim table",
        "how": "no frame was taken: counts of the photosites under each cell were computed from spectra and a model of "
        "the sensor, and sampled as those of a frame",
        "sensitivities": describe_sensitivities(seen),
        "lights": {"from": "simulated projector"} if lights is None else lights.source,
        # By name: where a file of sensitivities lies is no property of the table.
        "body": asdict(replace(body, sensitivities=seen.name)),
        "exposure": settings.exposure.model_dump(mode="json"),
        "room": {name: value for name, value in asdict(room).items() if name not in (*NOT_COMPUTED, "seed")},
        "chart": settings.chart.model_dump(mode="json"),
        "window": settings.window,
        "seed": settings.seed,
    }
    planned = plan_illuminations() if lights is None else illuminations_of(lights.lights)
    powers = None if lights is None else np.array([light.power for light in lights.lights])
    record["lights"] |= {"count": len(planned)}
    return TableTask(chart, body, room, settings.exposed, planned, powers, settings.window, record)


def stated_by_hand(note: str | None, licence: str | None, authors: Sequence[str]) -> OriginRecord | None:
    """Return what is said of a computed table by whoever computes it; None where nothing is.

    `licence`: an SPDX expression (SPDX specification 2.3, annex D).
    """
    given = {"note": note, "licence": licence, "authors": tuple(authors) or None}
    stated = with_changes(CitationSettings(), {name: value for name, value in given.items() if value is not None})
    if stated == CitationSettings():
        return None
    return OriginRecord(authors=list(stated.authors), note=stated.note or None, licence=stated.licence or None)
