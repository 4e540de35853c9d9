"""Whether a table is as it was built, byte by byte, and whether two tables correspond number by number."""

from __future__ import annotations

from collections.abc import Callable

from calibration.table.file_names import FRAMES, PROVENANCE, SAMPLES
from calibration.table.lut import Lut
from calibration.table.sample_hashes import samples_sha256
from calibration.table.source_frames import frames_sha256
from calibration.table.sums import changed_files, known_sums
from foundation.errors import FormatError, InputError, first_of


def find_faults(lut: Lut, progress: Callable[[int, int], None] | None = None) -> list[str]:
    """Return what of a table is not as it was built, each fault in words; none where all is. Reads every byte of it."""
    known = lut.provenance
    if known.samples_sha256 is None or len(known.lights_sha256) != len(lut.illuminations):
        raise InputError(
            f"{lut.folder} records no hashes ({known.software} wrote none), so it cannot be verified; "
            "build it again from its session"
        )
    sums = known_sums(lut.folder, known)
    faults = list(changed_files(lut.folder, sums))
    whole, lights = samples_sha256(lut.folder / SAMPLES, lut.samples, progress)
    changed = [light for light, (now, then) in enumerate(zip(lights, known.lights_sha256, strict=True)) if now != then]
    if changed:
        named = first_of(changed, 20)
        faults.append(f"{SAMPLES}: the samples of {len(changed)} of {len(lights)} lights have changed: {named}")
    elif whole != sums[SAMPLES]:
        faults.append(f"{SAMPLES}: its first bytes, before the samples, have changed")
    if not known.has_sums:
        faults += _frame_list_faults(lut)
    return faults


def _frame_list_faults(lut: Lut) -> list[str]:
    """Return what is wrong with the list of frames of a table that does not have its hash, but that of its content."""
    try:
        frames = lut.frames
    except FormatError as error:
        return [str(error)]
    if frames_sha256(frames) != lut.provenance.session_sha256:
        return [f"{FRAMES} does not list the frames that {PROVENANCE} was made of"]
    return []


def require_match(one: Lut, other: Lut) -> None:
    """Refuse two tables whose colours or lights do not correspond number by number.

    Tables of one chart under one list of lights, photographed by two bodies or on two days, pass: colour index and
    light index then mean the same in both.
    """
    ours, theirs = one.provenance, other.provenance
    found: list[str] = []
    if ours.bits != theirs.bits:
        found.append(f"{ours.bits} bits of each channel against {theirs.bits}")
    elif ours.chart_sha256 != theirs.chart_sha256:
        found.append(f"chart {ours.chart_sha256[:12]}… against {theirs.chart_sha256[:12]}…")
    if len(one.illuminations) != len(other.illuminations):
        found.append(f"{len(one.illuminations)} lights against {len(other.illuminations)}")
    else:
        pairs = zip(one.illuminations, other.illuminations, strict=True)
        differing = [light.index for light, counterpart in pairs if light != counterpart]
        if differing:
            found.append(f"other codes under {len(differing)} lights: {first_of(differing)}")
    if found:
        raise FormatError(
            f"{one.folder} and {other.folder} do not correspond: {'; '.join(found)}; "
            "name two tables of one chart.json and one illuminations.csv"
        )
