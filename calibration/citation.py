"""What a table says of its own origin: camera, lens, exposure, dates, projector, authors, licence; and how it is cited.

Every photograph of a body names its serial number, so that a published one ties a table to all other pictures of its
owner; yet readers want to know whether two tables are of one body. A hash tells that alone. Serial numbers are short,
and a plain hash of ten digits is undone in seconds by trying all, so it is scrypt (RFC 7914): all numbers of ten digits
take a core twelve years and more. A lab that wants no trace withholds the number.

A citation is a BibTeX entry of type `misc`, which all styles of BibTeX know (O. Patashnik, BibTeXing, 1988, section
3.1). What the table does not say is left out of the entry and named in a comment, never invented.
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

# How the serial number of a body is published (`experiment.config.CitationSettings.camera_serial`).
SerialForm = Literal["hash", "plain", "withheld"]

# scrypt's N, r and p as RFC 7914, section 2, has them for interactive use: 16 MiB, some 40 ms. Changing one changes
# all hashes, so that bodies are not recognised any longer.
_COST, _BLOCK, _PARALLEL = 1 << 14, 8, 1

_BYTES = 16  # Of the hash: 128 bits never meet by chance

NOT_RECORDED: Final = "not recorded"  # What stands where a table does not say something

# What stood at the end of the cables; see `experiment.config.LabSettings`.
Rig = Literal["lab", "simulated", "imported"]

Line = Annotated[str, Field(max_length=500)]
Text = Annotated[str, Field(max_length=20_000)]

_SERIAL = ", serial number "  # What stands before the number in a journal's name of the camera

# Digits of the table's hash in the key of its entry: two tables of one lab never share them by chance.
KEY_DIGITS: Final = 8

# Characters that TeX reads as commands (D. Knuth, The TeXbook, chapter 7), and how they are printed.
_SPECIAL: Final = {
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
    return hashlib.scrypt(serial.encode(), salt=salt, n=_COST, r=_BLOCK, p=_PARALLEL, dklen=_BYTES).hex()


def published_serials(origins: Sequence[FrameOrigin], form: SerialForm) -> Mapping[tuple[str, str], str]:
    """Return what is published of each body of a session, by camera and serial number, so that bodies stay apart.

    Where numbers are withheld, bodies are counted in the order in which they come.
    """
    bodies = list(dict.fromkeys((origin.camera, origin.serial) for origin in origins if origin.serial))
    if form == "plain":
        return {body: body[1] for body in bodies}
    if form == "hash":
        return {body: serial_hash(*body) for body in bodies}
    return {body: f"withheld ({number})" for number, body in enumerate(bodies, 1)}


def with_published_serials(origins: Sequence[FrameOrigin], form: SerialForm) -> list[FrameOrigin]:
    """Return what frames state, their serial numbers published as the lab chose; equal numbers stay equal."""
    published = published_serials(origins, form)
    return [replace(one, serial=published[one.camera, one.serial]) if one.serial else one for one in origins]


class OriginRecord(Record):
    """With what, when and by whom the frames of a table were taken.

    - `rig`: ``lab``, ``simulated`` or ``imported``; None where the session does not say.
    - `camera_serial`: serial number of the body, or its hash, as `camera_serial_is` says.
    - `camera_serial_is`: ``hash`` (`calibration.citation.serial_hash`), ``plain``, ``withheld`` by the
      lab's choice, or ``not stated`` by the raw files.
    - `lens`: model of the lens as the raw files state it, or the lab where they do not.
    - `iso`, `aperture`, `shutter_s`: ISO speed, f-number and exposure time in seconds of most frames.
    - `exposure_by`: who states the exposure: the ``raw files``, or the session's ``settings`` where these are silent.
    - `first_frame`, `last_frame`: when the first and the last frame of the table were released, ISO 8601, UTC.
    - `projector`: maker and model as its control port names it, or as the lab does where it has none.
    - `screen`: what showed the colours, as the session names it.
    - `taken_by`: name and version of the software that took the session; `Provenance.software` is what built the table.
    - `title`, `authors`, `note`, `licence`, `url`: as the lab states them; the licence is an SPDX expression (SPDX
      specification 2.3, annex D).
    """

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
    authors: list[Line] = Field(default_factory=list[Line])
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
    words = {
        "lab": "a laboratory",
        "simulated": "the simulated laboratory: nothing was photographed",
        "imported": "a laboratory; its frames were imported",
    }
    return None if rig is None else words[rig]


@dataclass(frozen=True)
class StatedOrigin:
    """What `session.toml` and the journal state beside the frames.

    - `rig`: what stood at the end of the cables; None where the settings do not say.
    - `camera`: the exposure as it was set; None where nothing set it, or it is not known.
    - `devices`: names in the journal: ``camera``, ``projector``, ``screen``, ``software``; those that are known.
    """

    citation: CitationSettings
    rig: Rig | None
    camera: CameraSettings | None
    devices: dict[str, str]


def origin_record(stated: StatedOrigin, records: Sequence[FrameRecord], origins: Sequence[FrameOrigin]) -> OriginRecord:
    """Return what a table says of its origin."""
    citation, exposures = stated.citation, [origin for origin in origins if origin.exposure > 0]
    serial, told_as = _serial(stated, origins)
    moments = [record.taken_at.astimezone(UTC) for record in records]
    usual = _most([(one.iso, one.aperture, one.shutter_s) for one in exposures])
    by = None if usual is None and stated.camera is None else "settings" if usual is None else "raw files"
    if usual is None and stated.camera is not None:
        asked = stated.camera.exposure
        usual = asked.iso, asked.aperture, asked.shutter_s
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
    return published_serials([FrameOrigin(camera, serial)], form)[camera, serial], form


def _most(values: Sequence[Any]) -> Any:
    """Return the value that comes most often, the first of equals; None of none."""
    return Counter(values).most_common(1)[0][0] if values else None


def _line(text: str) -> str | None:
    """Return a name as one line of bounded length; None where it is empty."""
    return " ".join(text.split())[:500] or None


def table_title(camera: str, lights: int | None, origin: OriginRecord | None, computed: bool = False) -> str:
    """Return what a table is called: as the lab says, else by its camera and lights."""
    if origin is not None and origin.title:
        return origin.title
    kind = "Computed look-up table" if computed else "Look-up table"
    return f"{kind} of the {camera}" + ("" if lights is None else f" under {lights} lights")


def bibtex(
    camera: str, lights: int | None, software: str, sha256: str, origin: OriginRecord | None, computed: bool = False
) -> str:
    """Return a BibTeX entry of a table.

    `origin`: what it says of its origin; None for tables made before that was kept.
    """
    known = origin or OriginRecord()
    year = known.year
    family = known.authors[0].partition(",")[0] if known.authors else "crop"
    key = "-".join(part for part in (_word(family), _word(camera), year or "", sha256[:KEY_DIGITS]) if part)
    made = "computed" if computed else "simulated" if known.rig == "simulated" else "photographed"
    fields = {
        "author": " and ".join(_name(author) for author in known.authors),
        "title": f"{{{tex_text(table_title(camera, lights, origin, computed))}}}",
        "year": year or "",
        "howpublished": tex_text(f"Look-up table, {made}; made with {software}"),
        "note": tex_text(f"SHA-256 {sha256}" + (f"; licence {known.licence}" if known.licence else "")),
        "url": re.sub(r"[{}\\\s]", "", known.url or ""),
    }
    missing = [name for name in ("author", "year", "url") if not fields[name]]
    if not known.licence:
        missing.append("licence")
    body = "".join(f"  {name} = {{{value}}},\n" for name, value in fields.items() if value)
    comment = f"% {NOT_RECORDED} by the table: {', '.join(missing)}\n" if missing else ""
    return f"{comment}@misc{{{key},\n{body}}}\n"


def tex_text(text: str) -> str:
    """Return a text so that TeX prints it as it is."""
    return "".join(_SPECIAL.get(character, character) for character in " ".join(text.split()))


def _name(author: str) -> str:
    """Return an author's name for BibTeX: "Family, Given" as it is, a name without a comma in braces as one whole."""
    text = tex_text(author)
    return text if "," in author else f"{{{text}}}"


def _word(text: str) -> str:
    """Return a text as part of a key: letters and digits of ASCII."""
    return re.sub(r"[^a-z0-9]+", "", text.casefold())[:40]
