"""What a session and its lab say of a table's origin, read once for a build, and the record that is made of it."""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC
from typing import Any

from pydantic import ValidationError

from calibration.citation.record import OriginRecord, Rig
from calibration.citation.serial_numbers import told_serials
from drivers.raw.rawfile import FrameOrigin
from experiment.config import CameraSettings, CitationSettings
from experiment.session.folder import Session
from experiment.session.records import FrameRecord
from foundation.errors import CropError, InputError

_SERIAL = ", serial number "
"""What stands before the number in a journal's name of the camera."""

_RIGS: tuple[Rig, ...] = ("lab", "simulated", "replay", "imported")

_SETTING_RIGS = ("lab", "simulated")
"""Rigs whose settings set the camera; of others they say nothing of the exposure."""


@dataclass(frozen=True)
class StatedOrigin:
    """What `session.toml` and the journal state beside the frames.

    - `citation`: what the lab states.
    - `rig`: what stood at the end of the cables; None where the settings do not say.
    - `camera`: the exposure as it was set; None where nothing set it, or it is not known.
    - `devices`: names in the journal: ``camera``, ``projector``, ``screen``, ``software``; those that are known.
    """

    citation: CitationSettings
    rig: Rig | None
    camera: CameraSettings | None
    devices: dict[str, str]


def stated_origin(session: Session) -> StatedOrigin:
    """Return what a session states; what older software did not write, or is damaged, is not known."""
    try:
        document: dict[str, Any] = tomllib.loads(session.settings_text())
        rig: Rig | None = next((known for known in _RIGS if known == document.get("rig")), None)
        citation = CitationSettings.model_validate(document.get("citation", {}))
        set_by = CameraSettings.model_validate(document["camera"]) if rig in _SETTING_RIGS else None
    except (CropError, ValidationError, ValueError, KeyError, RecursionError):
        return StatedOrigin(CitationSettings(), None, None, session.journal.records())
    return StatedOrigin(citation, rig, set_by, session.journal.records())


def with_changes(citation: CitationSettings, changes: dict[str, Any]) -> CitationSettings:
    """Return what the lab states with what was given on the command line in its place."""
    try:
        return CitationSettings.model_validate(citation.model_dump() | changes)
    except ValidationError as error:
        first = error.errors()[0]
        key = str(first["loc"][0]).replace("_", "-").removeprefix("camera-").replace("authors", "author")
        reason = str(first["msg"]).removeprefix("Value error, ")
        raise InputError(f"--{key} {first['input']!r}: {reason}") from error


def origin_record(stated: StatedOrigin, records: Sequence[FrameRecord], origins: Sequence[FrameOrigin]) -> OriginRecord:
    """Return what a table says of its origin."""
    citation, exposures = stated.citation, [origin for origin in origins if origin.exposure > 0]
    serial, told_as = _serial(stated, origins)
    moments = [record.taken_at.astimezone(UTC) for record in records]
    usual = _most([(one.iso, one.aperture, one.shutter_s) for one in exposures])
    by = None if usual is None and stated.camera is None else "settings" if usual is None else "raw files"
    if usual is None and stated.camera is not None:
        usual = stated.camera.iso, stated.camera.aperture, stated.camera.shutter_s
    iso, aperture, shutter_s = usual or (None, None, None)
    return OriginRecord(
        rig=stated.rig,
        camera_serial=serial,
        camera_serial_is=told_as,
        lens=_line(_most([one.lens for one in origins if one.lens]) or citation.lens),
        iso=iso or None,
        aperture=aperture or None,
        shutter_s=shutter_s or None,
        exposure_by=by,
        first_frame=min(moments).isoformat(timespec="seconds") if moments else None,
        last_frame=max(moments).isoformat(timespec="seconds") if moments else None,
        frames=len(records),
        projector=_line(citation.projector or stated.devices.get("projector", "")),
        screen=_line(stated.devices.get("screen", "")),
        taken_by=_line(stated.devices.get("software", "")),
        title=citation.title or None,
        authors=list(citation.authors),
        note=citation.note or None,
        licence=citation.licence or None,
        url=citation.url or None,
    )


def _serial(stated: StatedOrigin, origins: Sequence[FrameOrigin]) -> tuple[str | None, Any]:
    """Return the serial number of most frames as the lab tells it, and how; by the journal where files are silent."""
    camera, serial = _most([(one.camera, one.serial) for one in origins if one.serial]) or ("", "")
    if not serial:
        name, _, serial = stated.devices.get("camera", "").partition(_SERIAL)
        camera = _most([one.camera for one in origins if one.camera]) or name
    if not serial.strip():
        return None, "not stated"
    form = stated.citation.camera_serial
    if form == "withheld":
        return None, form
    return told_serials([FrameOrigin(camera, serial)], form)[camera, serial], form


def _most(values: Sequence[Any]) -> Any:
    """Return the value that comes most often, the first of equals; None of none."""
    return Counter(values).most_common(1)[0][0] if values else None


def _line(text: str) -> str | None:
    """Return a name as one line of bounded length; None where it is empty."""
    return " ".join(text.split())[:500] or None
