"""What a settings file of `sim table` may say, everything with a default, and the table that it comes to.

One TOML file becomes frozen values at the door; unknown keys are errors.
"""

from __future__ import annotations

from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from pydantic import Field

from calibration.citation import OriginRecord
from calibration.sampling import WINDOW, WINDOWS
from experiment.chart.layout import design_chart
from experiment.config import CameraSettings, CitationSettings, Settings, validate_settings
from experiment.lights import plan_illuminations
from foundation.errors import ConfigurationError
from foundation.files import read_text
from foundation.records import from_settings, parse_toml
from sim.spectral import describe_sensitivities, read_sensitivities
from sim.world.sensors import find_body
from sim.world.world import Room
from synthesis.lamps import LightSpectra, illuminations_of
from synthesis.table import TableTask

# What a photographed room may have and a computed table has not: its frames know neither neighbours nor time.
NOT_COMPUTED: Final = (
    "blur_px", "fold_mm", "lamp_drift_per_hour", "shutter_jitter_s", "stain_depth", "stain_mm", "wheel_hz",
)  # fmt: skip


class ComputedExposure(CameraSettings):
    """The exposure of every frame, as `[camera]` of LAB.toml has it.

    Spectra are exposed each by itself (`synthesis.lamps.SpectralLamp`): of theirs only the ISO speed counts, and for
    hot photosites the time.
    """

    iso: Annotated[int, Field(ge=50, le=25600)] = 100
    """ISO speed."""


class ComputedChart(Settings):
    """The chart, as `acquire chart` designs it."""

    bits: Annotated[int, Field(ge=1, le=5)] = 5
    """Bits kept of each channel."""
    page: str | None = None
    """Paper: A0 … A8, or the smallest that fits."""
    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of the order of the colours."""


class TableSettings(Settings):
    """Everything that a settings file of `sim table` says."""

    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of everything that chance decides: the photosites' response, noise."""
    window: int = WINDOW
    """Half-size pixels along the side of a cell's window: 3, 5, 7 or 9."""
    camera: dict[str, Any] = Field(default_factory=dict[str, Any])
    """Facts of the body that differ; see `sim.world.sensors.find_body`."""
    exposure: ComputedExposure = ComputedExposure()
    room: dict[str, bool | int | float | str] = Field(default_factory=dict[str, bool | int | float | str])
    """Parameters of the room that differ; see `sim.world.world.Room`."""
    chart: ComputedChart = ComputedChart()
    citation: CitationSettings = CitationSettings()
    """Title, authors, licence, note and address, as `[citation]` of LAB.toml."""


def load_settings(path: Path | None) -> TableSettings:
    """Return what a settings file says; the defaults where none is given."""
    if path is None:
        return TableSettings()
    text = read_text(path, "name a TOML file", "settings")
    return parse_settings(parse_toml(text, str(path)), str(path))


def parse_settings(document: dict[str, Any], where: str) -> TableSettings:
    """Return the settings in a TOML document; `where` names it in errors."""
    settings = validate_settings(TableSettings, document, where)
    if settings.window not in WINDOWS:
        raise ConfigurationError(f"{where}: window = {settings.window}: {', '.join(map(str, WINDOWS))} expected")
    return settings


def room_of(settings: TableSettings, where: str) -> Room:
    """Return the default room with the seed and the changes of the settings; its lamp does not age."""
    unused = [key for key in settings.room if key in NOT_COMPUTED]
    if unused:
        raise ConfigurationError(
            f"{where}: room.{unused[0]} has no effect on a computed table, whose frames know neither neighbours nor "
            "time; leave it out, or photograph in the simulated lab with acquire run"
        )
    known = [field.name for field in fields(Room) if field.name not in ("seed", *NOT_COMPUTED)]
    return from_settings(Room, settings.room, where, "room", known, seed=settings.seed, lamp_drift_per_hour=0.0)


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
    exposure, origin = settings.exposure.exposure, origin_of(settings, where)
    return TableTask(chart, body, room, exposure, planned, powers, settings.window, record, origin)


def origin_of(settings: TableSettings, where: str) -> OriginRecord | None:
    """Return the citation of a computed table as `lut.json` records it; None if the settings have none."""
    stated = settings.citation
    devices = stated.model_fields_set & {"lens", "projector", "camera_serial"}
    if devices:
        raise ConfigurationError(
            f"{where}: citation.{min(devices)} has no effect on a computed table, for which no device was used; leave "
            "it out"
        )
    if stated == CitationSettings():
        return None
    return OriginRecord(
        title=stated.title or None,
        authors=list(stated.authors),
        note=stated.note or None,
        licence=stated.licence or None,
        url=stated.url or None,
    )
