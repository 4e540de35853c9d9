"""Spectral sensitivities of cameras, as ISO 17321-1 has them measured, read from files in the layout of rawtoaces.

The layout is that of AcademySoftwareFoundation/rawtoaces-data, schema 0.1.0: ``spectral_data.units`` is ``relative``,
``spectral_data.index.main`` names the channels, and ``spectral_data.data.main`` has their responses to light of equal
power by wavelength in nanometres. Only proportions matter: exposure is set elsewhere.

Files of some cameras come with the suite (`sim.data`) and are known by name; any other is named by its path.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, ValidationError

from foundation.errors import FormatError, InputError
from foundation.hashing import sha256_of
from sim.spectral.grids import regridded, require_grid

SUFFIX: Final = "_380_780_5.json"
"""What the names of the files in `sim.data` end in: first and last wavelength, and the step (as rawtoaces-data)."""

EDGE_SHARE: Final = 0.05
"""Share of a channel's peak that may be left at the first and the last wavelength of a file, beyond which the channel
is taken to be blind (judgement): what is cut off there is below a hundredth of its light."""

_CHANNELS: Final = ("R", "G", "B")

_Array = npt.NDArray[np.float64]


class _Header(BaseModel):
    model_config = ConfigDict(extra="ignore")

    manufacturer: str = ""
    model: str = ""


class _Spectra(BaseModel):
    model_config = ConfigDict(extra="ignore")

    units: str = "relative"
    index: dict[str, list[str]]
    data: dict[str, dict[str, list[float]]]


class _Document(BaseModel):
    model_config = ConfigDict(extra="ignore")

    header: _Header = _Header()
    spectral_data: _Spectra


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """A camera's spectral sensitivities.

    - `name`: the file's, without its suffix.
    - `maker`, `model`: as the file names the camera; empty where it does not.
    - `wavelengths_nm`: (W,) float64, ascending.
    - `curves`: (W, 3) float64 ≥ 0, R, G, B, response to light of equal power per nm, relative.
    - `sha256`: of the file.
    """

    name: str
    maker: str
    model: str
    wavelengths_nm: _Array
    curves: _Array
    sha256: str

    @property
    def camera(self) -> str:
        """Maker and model as raw files have them, e.g. ``Canon EOS 5DS``; the name where the file states no model."""
        return " ".join(f"{self.maker} {self.model}".split()) if self.model else self.name

    def at(self, wavelengths_nm: _Array) -> _Array:
        """Return the curves (N, 3) float64 on another grid (N,) nm of even steps (`regridded`), 0 beyond their own."""
        return regridded(self.wavelengths_nm, self.curves, wavelengths_nm)


def known_sensitivities() -> tuple[str, ...]:
    """Return the names of the cameras whose sensitivities come with the suite, in alphabetical order.

    Examples
    --------
    >>> "Canon_EOS_5DS" in known_sensitivities()
    True
    """
    files = (entry.name for entry in resources.files("sim").joinpath("data").iterdir())
    return tuple(sorted(name.removesuffix(SUFFIX) for name in files if name.endswith(SUFFIX)))


def read_sensitivities(name: str) -> Sensitivities:
    """Return the sensitivities that a name or a path stands for."""
    if name in known_sensitivities():
        data = resources.files("sim").joinpath("data", name + SUFFIX).read_bytes()
        return parse_sensitivities(data, name, name)
    path = Path(name)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"no camera {name!r}: cannot read such a file ({error.strerror}), and those known by name are "
            f"{', '.join(known_sensitivities())}; name one of them, or a file of spectral sensitivities"
        ) from error
    return parse_sensitivities(data, path.name.removesuffix(SUFFIX).removesuffix(".json"), str(path))


def parse_sensitivities(data: bytes, name: str, where: str) -> Sensitivities:
    """Return the sensitivities in the bytes of a file."""
    try:
        document = _Document.model_validate(json.loads(data, object_pairs_hook=_unlike))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise FormatError(f"{where} is no JSON: {error}; expected a file of rawtoaces-data's layout") from error
    except _TwiceError as error:
        raise FormatError(f"{where}: {error.args[0]!r} stands there twice; leave one out") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"])) or "document"
        raise FormatError(
            f"{where}: {key}: {first['msg']}; expected rawtoaces-data's layout: spectral_data with units, index.main "
            "and data.main"
        ) from error
    spectra = document.spectral_data
    if spectra.units != "relative":
        raise FormatError(
            f"{where}: spectral_data.units is {spectra.units!r}, 'relative' expected: responses to light of equal "
            "power; multiply a quantum efficiency by the wavelength first"
        )
    if tuple(spectra.index.get("main", ())) != _CHANNELS or "main" not in spectra.data:
        raise FormatError(
            f"{where}: spectral_data.index.main is {spectra.index.get('main')}, with data.main under it; "
            f"{list(_CHANNELS)} expected"
        )
    wavelengths, curves = _sorted(spectra.data["main"], where)
    _require_camera(wavelengths, curves, where)
    header = document.header
    return Sensitivities(name, header.manufacturer, header.model, wavelengths, curves, sha256_of(data))


class _TwiceError(Exception):
    """A key of a JSON object is there twice; its argument is the key."""


def _unlike(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object whose keys differ; of two alike `json` would take the last without a word."""
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise _TwiceError(key)
        found[key] = value
    return found


def _sorted(table: Mapping[str, list[float]], where: str) -> tuple[_Array, _Array]:
    """Return wavelengths (W,), ascending, and curves (W, 3)."""
    rows: list[tuple[float, list[float]]] = []
    for text, values in table.items():
        try:
            wavelength = float(text)
        except ValueError as error:
            raise FormatError(f"{where}: {text!r} is no wavelength; a number of nanometres expected") from error
        if len(values) != len(_CHANNELS) or not all(map(math.isfinite, [wavelength, *values])):
            raise FormatError(f"{where}: at {text} nm stand {values}; three numbers expected, for R, G and B")
        rows.append((wavelength, values))
    rows.sort(key=lambda row: row[0])
    wavelengths = np.array([row[0] for row in rows], dtype=np.float64)
    return wavelengths, np.array([row[1] for row in rows], dtype=np.float64).reshape(-1, 3)


def _require_camera(wavelengths: _Array, curves: _Array, where: str) -> None:
    """Refuse numbers that cannot be a camera's sensitivities."""
    require_grid(wavelengths, where)
    if curves.min() < 0:
        row, channel = np.unravel_index(int(curves.argmin()), curves.shape)
        raise FormatError(
            f"{where}: {_CHANNELS[channel]} is {curves[row, channel]:g} at {wavelengths[row]:g} nm, 0 or more "
            "expected; set to 0 what is a measurement's noise about 0"
        )
    peak = curves.max(axis=0)
    if peak.min() <= 0:
        raise FormatError(f"{where}: {_CHANNELS[int(peak.argmin())]} is 0 at every wavelength; it sees no light at all")
    for place in (0, -1):
        left = curves[place] / peak
        if left.max() > EDGE_SHARE:
            raise FormatError(
                f"{where}: {_CHANNELS[int(left.argmax())]} still has {left.max():.0%} of its peak at its last "
                f"wavelength, {wavelengths[place]:g} nm; {EDGE_SHARE:.0%} at most expected, so it goes on beyond: add "
                "what is lacking"
            )


def describe_sensitivities(found: Sensitivities) -> dict[str, Any]:
    """Return what a record says of sensitivities: name, camera, and the file's hash."""
    return {"name": found.name, "camera": found.camera, "sha256": found.sha256}
