"""Whether a table is as it was built, byte by byte, and whether two tables correspond number by number."""

from __future__ import annotations

from collections.abc import Callable

from calibration.table.file_names import FRAMES, ILLUMINATIONS, PROVENANCE, SAMPLES
from calibration.table.lut import Lut
from calibration.table.sample_hashes import samples_sha256
from calibration.table.source_frames import frames_sha256
from foundation.errors import FormatError, InputError, first_of
from foundation.hashing import file_sha256


def find_faults(lut: Lut, progress: Callable[[int, int], None] | None = None) -> list[str]:
    """Return what of a table is not as it was built, each fault in words; none where all is. Reads every byte of it.

    Parameters
    ----------
    lut
        The table.
    progress
        Called with the number of lights read, and the number of all.

    Raises
    ------
    InputError
        The table was made before hashes were recorded, so nothing can be said.
    """
    known = lut.provenance
    if known.samples_sha256 is None or len(known.lights_sha256) != len(lut.illuminations):
        raise InputError(
            f"{lut.folder} records no hashes ({known.software} wrote none), so it cannot be verified; "
            "build it again from its session"
        )
    faults: list[str] = []
    if file_sha256(lut.folder / ILLUMINATIONS) != known.illuminations_sha256:
        faults.append(f"{ILLUMINATIONS} is not as it was built: lights or ground truth have changed")
    faults += [
        f"{name} is not as it was built, or is gone"
        for name, then in known.files_sha256.items()
        if not (lut.folder / name).is_file() or file_sha256(lut.folder / name) != then
    ]
    whole, lights = samples_sha256(lut.folder / SAMPLES, lut.samples, progress)
    changed = [light for light, (now, then) in enumerate(zip(lights, known.lights_sha256, strict=True)) if now != then]
    if changed:
        named = first_of(changed, 20)
        faults.append(f"{SAMPLES}: the samples of {len(changed)} of {len(lights)} lights have changed: {named}")
    elif whole != known.samples_sha256:
        faults.append(f"{SAMPLES}: its first bytes, before the samples, have changed")
    try:
        frames = lut.frames
    except FormatError as error:
        faults.append(str(error))
    else:
        if frames_sha256(frames) != known.session_sha256:
            faults.append(f"{FRAMES} does not list the frames that {PROVENANCE} was made of")
    return faults


def require_match(one: Lut, other: Lut) -> None:
    """Refuse two tables whose colours or lights do not correspond number by number.

    Tables of one chart under one list of lights, photographed by two bodies or on two days, pass: colour index and
    light index then mean the same in both.

    Raises
    ------
    FormatError
        The chart, its bits, or the lights differ; the message says in what.
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
