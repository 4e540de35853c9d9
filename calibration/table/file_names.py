"""Names of the files of a LUT folder (`docs/formats.md`)."""

from __future__ import annotations

from typing import Final

PROVENANCE: Final = "lut.json"
"""What the table was made from and how; written last, so that a folder without it is no table."""

SAMPLES: Final = "samples.npy"
"""The samples, uint16 little-endian, C order, [light, colour, sample, RGB]."""

ILLUMINATIONS: Final = "illuminations.csv"
"""The lights and their ground truth."""

FRAMES: Final = "frames.csv"
"""The raw files that the table was made from; absent in tables made before they were recorded."""

REFERENCES: Final = "references.csv"
"""The grey references under each light, where the chart has some."""

REPORT_PAGE: Final = "report.html"
"""The report for people."""

REPORT_JSON: Final = "report.json"
"""The report for programs."""

SUMS: Final = "SHA256SUMS"
"""Hashes of all other files of the table, as `sha256sum -c` reads them; absent in tables made before it was written."""

REPORT_FORMAT: Final = "crop.report"
REPORT_VERSION: Final = 1
"""`format` and `version` of `report.json` (docs/formats.md)."""
