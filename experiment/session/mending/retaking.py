"""Which lights are to be taken again: `12,40-44` as a person says it, or those whose frames `build-lut` refused.

A report names frames by their hashes too, so that asking twice for what one report refused takes nothing twice.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from foundation.errors import FormatError, InputError

BAD = "bad"
"""What stands for the lights that the newest report refused."""

_RANGE = re.compile(r"\s*(\d{1,9})\s*(?:[-–]\s*(\d{1,9})\s*)?")


@dataclass(frozen=True)
class RefusedFrames:
    """What a report says of lights that are to be taken again.

    - `report`: the file that says so.
    - `lights`: their numbers, as `parse_lights` reads them; empty for none.
    - `sha256`: hashes of their frames.
    """

    report: Path
    lights: str
    sha256: frozenset[str]


def parse_lights(text: str, known: Collection[int]) -> tuple[int, ...]:
    """Return the lights of ``12,40-44``, rising, each once.

    Examples
    --------
    >>> parse_lights("7, 2-4,3", range(10))
    (2, 3, 4, 7)
    """
    lights: set[int] = set()
    for part in text.split(","):
        found = _RANGE.fullmatch(part)
        if found is None:
            raise InputError(
                f"--retake {text!r}: {part.strip()!r} is no light; name lights as 12,40-44, or {BAD} for those that "
                "build-lut refused"
            )
        first, last = int(found[1]), int(found[2] or found[1])
        if last < first:
            raise InputError(f"--retake {text!r}: {part.strip()} runs backwards; name it {last}-{first}")
        unknown = next((light for light in (first, last) if light not in known), None)
        if unknown is not None:
            raise InputError(
                f"--retake {text!r}: the session has no light {unknown}, its {len(known)} lights are "
                f"{min(known, default=0)} … {max(known, default=0)}"
            )
        lights.update(light for light in range(first, last + 1) if light in known)
    return tuple(sorted(lights))


def lights_text(lights: Collection[int]) -> str:
    """Return lights as `parse_lights` reads them.

    Examples
    --------
    >>> lights_text([44, 12, 40, 41, 42, 43])
    '12,40-44'
    """
    ranges: list[list[int]] = []
    for light in sorted(set(lights)):
        if ranges and light == ranges[-1][1] + 1:
            ranges[-1][1] = light
        else:
            ranges.append([light, light])
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in ranges)


def newest_report(session: Path, taken: Mapping[str, int]) -> RefusedFrames:
    """Return what the newest report on a session's frames, beside the session or in it, says is to be taken again.

    The newest is the one whose newest frame was taken last: what clocks said when reports were written counts only
    between reports on the same frames.
    """
    home = session.resolve()
    found: list[tuple[int, int, RefusedFrames]] = []
    for path in [*home.parent.glob("*/report.json"), *home.glob("*/report.json")]:
        with suppress(OSError, ValueError, TypeError, KeyError):
            says: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            refused = RefusedFrames(path, str(says["retake"]), frozenset(map(str, says["retake_sha256"])))
            # Reports of older software do not say it, and are older.
            newest = says.get("newest_sha256")
            if says["registered_sha256"] in taken and newest in (None, *taken):
                found.append((0 if newest is None else taken[newest], path.stat().st_mtime_ns, refused))
    if not found:
        raise FormatError(
            f"no report of build-lut on {session} lies beside it in {home.parent}; build the table there "
            f"(build-lut {session} {session}-lut), or name the lights, as in --retake 12,40-44"
        )
    return max(found, key=lambda entry: entry[:2])[2]
