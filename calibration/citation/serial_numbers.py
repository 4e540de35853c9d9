"""How the serial number of a camera is told to those who get a table.

Every photograph of a body names its number, so that a published number ties a table to all other pictures of its owner,
and to registers of sales and warranties; yet readers want to know whether two tables are of one body. A hash tells that
alone: equal hashes, equal bodies, and whoever holds the camera can show that it is the one.

Serial numbers are short, and a plain hash of ten digits is undone in seconds by trying all. So the hash is scrypt (RFC
7914), which takes some hundredths of a second and 16 MiB a try: all numbers of ten digits take a core twelve years and
more. It is no secret from somebody who has a list of bodies to try. A lab that wants no trace withholds the number.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Literal

from drivers.raw.rawfile import FrameOrigin

SerialForm = Literal["hash", "plain", "withheld"]
"""How the serial number of a body is told (`experiment.config.CitationSettings.camera_serial`)."""

_COST, _BLOCK, _PARALLEL = 1 << 14, 8, 1
"""scrypt's N, r and p as RFC 7914, section 2, has them for interactive use: 16 MiB, some 40 ms. Changing one changes
all hashes, so that bodies are not recognised any longer."""

_BYTES = 16
"""Of the hash: 128 bits never meet by chance."""


@lru_cache(maxsize=64)
def serial_hash(camera: str, serial: str) -> str:
    """Return the hash of a body's serial number, 32 hexadecimal digits: scrypt with the camera's name as salt."""
    salt = f"crop camera serial {camera}".encode()
    return hashlib.scrypt(serial.encode(), salt=salt, n=_COST, r=_BLOCK, p=_PARALLEL, dklen=_BYTES).hex()


def told_serials(origins: Sequence[FrameOrigin], form: SerialForm) -> Mapping[tuple[str, str], str]:
    """Return what is told of each body of a session, by camera and serial number, so that bodies stay apart.

    Where numbers are withheld, bodies are counted in the order in which they come.
    """
    bodies = list(dict.fromkeys((origin.camera, origin.serial) for origin in origins if origin.serial))
    if form == "plain":
        return {body: body[1] for body in bodies}
    if form == "hash":
        return {body: serial_hash(*body) for body in bodies}
    return {body: f"withheld ({number})" for number, body in enumerate(bodies, 1)}


def with_told_serials(origins: Sequence[FrameOrigin], form: SerialForm) -> list[FrameOrigin]:
    """Return what frames state, their serial numbers told as the lab chose; equal numbers stay equal."""
    told = told_serials(origins, form)
    return [replace(one, serial=told[one.camera, one.serial]) if one.serial else one for one in origins]
