"""Computed tables, spectra and settings as they came before."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.table.lut import open_lut
from synthesis.lamps import illuminations_of, parse_spectra, read_lights
from synthesis.settings import parse_settings, room_of, stated_by_hand, table_task
from synthesis.table import compute_table
from tests.generator.dataset.known import rows_of
from tests.generator.said import said
from tests.pinned import Pinned
from tests.synthesis.test_table import task_of

pytestmark = pytest.mark.slow

SETTINGS: dict[str, Any] = {"chart": {"bits": 1, "seed": 3}, "seed": 8}
CASES: dict[str, tuple[str, dict[str, Any], str | None]] = {
    "spectra": ("Canon_EOS_5D_Mark_II", SETTINGS, "D65,FL2,3000K,daylight:6500"),
    "spectra with a large window": (
        "EOS 6D Mark II",
        {**SETTINGS, "window": 7, "room": {"paper": "matt", "response_spread": 0.02}},
        "A,LED-B3",
    ),
    "hot photosites": (
        "Test",
        {**SETTINGS, "room": {"hot_per_million": 3000.0, "hot_dn_per_s": 900.0}, "exposure": {"iso": 800}},
        "D50",
    ),
    "a managed print": (
        "EOS 550D",
        {**SETTINGS, "room": {"profile": "managed", "white_level_share": 0.5}},
        "E,cie-hp",
    ),
}


def held_by(folder: Path) -> dict[str, Any]:
    """Return what a table holds, but for the software that wrote it, and hashes of what names it."""
    described = json.loads((folder / "lut.json").read_text())
    kept = (
        "camera",
        "bits",
        "white_level",
        "corrections",
        "chart_sha256",
        "unfit",
        "samples_sha256",
        "computed",
        "origin",
    )
    lists = {path.name: rows_of(path.read_text()) for path in sorted(folder.glob("*.csv"))}
    lut = open_lut(folder)
    return {
        "described": {name: described.get(name) for name in kept},
        "lists": {name: rows[:30] for name, rows in lists.items()},
        "white": lut.white,
        "means": np.asarray(lut.samples).mean(axis=2),
    }


@pytest.mark.parametrize("name", CASES)
def test_a_table_of_spectra(name: str, tmp_path: Path, pinned: Pinned) -> None:
    camera, document, lights = CASES[name]
    settings = parse_settings(document, "here")
    task = table_task(camera, settings, "here", None if lights is None else read_lights(lights))
    done = compute_table(replace(task, origin=stated_by_hand("a note", "CC0-1.0", ["One"])), tmp_path / "lut", 1)
    pinned(f"computed table, {name}", [done.unfit, done.cells, held_by(done.folder)])


def test_a_table_under_the_projector(tmp_path: Path, pinned: Pinned) -> None:
    task = task_of(bits=1, page="A6", hot_per_million=200.0)
    done = compute_table(replace(task, illuminations=task.illuminations[:3]), tmp_path / "lut", 1)
    pinned("computed table, the projector", held_by(done.folder))


def test_spectra_of_lights(pinned: Pinned) -> None:
    named = (
        "cie",
        "cie-d,cie-hp",
        "CIE-FL",
        "iso7589",
        "2000:5000:1000K",
        "daylight:4000:25000:7000K",
        "E",
        "D66",
        "5600",
    )
    named += ("2000-9000K", "daylight:3999", "daylight:25001", "A, D65 ,FL2", "A,A", "", "nothing", "1000K", "999K")
    found: dict[str, Any] = {}
    for name in named:
        lights = said(read_lights, name)
        found[name] = lights if isinstance(lights, dict) else [
            lights.source,
            [[one.name, one.cct_k] for one in lights.lights],
            np.array([one.power for one in lights.lights]),
            [[one.kind, one.cct_k, one.colour] for one in illuminations_of(lights.lights)],
        ]  # fmt: skip
    grid = np.arange(390, 731, 17)
    rows = "".join(f"{at},{1 + np.sin(at / 40):.5f}, {max(0.0, at - 600):.3f}\n" for at in grid[::-1])
    texts = {"unordered": f"Wavelength (nm),hall,cellar\n\n{rows}", "none": "wavelength,a\n"}
    texts["name"] = "wavelength,1.5\n400,1\n"
    for name, text in texts.items():
        lights = said(parse_spectra, text.encode(), "lamps.csv")
        found[name] = lights if isinstance(lights, dict) else [[one.name, one.power] for one in lights]
    pinned("spectra of lights", found)


def test_settings_of_tables(pinned: Pinned) -> None:
    documents: list[dict[str, Any]] = [
        {},
        {"window": 4},
        {"window": 9},
        {"room": {"blur_px": 1.0}},
        {"chart": {"bits": 6}},
    ]
    documents += [
        {"room": {"profile": "none"}},
        {"exposure": {"iso": 20}},
        {"seed": -1},
        {"camera": {"black": 100}},
        {"x": 1},
    ]
    documents.append({"seed": 5, "room": {"response_spread": 0.1}, "exposure": {"iso": 400}, "chart": {"page": "A4"}})
    found: list[Any] = []
    for document in documents:
        settings = said(parse_settings, document, "here")
        if isinstance(settings, dict):
            found.append(settings)
            continue
        found.append(
            [
                said(room_of, settings, "here"),
                settings.changed(None, {}) == settings,
                settings.changed(9, {"paper": "matt"}),
            ]
        )
    small = parse_settings({"chart": {"bits": 2}, "camera": {"black": 100}}, "here")
    task = table_task("Test", small, "here")
    found += [task.record, task.sample_bytes, len(task.illuminations), task.exposure]
    found += [stated_by_hand(None, None, []), stated_by_hand("n", None, []), said(stated_by_hand, None, "free", [])]
    pinned("settings of computed tables", {"tables": found})
