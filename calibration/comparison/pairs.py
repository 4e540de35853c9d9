"""Which lights of two tables correspond, and what makes a comparison of them mean less, or nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from calibration.table.lut import Lut
from experiment.lights import Illumination
from foundation.errors import FormatError, counted


@dataclass(frozen=True)
class LightPairs:
    """The lights that two tables have in common, in the order of the first.

    - `one`, `other`: their numbers in either table.
    - `only_one`, `only_other`: lights that only one of the tables has.
    """

    one: tuple[int, ...]
    other: tuple[int, ...]
    only_one: tuple[int, ...]
    only_other: tuple[int, ...]


def light_pairs(one: Sequence[Illumination], other: Sequence[Illumination]) -> LightPairs:
    """Return which lights are the same: kind, temperature, codes and name, whatever their numbers.

    Where a table has a light more than once, the first of it is that of the other's first, and so on.
    """
    there: dict[object, list[int]] = {}
    for light in reversed(other):
        there.setdefault(_key(light), []).append(light.index)
    pairs: list[tuple[int, int]] = []
    alone: list[int] = []
    for light in one:
        found = there.get(_key(light))
        if found:
            pairs.append((light.index, found.pop()))
        else:
            alone.append(light.index)
    left = sorted(index for found in there.values() for index in found)
    return LightPairs(tuple(i for i, _ in pairs), tuple(j for _, j in pairs), tuple(alone), tuple(left))


def require_one_chart(one: Lut, other: Lut) -> None:
    """Refuse two tables of different charts: a colour then means another place, and nothing can be compared."""
    ours, theirs = one.provenance, other.provenance
    differs = ""
    if ours.bits != theirs.bits:
        differs = f"{ours.bits} bits of each channel against {theirs.bits}"
    elif ours.chart_sha256 != theirs.chart_sha256:
        differs = f"chart {ours.chart_sha256[:12]}… against {theirs.chart_sha256[:12]}…"
    if differs:
        raise FormatError(
            f"{one.folder} and {other.folder} are of different charts ({differs}), so that their cells cannot be "
            "compared; name two tables or sessions of one chart.json"
        )


def require_common_lights(pairs: LightPairs, one: Lut, other: Lut) -> None:
    """Refuse two tables without a light in common."""
    if not pairs.one:
        raise FormatError(
            f"{one.folder} has {counted(len(one.illuminations), 'light')} and {other.folder} "
            f"{len(other.illuminations)}, none of them the same: expected at least one of the same kind and codes"
        )


def warnings_of(one: Lut, other: Lut, pairs: LightPairs) -> tuple[str, ...]:
    """Return what a reader of the comparison must know of the two tables, a sentence each."""
    ours, theirs = one.provenance, other.provenance
    found: list[str] = []
    if ours.camera != theirs.camera:
        found.append(
            f"two cameras, {ours.camera} and {theirs.camera}: what differs is first of all the cameras, not the lab"
        )
    if pairs.only_one or pairs.only_other:
        found.append(
            f"{len(pairs.one)} lights are compared, which both have; {len(pairs.only_one)} of the first and "
            f"{len(pairs.only_other)} of the second are not in the other"
        )
    if (ours.computed is None) != (theirs.computed is None):
        found.append("one of the tables was computed, and nothing was photographed for it")
    if ours.session_sha256 == theirs.session_sha256 and ours.computed is None:
        found.append("both tables are of the same frames: their noise is the same, and agreement shows nothing")
    if one.samples.shape[2] != other.samples.shape[2]:
        found.append(
            f"{one.samples.shape[2]} samples a cell against {other.samples.shape[2]}: the larger window takes in more "
            "of a cell's rim"
        )
    return tuple(found)


def _key(light: Illumination) -> object:
    return light.kind, light.cct_k, light.codes, light.name
