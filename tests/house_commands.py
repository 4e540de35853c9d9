"""The five commands of the distribution, by name, with the module whose `main` each of them is."""

from __future__ import annotations

COMMANDS = {
    "acquire": "acquisition.cli",
    "build-lut": "calibration.cli",
    "generate": "generator.cli",
    "evaluate": "evaluation.cli",
    "sim": "synthesis.cli",
}
