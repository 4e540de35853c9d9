"""Settings of `sim table` from a TOML file, and the task that they describe.

All settings have defaults; unknown keys are errors.
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
from experiment.config import CameraSettings, CitationSettings, Settings, file_in, validate_settings
from experiment.lights import plan_illuminants
from foundation.errors import ConfigurationError
from foundation.files import read_text
from foundation.records import from_settings, parse_toml
from sim.spectral import describe_sensitivities, matrix_record, read_sensitivities
from sim.world.sensors import find_body
from sim.world.world import Room
from synthesis.lamps import LightSpectra, table_illuminants
from synthesis.table import TableTask

# Parameters of the simulated room that have no effect on a computed LUT: patches have no neighbours, no time passes,
# and the print has no faults.
UNUSED_ROOM_FIELDS: Final = (
    "blur_px", "fold_mm", "lamp_drift_per_hour", "shutter_jitter_s", "stain_depth", "stain_mm", "wheel_hz",
)  # fmt: skip


class ComputedExposure(CameraSettings):
    """Exposure of all frames, as in `[camera]` of LAB.toml.

    With spectra, the exposure of each frame is computed (`synthesis.lamps.SpectralLamp`). Then only the ISO speed and,
    for hot photosites, the exposure time are used.
    """

    iso: Annotated[int, Field(ge=50, le=25600)] = 100
    """ISO speed."""


class ComputedChart(Settings):
    """Chart, as designed by `acquire chart`."""

    bits: Annotated[int, Field(ge=1, le=5)] = 5
    """Bits per channel."""
    page: str | None = None
    """Paper size A0 to A8; by default the smallest possible."""
    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of the order of the colours."""


class TableSettings(Settings):
    """Settings file of `sim table`."""

    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of all random values: response of the photosites, noise."""
    window: int = WINDOW
    """Side of the window of a patch, in half-size pixels: 3, 5, 7 or 9."""
    camera: dict[str, Any] = Field(default_factory=dict[str, Any])
    """Changed properties of the camera; see `sim.world.sensors.find_body`."""
    exposure: ComputedExposure = ComputedExposure()
    room: dict[str, bool | int | float | str] = Field(default_factory=dict[str, bool | int | float | str])
    """Changed parameters of the default room; see `sim.world.world.Room`."""
    chart: ComputedChart = ComputedChart()
    citation: CitationSettings = CitationSettings()
    """Title, authors, licence, note and address, as in `[citation]` of LAB.toml."""


def load_settings(path: Path | None) -> TableSettings:
    """Return the settings of a file; the defaults if `path` is None."""
    if path is None:
        return TableSettings()
    text = read_text(path, "give a TOML file", "settings")
    settings = parse_settings(parse_toml(text, str(path)), str(path))
    if isinstance(sensitivities := settings.camera.get("sensitivities"), str):
        camera = {**settings.camera, "sensitivities": file_in(path.resolve().parent, sensitivities)}
        return settings.model_copy(update={"camera": camera})
    return settings


def parse_settings(document: dict[str, Any], where: str) -> TableSettings:
    """Return the settings of a TOML document; messages name it `where`."""
    settings = validate_settings(TableSettings, document, where)
    if settings.window not in WINDOWS:
        raise ConfigurationError(f"{where}: window = {settings.window}, expected one of {', '.join(map(str, WINDOWS))}")
    return settings


def table_room(settings: TableSettings, where: str) -> Room:
    """Return the default room with the seed and the changes of the settings, without lamp drift."""
    unused = [key for key in settings.room if key in UNUSED_ROOM_FIELDS]
    if unused:
        raise ConfigurationError(
            f"{where}: room.{unused[0]} has no effect on a computed LUT, which has no neighbouring patches and no "
            "time; omit it, or take a session in the simulated laboratory with acquire run"
        )
    names = [field.name for field in fields(Room) if field.name not in ("seed", *UNUSED_ROOM_FIELDS)]
    return from_settings(Room, settings.room, where, "room", names, seed=settings.seed, lamp_drift_per_hour=0.0)


def table_task(camera: str, settings: TableSettings, where: str, lights: LightSpectra | None = None) -> TableTask:
    """Return the task of computing a LUT, from the values of the command line and the settings.

    Parameters
    ----------
    camera
        Name of a simulated camera or of sensitivities, or a file of sensitivities.
    settings, where
        Settings, and the name of their file for messages.
    lights
        Spectra of the illuminants; None for the 707 illuminants of the simulated projector.
    """
    body = find_body(camera, settings.camera, where)
    room = table_room(settings, where)
    chart = design_chart(settings.chart.bits, settings.chart.page, settings.chart.seed)
    curves = read_sensitivities(body.sensitivities)
    record: dict[str, Any] = {
        "by": "sim table",
        "how": "no frame was taken: counts of the photosites of each patch were computed from spectra and a model of "
        "the sensor, and sampled like the counts of a frame",
        "sensitivities": describe_sensitivities(curves),
        "matrix": matrix_record(curves),
        "lights": {"from": "simulated projector"} if lights is None else lights.source,
        # Records the name of the sensitivities, because the path of their file is no property of the LUT.
        "body": asdict(replace(body, sensitivities=curves.name)),
        "exposure": settings.exposure.model_dump(mode="json"),
        "room": {name: value for name, value in asdict(room).items() if name not in (*UNUSED_ROOM_FIELDS, "seed")},
        "chart": settings.chart.model_dump(mode="json"),
        "window": settings.window,
        "seed": settings.seed,
    }
    illuminations = plan_illuminants() if lights is None else table_illuminants(lights.lights)
    powers = None if lights is None else np.array([light.power for light in lights.lights])
    record["lights"] |= {"count": len(illuminations)}
    exposure, origin = settings.exposure.exposure, citation_record(settings, where)
    return TableTask(chart, body, room, exposure, illuminations, powers, settings.window, record, origin)


def citation_record(settings: TableSettings, where: str) -> OriginRecord | None:
    """Return the citation for `lut.json`; None if the settings have no citation."""
    citation = settings.citation
    devices = citation.model_fields_set & {"lens", "projector", "camera_serial"}
    if devices:
        raise ConfigurationError(
            f"{where}: citation.{min(devices)} has no effect on a computed LUT, because no device was used; omit it"
        )
    if citation == CitationSettings():
        return None
    return OriginRecord(
        title=citation.title or None,
        authors=list(citation.authors),
        note=citation.note or None,
        licence=citation.licence or None,
        url=citation.url or None,
    )
