"""What `lut.json` holds: the camera, the corrections, the unfit cells, and the hashes that name and verify a table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from calibration.citation.record import OriginRecord
from foundation.errors import FormatError

FORMAT: Final = "crop.lut"
VERSION: Final = 1
"""The only version so far: keys that were added since are optional."""


Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
"""A SHA-256 as 64 lowercase hexadecimal digits."""

FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}$")]
"""Name of a file that lies in the table's own folder."""


class Unfit(BaseModel):
    """A cell whose samples must not be used, and why."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    colour: int = Field(ge=0)
    cause: str

    @property
    def kind(self) -> str:
        """The cause in a word, without its numbers."""
        return self.cause.split(":")[0]


class Provenance(BaseModel):
    """The content of `lut.json`.

    - `camera`: maker and model as the raw files name it.
    - `bits`: bits kept of each channel; the table has 8**bits colours.
    - `white_level`: sample value of sensor saturation: linear camera RGB after black subtraction.
    - `corrections`: what was applied to the counts, with its parameters, in order.
    - `session_sha256`: hash over the frames' hashes (`calibration.table.source_frames.frames_sha256`).
    - `chart_sha256`: hash of the chart.
    - `software`: name and version of the program that built the table.
    - `unfit`: cells unfit for use.
    - `samples_sha256`, `illuminations_sha256`: of the files; None in tables made before they were recorded.
    - `lights_sha256`: of each light's samples as they lie in the file, in the order of lights, so that damage can be
      traced to a light; empty in tables made before they were recorded.
    - `files_sha256`: of further files of the table, `references.csv`; empty in tables made before they were recorded.
    - `has_sums`: whether `SHA256SUMS` lists every file of the table; false in tables made before it was written.
    - `computed`: where the table was computed from spectra and a model of the sensor and nothing was photographed: by
      what, and with which settings. None where it was made from frames.
    - `origin`: with what, when and by whom the frames were taken, and under which licence the table may be used; None
      in tables made before it was kept, and in computed ones of which nothing is stated.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    format: Literal["crop.lut"] = FORMAT
    version: Literal[1] = VERSION
    camera: str
    bits: int = Field(ge=1, le=5)
    white_level: int = Field(ge=1, le=65535)
    corrections: list[dict[str, Any]] = []
    session_sha256: str
    chart_sha256: str
    software: str
    unfit: list[Unfit] = []
    samples_sha256: Sha256 | None = None
    illuminations_sha256: Sha256 | None = None
    lights_sha256: list[Sha256] = []
    files_sha256: dict[FileName, Sha256] = {}
    has_sums: bool = False
    computed: dict[str, Any] | None = None
    origin: OriginRecord | None = None

    @model_validator(mode="after")
    def _require_colours(self) -> Self:
        """Require that unfit cells are cells of the chart."""
        beyond = [cell.colour for cell in self.unfit if cell.colour >= 8**self.bits]
        if beyond:
            raise ValueError(f"unfit: colour {beyond[0]} is none of the {8**self.bits} of {self.bits} bits a channel")
        return self

    def to_json(self) -> str:
        """Return the text of `lut.json`; `computed` and `origin` stand in it where they are known."""
        left_out = {name for name in ("computed", "origin") if getattr(self, name) is None}
        return self.model_dump_json(indent=2, exclude=left_out) + "\n"


class _Head(BaseModel):
    format: Any = None
    version: Any = None


def parse_provenance(text: bytes, path: Path) -> Provenance:
    """Return the content of `lut.json` from its bytes."""
    try:
        head = _Head.model_validate_json(text)
    except ValidationError as error:
        raise FormatError(f"{path} is no table's description: it is damaged; build the table again") from error
    if head.format != FORMAT:
        raise FormatError(f"{path} is no table of CroP: its format is not {FORMAT!r}; name a folder made by build-lut")
    if head.version != VERSION:
        raise FormatError(
            f"{path.parent} is a table of version {head.version!r}, this software reads version {VERSION}; "
            "build it again from its session with build-lut, or install the software that wrote it"
        )
    try:
        return Provenance.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        where = "".join(f"{part}: " for part in (".".join(map(str, first["loc"])),) if part)
        raise FormatError(f"{path} is damaged: {where}{first['msg']}; restore it from a copy") from error
