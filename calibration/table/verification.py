"""Describe a LUT as text, verify all its bytes, and compare two LUTs."""

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
    recorded_sums,
    samples_sha256,
)
from foundation.errors import FormatError, first_few


def _uncertainty(lut: Lut) -> str:
    expanded = lut.truth_uncertainty_deg
    if expanded is None:
        return "not available: computed LUT"
    return (
        f"median {np.median(expanded):.2g}°, largest {expanded.max():.2g}° (illuminant {int(np.argmax(expanded))}), "
        f"k = 2; components in {UNCERTAINTY}"
    )


def describe(lut: Lut) -> list[tuple[str, str]]:
    """Return a readable description of a LUT and its origin, as pairs of name and value."""
    source, lights = lut.provenance, lut.illuminations
    black_bodies = [light.cct_k for light in lights if light.cct_k is not None]
    spectra = sum(light.kind == "spectrum" for light in lights)
    kinds = f"{len(lights) - len(black_bodies) - spectra} uniform, {len(black_bodies)} black bodies"
    if black_bodies:
        kinds += f" {min(black_bodies):g} to {max(black_bodies):g} K"
    if spectra:
        kinds += f", {spectra} spectra"
    causes: dict[str, int] = {}
    for cell in source.unfit:
        cause = cell.cause.split(":")[0]
        causes[cause] = causes.get(cause, 0) + 1
    brightest = lut.white.max(axis=1)
    low, high = lut.ground_truth.min(axis=0), lut.ground_truth.max(axis=0)
    chromaticities = ", ".join(
        f"{channel} {low_value:.3f} to {high_value:.3f}"
        for channel, low_value, high_value in zip("rgb", low.tolist(), high.tolist(), strict=True)
    )
    frames = f"{len(lut.frames)}, listed in {FRAMES}" if lut.frames else "not listed"
    origin: list[tuple[str, str]] = []
    session = source.session_sha256
    if source.computed is not None:
        by = source.computed.get("by", "a program")
        origin = [("Origin", f"computed by {by} from spectra and a sensor model, not photographed")]
        frames = session = "none: computed"
    return [
        *origin,
        ("Camera", source.camera),
        ("Illuminants", f"{len(lights)}: {kinds}"),
        ("Colours", f"{8**source.bits} ({source.bits} bits a channel), {lut.samples.shape[2]} samples each"),
        ("Size", f"{lut.samples.nbytes / 1e9:.2f} GB of samples"),
        (
            "White",
            f"{brightest.min():.0f} to {brightest.max():.0f} in the brightest channel, saturation {source.white_level}",
        ),
        ("Chromaticities", chromaticities),
        ("Uncertainty", _uncertainty(lut)),
        (
            "Unfit patches",
            f"{len(source.unfit)} of {8**source.bits}"
            + "".join(f", {count} {cause}" for cause, count in sorted(causes.items())),
        ),
        ("Corrections", ", ".join(_name(correction) for correction in source.corrections)),
        *origin_lines(source.origin),
        ("Built by", source.software),
        ("Frames", frames),
        ("Session", session),
        ("Chart", source.chart_sha256),
        ("Samples", source.samples_sha256 or ""),
        ("Hashes", f"of all files in {SUMS}; the hash of this list identifies the LUT"),
        ("LUT", lut.sha256),
    ]


def citation_of(lut: Lut) -> str:
    """Return a BibTeX entry of a LUT, with its hash."""
    source = lut.provenance
    computed = source.computed is not None
    return bibtex(source.camera, len(lut.illuminations), source.software, lut.sha256, source.origin, computed)


def _name(correction: Mapping[str, Any]) -> str:
    name = str(correction.get("name", "?"))
    return f"{name} (recorded, not applied)" if correction.get("applied") is False else name


def find_faults(lut: Lut, progress: Callable[[int, int], None] | None = None) -> list[str]:
    """Return a message for each file that has changed since the build; reads every byte."""
    sums = recorded_sums(lut.folder)
    faults = list(changed_files(lut.folder, sums))
    file_hash, lights = samples_sha256(lut.folder / SAMPLES, lut.samples, progress)
    recorded = lut.provenance.lights_sha256
    if len(recorded) != len(lights):
        return [*faults, f"{PROVENANCE} has hashes of {len(recorded)} illuminants, expected {len(lights)}"]
    changed = [light for light, (new, old) in enumerate(zip(lights, recorded, strict=True)) if new != old]
    if changed:
        indices = first_few(changed, 20)
        faults.append(f"{SAMPLES}: the samples of {len(changed)} of {len(lights)} illuminants have changed: {indices}")
    elif file_hash != sums[SAMPLES]:
        faults.append(f"{SAMPLES}: its header has changed")
    return faults


def chart_difference(first: Lut, second: Lut) -> str:
    """Return the difference between the charts of two LUTs as text; "" if they are the same."""
    chart, other_chart = first.provenance, second.provenance
    if chart.bits != other_chart.bits:
        return f"{chart.bits} bits of each channel against {other_chart.bits}"
    if chart.chart_sha256 != other_chart.chart_sha256:
        return f"chart {chart.chart_sha256[:12]}… against {other_chart.chart_sha256[:12]}…"
    return ""


def require_match(first: Lut, second: Lut) -> None:
    """Raise `FormatError` if two LUTs differ in chart or illuminants; camera and date may differ."""
    chart_text = chart_difference(first, second)
    differences = [chart_text] if chart_text else []
    if len(first.illuminations) != len(second.illuminations):
        differences.append(f"{len(first.illuminations)} illuminants against {len(second.illuminations)}")
    else:
        pairs = zip(first.illuminations, second.illuminations, strict=True)
        different = [light.index for light, other_light in pairs if light != other_light]
        if different:
            differences.append(f"other codes for {len(different)} illuminants: {first_few(different)}")
    if differences:
        raise FormatError(
            f"{first.folder} and {second.folder} do not correspond: {'; '.join(differences)}; "
            "give two LUTs of one chart.json and one illuminations.csv"
        )
