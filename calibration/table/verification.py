"""What a table is, in lines for people; whether it is as it was built, byte by byte; whether two tables correspond."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from calibration.citation import bibtex, origin_lines
from calibration.table.lut import (
    FRAMES,
    PROVENANCE,
    SAMPLES,
    SUMS,
    UNCERTAINTY,
    Lut,
    changed_files,
    known_sums,
    samples_sha256,
)
from foundation.errors import FormatError, first_few


def _uncertainty(lut: Lut) -> str:
    expanded = lut.truth_uncertainty_deg
    if expanded is None:
        return "not stated: the table was computed"
    return (
        f"{np.median(expanded):.2g}° median, {expanded.max():.2g}° worst light ({int(np.argmax(expanded))}), k = 2; "
        f"causes in {UNCERTAINTY}"
    )


def describe(lut: Lut) -> list[tuple[str, str]]:
    """Return what a table is and what it was made from: names and values, for people to read."""
    known, lights = lut.provenance, lut.illuminations
    black_bodies = [light.cct_k for light in lights if light.cct_k is not None]
    spectra = sum(light.kind == "spectrum" for light in lights)
    kinds = f"{len(lights) - len(black_bodies) - spectra} uniform, {len(black_bodies)} black bodies"
    if black_bodies:
        kinds += f" {min(black_bodies):g} to {max(black_bodies):g} K"
    if spectra:
        kinds += f", {spectra} spectra"
    causes: dict[str, int] = {}
    for cell in known.unfit:
        cause = cell.cause.split(":")[0]
        causes[cause] = causes.get(cause, 0) + 1
    brightest = lut.white.max(axis=1)
    low, high = lut.ground_truth.min(axis=0), lut.ground_truth.max(axis=0)
    chromaticities = ", ".join(
        f"{channel} {least:.3f} to {most:.3f}"
        for channel, least, most in zip("rgb", low.tolist(), high.tolist(), strict=True)
    )
    frames = f"{len(lut.frames)}, listed in {FRAMES}" if lut.frames else "not listed"
    origin: list[tuple[str, str]] = []
    session = known.session_sha256
    if known.computed is not None:
        by = known.computed.get("by", "a program")
        origin = [("Origin", f"computed by {by} from spectra and a model of the sensor; nothing was photographed")]
        frames = session = "none: computed"
    return [
        *origin,
        ("Camera", known.camera),
        ("Lights", f"{len(lights)}: {kinds}"),
        ("Colours", f"{8**known.bits} ({known.bits} bits a channel), {lut.samples.shape[2]} samples each"),
        ("Size", f"{lut.samples.nbytes / 1e9:.2f} GB of samples"),
        (
            "White",
            f"{brightest.min():.0f} to {brightest.max():.0f} in the brightest channel, saturation {known.white_level}",
        ),
        ("Chromaticities", chromaticities),
        ("Uncertainty", _uncertainty(lut)),
        (
            "Cells unfit",
            f"{len(known.unfit)} of {8**known.bits}"
            + "".join(f", {count} {cause}" for cause, count in sorted(causes.items())),
        ),
        ("Corrections", ", ".join(_name(correction) for correction in known.corrections)),
        *origin_lines(known.origin),
        ("Built by", known.software),
        ("Frames", frames),
        ("Session", session),
        ("Chart", known.chart_sha256),
        ("Samples", known.samples_sha256 or ""),
        ("Hashes", f"every file, in {SUMS}, whose own names the table"),
        ("Table", lut.sha256),
    ]


def citation_of(lut: Lut) -> str:
    """Return a BibTeX entry of a table, with its hash."""
    known = lut.provenance
    computed = known.computed is not None
    return bibtex(known.camera, len(lut.illuminations), known.software, lut.sha256, known.origin, computed)


def _name(correction: Mapping[str, Any]) -> str:
    """Return what a correction is called, and whether it was only recorded."""
    name = str(correction.get("name", "?"))
    return f"{name} (recorded, not applied)" if correction.get("applied") is False else name


def find_faults(lut: Lut, progress: Callable[[int, int], None] | None = None) -> list[str]:
    """Return what of a table is not as it was built, each fault in words; none where all is. Reads every byte of it."""
    sums = known_sums(lut.folder)
    faults = list(changed_files(lut.folder, sums))
    whole, lights = samples_sha256(lut.folder / SAMPLES, lut.samples, progress)
    recorded = lut.provenance.lights_sha256
    if len(recorded) != len(lights):
        return [*faults, f"{PROVENANCE}: it has hashes of {len(recorded)} lights, the table has {len(lights)}"]
    changed = [light for light, (now, then) in enumerate(zip(lights, recorded, strict=True)) if now != then]
    if changed:
        named = first_few(changed, 20)
        faults.append(f"{SAMPLES}: the samples of {len(changed)} of {len(lights)} lights have changed: {named}")
    elif whole != sums[SAMPLES]:
        faults.append(f"{SAMPLES}: its first bytes, before the samples, have changed")
    return faults


def chart_difference(one: Lut, other: Lut) -> str:
    """Return in what the charts of two tables differ, so that a colour means another place; "" of one chart."""
    ours, theirs = one.provenance, other.provenance
    if ours.bits != theirs.bits:
        return f"{ours.bits} bits of each channel against {theirs.bits}"
    if ours.chart_sha256 != theirs.chart_sha256:
        return f"chart {ours.chart_sha256[:12]}… against {theirs.chart_sha256[:12]}…"
    return ""


def require_match(one: Lut, other: Lut) -> None:
    """Refuse two tables whose colours or lights do not correspond number by number.

    Tables of one chart under one list of lights, photographed by two bodies or on two days, pass: colour index and
    light index then mean the same in both.
    """
    differs = chart_difference(one, other)
    found = [differs] if differs else []
    if len(one.illuminations) != len(other.illuminations):
        found.append(f"{len(one.illuminations)} lights against {len(other.illuminations)}")
    else:
        pairs = zip(one.illuminations, other.illuminations, strict=True)
        differing = [light.index for light, counterpart in pairs if light != counterpart]
        if differing:
            found.append(f"other codes under {len(differing)} lights: {first_few(differing)}")
    if found:
        raise FormatError(
            f"{one.folder} and {other.folder} do not correspond: {'; '.join(found)}; "
            "name two tables of one chart.json and one illuminations.csv"
        )
