"""Collect the origin of a LUT (camera, lens, exposure, dates, projector, authors, licence), and write its citation.

The published serial number of a camera would link a LUT to all photographs of its owner. Readers only need to see
whether two LUTs are from one camera body, so a hash of the number is published. Serial numbers are short and could be
guessed. The hash is therefore scrypt (RFC 7914), which makes each guess slow. A lab can also withhold the number.

A citation is a BibTeX entry of type `misc` (O. Patashnik, BibTeXing, 1988, section 3.1). Unknown values are omitted
from the entry and listed in a comment.
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC
from functools import lru_cache
from typing import Annotated, Any, Final, Literal

from pydantic import Field

from drivers.raw.rawfile import FrameOrigin
from experiment.config import CameraSettings, CitationSettings
from experiment.session.records import FrameRecord
from foundation.records import Record

# Form of the published serial number (`experiment.config.CitationSettings.camera_serial`).
SerialForm = Literal["hash", "plain", "withheld"]

# Parameters N, r and p of scrypt for interactive use (RFC 7914, section 2). Other values would give other hashes, so
# that older LUTs of a body could not be recognised.
_COST, _BLOCK, _PARALLEL = 1 << 14, 8, 1

_HASH_BYTES = 16  # Length of the hash: 128 bits never coincide by chance

NOT_RECORDED: Final = "not recorded"  # Text for an unknown value

# Kind of laboratory of the session; see `experiment.config.LabSettings`.
Rig = Literal["lab", "simulated", "imported"]

Line = Annotated[str, Field(max_length=500)]
Text = Annotated[str, Field(max_length=20_000)]

_SERIAL_SEPARATOR = ", serial number "  # Between the name and the number of the camera in a journal

# Digits of the LUT's hash in the key of its BibTeX entry, enough to distinguish the LUTs of a lab.
KEY_DIGITS: Final = 8

# Special characters of TeX (D. Knuth, The TeXbook, chapter 7), and their replacements.
_TEX_REPLACEMENTS: Final = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    **{sign: f"\\{sign}" for sign in "&%$#_"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
}


@lru_cache(maxsize=64)
def serial_hash(camera: str, serial: str) -> str:
    """Return the hash of a body's serial number, 32 hexadecimal digits: scrypt with the camera's name as salt."""
    salt = f"crop camera serial {camera}".encode()
    return hashlib.scrypt(serial.encode(), salt=salt, n=_COST, r=_BLOCK, p=_PARALLEL, dklen=_HASH_BYTES).hex()


def published_serials(origins: Sequence[FrameOrigin], form: SerialForm) -> Mapping[tuple[str, str], str]:
    """Return the published form of each body's serial number, by camera and number.

    Withheld numbers are replaced by a counter, so that bodies stay distinct.
    """
    bodies = list(dict.fromkeys((origin.camera, origin.serial) for origin in origins if origin.serial))
    if form == "plain":
        return {body: body[1] for body in bodies}
    if form == "hash":
        return {body: serial_hash(*body) for body in bodies}
    return {body: f"withheld ({number})" for number, body in enumerate(bodies, 1)}


def with_published_serials(origins: Sequence[FrameOrigin], form: SerialForm) -> list[FrameOrigin]:
    """Return origins with serial numbers in the form chosen by the lab; equal numbers stay equal."""
    published = published_serials(origins, form)
    return [replace(item, serial=published[item.camera, item.serial]) if item.serial else item for item in origins]


class OriginRecord(Record):
    """Equipment, time and authors of the frames of a LUT."""

    rig: Rig | None = None  # None if the session does not record it
    camera_serial: Line | None = None  # Serial number of the body, or its hash, according to `camera_serial_is`
    # Form of `camera_serial`: hash (`serial_hash`), plain, withheld by the lab, or missing in the raw files
    camera_serial_is: Literal["hash", "plain", "withheld", "not stated"] = "not stated"
    lens: Line | None = None  # From the raw files, else from the lab
    iso: int | None = Field(default=None, ge=1)  # ISO speed of most frames
    aperture: float | None = Field(default=None, gt=0, allow_inf_nan=False)  # f-number of most frames
    shutter_s: float | None = Field(default=None, gt=0, allow_inf_nan=False)  # Exposure time of most frames, s
    # Source of the exposure; settings only if the raw files lack it
    exposure_by: Literal["raw files", "settings"] | None = None
    first_frame: Line | None = None  # Time of the first frame, ISO 8601, UTC
    last_frame: Line | None = None  # Time of the last frame, ISO 8601, UTC
    frames: int = Field(default=0, ge=0)
    projector: Line | None = None  # From the lab, else from the projector's control port
    screen: Line | None = None  # Display that shows the colours, as the session names it
    taken_by: Line | None = None  # Software that took the session; `Provenance.software` built the LUT
    title: Line | None = None
    authors: list[Line] = Field(default_factory=list[Line])
    note: Text | None = None
    licence: Line | None = None  # SPDX expression (SPDX specification 2.3, annex D)
    url: Line | None = None

    @property
    def year(self) -> str | None:
        """The year of the last frame, if known."""
        return None if self.last_frame is None else self.last_frame[:4]


def exposure_text(origin: OriginRecord | None) -> str:
    """Return the exposure as text, ``0.5 s, f/8, ISO 100``, with its source, or `NOT_RECORDED`."""
    if origin is None:
        return NOT_RECORDED
    values = [
        f"{origin.shutter_s:g} s" if origin.shutter_s is not None else "",
        f"f/{origin.aperture:g}" if origin.aperture is not None else "",
        f"ISO {origin.iso}" if origin.iso is not None else "",
    ]
    exposure = ", ".join(value for value in values if value)
    return f"{exposure} (by the {origin.exposure_by})" if exposure else NOT_RECORDED


def dates_text(origin: OriginRecord | None) -> str:
    """Return first and last date, or `NOT_RECORDED`."""
    if origin is None or origin.first_frame is None or origin.last_frame is None:
        return NOT_RECORDED
    return f"{origin.first_frame} to {origin.last_frame}"


def serial_text(origin: OriginRecord | None) -> str:
    """Return the body's serial number, its hash, or the reason if it is missing."""
    if origin is None:
        return NOT_RECORDED
    if origin.camera_serial is None:
        return "withheld by the lab" if origin.camera_serial_is == "withheld" else "not recorded by the raw files"
    return f"{origin.camera_serial} (hash)" if origin.camera_serial_is == "hash" else origin.camera_serial


def origin_lines(origin: OriginRecord | None) -> list[tuple[str, str]]:
    """Return the rows of a table of the origin: names and values; unknown values are `NOT_RECORDED`."""
    record = origin or OriginRecord()
    rows: list[tuple[str, str | None]] = [
        ("Taken in", _rig_text(record.rig)),
        ("Serial number", serial_text(origin)),
        ("Lens", record.lens),
        ("Exposure", exposure_text(origin)),
        ("Dates", dates_text(origin)),
        ("Projector", record.projector),
        ("Screen", record.screen),
        ("Taken by", record.taken_by),
        ("Title", record.title),
        ("Authors", "; ".join(record.authors) or None),
        ("Licence", record.licence),
        ("Address", record.url),
        ("Note", record.note),
    ]
    return [(name, " ".join((value or NOT_RECORDED).split())) for name, value in rows]


def _rig_text(rig: Rig | None) -> str | None:
    words = {
        "lab": "a laboratory",
        "simulated": "the simulated laboratory: nothing was photographed",
        "imported": "a laboratory; its frames were imported",
    }
    return None if rig is None else words[rig]


@dataclass(frozen=True)
class SessionOrigin:
    """Origin of a session, as recorded in `session.toml` and the journal."""

    citation: CitationSettings
    rig: Rig | None  # None if the settings do not record it
    camera: CameraSettings | None  # Exposure settings; None if unknown
    devices: dict[str, str]  # Names in the journal of camera, projector, screen and software, if known


def origin_record(lab: SessionOrigin, records: Sequence[FrameRecord], origins: Sequence[FrameOrigin]) -> OriginRecord:
    """Return the origin of a LUT."""
    citation, exposures = lab.citation, [origin for origin in origins if origin.exposure > 0]
    serial, serial_form = _serial(lab, origins)
    moments = [record.taken_at.astimezone(UTC) for record in records]
    exposure = _most_frequent([(origin.iso, origin.aperture, origin.shutter_s) for origin in exposures])
    source = None if exposure is None and lab.camera is None else "settings" if exposure is None else "raw files"
    if exposure is None and lab.camera is not None:
        settings = lab.camera.exposure
        exposure = settings.iso, settings.aperture, settings.shutter_s
    iso, aperture, shutter_s = exposure or (None, None, None)
    return OriginRecord(
        rig=lab.rig,
        camera_serial=serial,
        camera_serial_is=serial_form,
        lens=_line(_most_frequent([origin.lens for origin in origins if origin.lens]) or citation.lens),
        iso=iso or None,
        aperture=aperture or None,
        shutter_s=shutter_s or None,
        exposure_by=source,
        first_frame=min(moments).isoformat(timespec="seconds") if moments else None,
        last_frame=max(moments).isoformat(timespec="seconds") if moments else None,
        frames=len(records),
        projector=_line(citation.projector or lab.devices.get("projector", "")),
        screen=_line(lab.devices.get("screen", "")),
        taken_by=_line(lab.devices.get("software", "")),
        title=citation.title or None,
        authors=list(citation.authors),
        note=citation.note or None,
        licence=citation.licence or None,
        url=citation.url or None,
    )


def _serial(lab: SessionOrigin, origins: Sequence[FrameOrigin]) -> tuple[str | None, Any]:
    """Return the serial number of most frames as it is published, and its form.

    If the raw files contain no number, it is taken from the journal.
    """
    camera, serial = _most_frequent([(origin.camera, origin.serial) for origin in origins if origin.serial]) or ("", "")
    if not serial:
        name, _, serial = lab.devices.get("camera", "").partition(_SERIAL_SEPARATOR)
        camera = _most_frequent([origin.camera for origin in origins if origin.camera]) or name
    if not serial.strip():
        return None, "not stated"
    form = lab.citation.camera_serial
    if form == "withheld":
        return None, form
    return published_serials([FrameOrigin(camera, serial)], form)[camera, serial], form


def _most_frequent(values: Sequence[Any]) -> Any:
    return Counter(values).most_common(1)[0][0] if values else None


def _line(text: str) -> str | None:
    return " ".join(text.split())[:500] or None


def table_title(camera: str, lights: int | None, origin: OriginRecord | None, computed: bool = False) -> str:
    """Return the title that the lab gave to the LUT, or a title from its camera and illuminants."""
    if origin is not None and origin.title:
        return origin.title
    description = "Computed look-up table" if computed else "Look-up table"
    return f"{description} of the {camera}" + ("" if lights is None else f" under {lights} illuminants")


def bibtex(
    camera: str, lights: int | None, software: str, sha256: str, origin: OriginRecord | None, computed: bool = False
) -> str:
    """Return a BibTeX entry of a LUT. `origin`: None if the LUT has no record of it."""
    record = origin or OriginRecord()
    year = record.year
    family = record.authors[0].partition(",")[0] if record.authors else "crop"
    key = "-".join(word for word in (_slug(family), _slug(camera), year or "", sha256[:KEY_DIGITS]) if word)
    method = "computed" if computed else "simulated" if record.rig == "simulated" else "photographed"
    fields = {
        "author": " and ".join(_bibtex_name(author) for author in record.authors),
        "title": f"{{{tex_text(table_title(camera, lights, origin, computed))}}}",
        "year": year or "",
        "howpublished": tex_text(f"Look-up table, {method}; made with {software}"),
        "note": tex_text(f"SHA-256 {sha256}" + (f"; licence {record.licence}" if record.licence else "")),
        "url": re.sub(r"[{}\\\s]", "", record.url or ""),
    }
    missing = [name for name in ("author", "year", "url") if not fields[name]]
    if not record.licence:
        missing.append("licence")
    body = "".join(f"  {name} = {{{value}}},\n" for name, value in fields.items() if value)
    comment = f"% {NOT_RECORDED} in the LUT: {', '.join(missing)}\n" if missing else ""
    return f"{comment}@misc{{{key},\n{body}}}\n"


def tex_text(text: str) -> str:
    """Return a text that TeX prints unchanged."""
    return "".join(_TEX_REPLACEMENTS.get(character, character) for character in " ".join(text.split()))


def _bibtex_name(author: str) -> str:
    """Return a name for BibTeX: "Family, Given" unchanged, a name without a comma in braces."""
    text = tex_text(author)
    return text if "," in author else f"{{{text}}}"


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "", text.casefold())[:40]
