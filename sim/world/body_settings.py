"""Bodies for any sensitivities: known facts by name, plausible ones for the rest, and changes from a settings file.

Sizes are the makers' numbers of recorded pixels. Borders, black, saturation, conversion gain and read noise are of the
order that such sensors have: plausible, not measured on these bodies. Whoever knows better says so in a settings file.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import fields, replace
from types import MappingProxyType
from typing import Any, Final

from pydantic import TypeAdapter, ValidationError

from foundation.errors import ConfigurationError
from sim.spectral.sensitivities import Sensitivities, read_sensitivities
from sim.world.sensors import BODIES, Body, Rectangle

_BORDER: Final = (50, 140)
"""Masked rows above and masked columns left of the picture, as Canon's sensors have about as many."""


def _body(
    name: str, size: tuple[int, int], black: int, saturation: int, gain_e: float, noise_dn: float, early_e: float
) -> Body:
    """Return a body of `size` columns and rows that see light; the rest as `sim.world.sensors.Body` has it."""
    (width, height), (top, left) = size, _BORDER
    sensor = height + top, width + left
    return Body(
        maker="Canon",
        model=name.replace("_", " "),
        sensor=sensor,
        visible=Rectangle(top, left, height, width),
        pattern="RGGB",
        black=black,
        saturation=saturation,
        bits=14,
        electrons_per_dn=gain_e,
        read_noise_dn=noise_dn,
        sensor_noise_e=early_e,
        sensitivities=name,
        masked=(Rectangle(0, 0, sensor[0], left - 2),),
    )


FACTS: Final[Mapping[str, Body]] = MappingProxyType(
    {
        "Canon_EOS_600D": replace(BODIES["EOS 550D"], model="Canon EOS 600D"),
        "Canon_EOS_200D": _body("Canon_EOS_200D", (6000, 4000), 2048, 16383, 2.3, 5.2, 2.4),
        "Canon_EOS-1Ds_Mark_III": _body("Canon_EOS-1Ds_Mark_III", (5616, 3744), 1024, 15600, 3.6, 6.0, 3.2),
        "Canon_EOS_5D_Mark_II": _body("Canon_EOS_5D_Mark_II", (5616, 3744), 1024, 15760, 4.2, 6.4, 2.5),
        "Canon_EOS_5DS": _body("Canon_EOS_5DS", (8688, 5792), 2048, 15500, 2.4, 5.6, 2.5),
    }
)
"""Bodies by the name of their sensitivities; the EOS 600D has the sensor generation of the EOS 550D, and its facts."""


def find_body(
    camera: str, changes: Mapping[str, Any] = MappingProxyType({}), where: str = "--settings", key: str = "camera"
) -> Body:
    """Return the body that a name or a file of sensitivities stands for."""
    body = BODIES.get(camera) or _of_sensitivities(camera, read_sensitivities(camera))
    given = dict(changes)
    known = [field.name for field in fields(Body)] + ["pixels"]
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
            hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"
            raise ConfigurationError(f"{where}: unknown key '{key}.{name}'; {hint}")
    pixels = given.pop("pixels", None)
    if pixels is not None:
        given = _areas(pixels, where, key) | given
    try:
        changed = TypeAdapter(Body).validate_python(
            {field.name: given.get(field.name, getattr(body, field.name)) for field in fields(Body)}
        )
    except ValidationError as error:
        first = error.errors()[0]
        at = ".".join([key, *(str(part) for part in first["loc"][:1])])
        raise ConfigurationError(f"{where}: {at}: {first['msg']}, got {first['input']!r}") from error
    _require_sensor(changed, where, key)
    return changed


def _of_sensitivities(camera: str, found: Sensitivities) -> Body:
    if camera in FACTS:
        return FACTS[camera]
    usual = BODIES["EOS 550D"]
    return replace(usual, maker=found.maker or "unknown", model=found.camera, sensitivities=camera)


def _areas(pixels: Any, where: str, key: str) -> dict[str, Any]:
    """Return sensor, visible and masked areas for so many columns and rows that see light."""
    try:
        width, height = TypeAdapter(tuple[int, int]).validate_python(pixels)
    except ValidationError as error:
        raise ConfigurationError(
            f"{where}: {key}.pixels = {pixels!r}: two whole numbers expected, columns and rows, such as [5184, 3456]"
        ) from error
    if min(width, height) < 16:
        raise ConfigurationError(f"{where}: {key}.pixels = {pixels!r}: at least 16 columns and rows expected")
    top, left = _BORDER
    sensor = height + top, width + left
    return {
        "sensor": sensor,
        "visible": Rectangle(top, left, height, width),
        "masked": (Rectangle(0, 0, sensor[0], left - 2),),
    }


def _require_sensor(body: Body, where: str, key: str) -> None:
    """Refuse numbers that no sensor has."""
    top = 2**body.bits - 1
    limits = (
        ("bits", body.bits, 8 <= body.bits <= 16, "8 to 16"),
        ("black", body.black, 0 <= body.black < body.saturation, f"0 to below saturation, {body.saturation}"),
        ("saturation", body.saturation, body.saturation <= top, f"{top} at most with {body.bits} bits"),
        ("electrons_per_dn", body.electrons_per_dn, body.electrons_per_dn > 0, "more than 0"),
        ("read_noise_dn", body.read_noise_dn, body.read_noise_dn >= 0, "0 or more"),
        (
            "sensor_noise_e",
            body.sensor_noise_e,
            0 <= body.sensor_noise_e <= body.read_noise_dn * body.electrons_per_dn,
            f"0 to the whole read noise, {body.read_noise_dn * body.electrons_per_dn:g} electrons",
        ),
    )
    for name, value, allowed, expected in limits:
        if not allowed:
            raise ConfigurationError(f"{where}: {key}.{name} is {value:g}; {expected} expected")
