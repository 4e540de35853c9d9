"""What a table says of its own origin: camera, lens, exposure, dates, projector, authors, licence, in `lut.json`.

A frozen value for those who cite a table and those who make data sets of it; nothing here reads a session.
What is not known is None and is said to be so (`NOT_RECORDED`): tables made before this was kept have none of it.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field

NOT_RECORDED: Final = "not recorded"
"""What stands where a table does not say something."""

Rig = Literal["lab", "simulated", "replay", "imported"]
"""What stood at the end of the cables; see `experiment.config.LabSettings`."""

Line = Annotated[str, Field(max_length=500)]
Text = Annotated[str, Field(max_length=20_000)]


class OriginRecord(BaseModel):
    """With what, when and by whom the frames of a table were taken.

    - `rig`: ``lab``, ``simulated``, ``replay`` or ``imported``; None where the session does not say.
    - `camera_serial`: serial number of the body, or its hash, as `camera_serial_is` says.
    - `camera_serial_is`: ``hash`` (`calibration.citation.serial_numbers.serial_hash`), ``plain``, ``withheld`` by the
      lab's choice, or ``not stated`` by the raw files.
    - `lens`: model of the lens as the raw files state it, or the lab where they do not.
    - `iso`, `aperture`, `shutter_s`: ISO speed, f-number and exposure time in seconds of most frames.
    - `exposure_by`: who states the exposure: the ``raw files``, or the session's ``settings`` where these are silent.
    - `first_frame`, `last_frame`: when the first and the last frame of the table were released, ISO 8601, UTC.
    - `frames`: how many frames the table was made from.
    - `projector`: maker and model as its control port names it, or as the lab does where it has none.
    - `screen`: what showed the colours, as the session names it.
    - `taken_by`: name and version of the software that took the session; `Provenance.software` is what built the table.
    - `title`, `authors`, `note`, `licence`, `url`: as the lab states them; the licence is an SPDX expression (SPDX
      specification 2.3, annex D).
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    rig: Rig | None = None
    camera_serial: Line | None = None
    camera_serial_is: Literal["hash", "plain", "withheld", "not stated"] = "not stated"
    lens: Line | None = None
    iso: int | None = Field(default=None, ge=1)
    aperture: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    shutter_s: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    exposure_by: Literal["raw files", "settings"] | None = None
    first_frame: Line | None = None
    last_frame: Line | None = None
    frames: int = Field(default=0, ge=0)
    projector: Line | None = None
    screen: Line | None = None
    taken_by: Line | None = None
    title: Line | None = None
    authors: list[Line] = []
    note: Text | None = None
    licence: Line | None = None
    url: Line | None = None

    @property
    def year(self) -> str | None:
        """The year of the last frame; None where no date is known."""
        return None if self.last_frame is None else self.last_frame[:4]


def exposure_text(origin: OriginRecord | None) -> str:
    """Return the exposure in words, ``0.5 s, f/8, ISO 100``, and who states it, or `NOT_RECORDED`."""
    if origin is None:
        return NOT_RECORDED
    parts = [
        f"{origin.shutter_s:g} s" if origin.shutter_s is not None else "",
        f"f/{origin.aperture:g}" if origin.aperture is not None else "",
        f"ISO {origin.iso}" if origin.iso is not None else "",
    ]
    known = ", ".join(part for part in parts if part)
    return f"{known} (by the {origin.exposure_by})" if known else NOT_RECORDED


def dates_text(origin: OriginRecord | None) -> str:
    """Return first and last date in words; `NOT_RECORDED` where they are not known."""
    if origin is None or origin.first_frame is None or origin.last_frame is None:
        return NOT_RECORDED
    return f"{origin.first_frame} to {origin.last_frame}"


def serial_text(origin: OriginRecord | None) -> str:
    """Return the body's serial number, its hash, or why there is none, in words."""
    if origin is None:
        return NOT_RECORDED
    if origin.camera_serial is None:
        return "withheld by the lab" if origin.camera_serial_is == "withheld" else "not stated by the raw files"
    return f"{origin.camera_serial} (hash)" if origin.camera_serial_is == "hash" else origin.camera_serial


def origin_lines(origin: OriginRecord | None) -> list[tuple[str, str]]:
    """Return what a table says of its origin: names and values, for people; what is not known is said to be so."""
    known = origin or OriginRecord()
    rows: list[tuple[str, str | None]] = [
        ("Taken in", _rig_text(known.rig)),
        ("Camera's serial", serial_text(origin)),
        ("Lens", known.lens),
        ("Exposure", exposure_text(origin)),
        ("Dates", dates_text(origin)),
        ("Projector", known.projector),
        ("Screen", known.screen),
        ("Taken by", known.taken_by),
        ("Title", known.title),
        ("Authors", "; ".join(known.authors) or None),
        ("Licence", known.licence),
        ("Address", known.url),
        ("Note", known.note),
    ]
    return [(name, " ".join((value or NOT_RECORDED).split())) for name, value in rows]


def _rig_text(rig: Rig | None) -> str | None:
    """Return in words what stood at the end of the cables."""
    words = {
        "lab": "a laboratory",
        "simulated": "the simulated laboratory: nothing was photographed",
        "replay": "a recorded session, served again",
        "imported": "a laboratory; its frames were imported",
    }
    return None if rig is None else words[rig]
