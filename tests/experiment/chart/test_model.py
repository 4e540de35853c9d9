"""`chart.json`: writing, reading, and refusal of bad files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiment.chart.layout import design_chart, paper_chart
from experiment.chart.model import Chart, load_chart
from foundation.errors import FormatError

pytestmark = pytest.mark.slow

# Written by hand from the description of the format, with unknown keys.
BY_HAND = """{"format": "crop.chart", "version": 1, "page_mm": [60, 40.5], "bits": 1, "cell_mm": [5, 4],
"made by": "hand",
"cells": {"centre_mm": [[1,2],[3,4],[5,6],[7,8],[9,10],[11,12],[13,14],[15,16.25]], "colour": [7,6,5,4,3,2,1,0]},
"tags": [{"family": "36h11", "id": 3, "corners_mm": [[20,20],[28,20],[28,28],[20,28]], "note": "x"}],
"references": [{"name": "white", "rgb": [255,255,255], "centre_mm": [30,30], "size_mm": [5,4]},
               {"name": "grey", "rgb": [99,99,99], "centre_mm": [40,30], "size_mm": [6,4]}]}"""


def test_reads_a_file_written_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "chart.json"
    path.write_text(BY_HAND)
    chart = load_chart(path)
    assert chart.page_mm == (60, 40.5)
    assert (chart.bits, chart.colour_count, chart.cell_mm) == (1, 8, (5, 4))
    assert chart.centres_mm.dtype == np.float64
    assert chart.centres_mm[7].tolist() == [15, 16.25]
    assert chart.colours.tolist() == [7, 6, 5, 4, 3, 2, 1, 0]
    assert chart.cell_of_colour.tolist() == [7, 6, 5, 4, 3, 2, 1, 0]
    # Index 6 is binary 110: red and green, no blue.
    assert chart.rgb[1].tolist() == [128, 128, 0]
    assert (chart.tags[0].family, chart.tags[0].id) == ("36h11", 3)
    assert chart.tags[0].corners_mm.tolist() == [[20, 20], [28, 20], [28, 28], [20, 28]]
    assert [reference.is_white for reference in chart.references] == [True, False]
    assert chart.white_references == (chart.references[0],)
    assert chart.references[1].size_mm == (6, 4)


@pytest.mark.parametrize("chart", [design_chart(1), design_chart(3, seed=4), paper_chart("A4", 3)])
def test_reads_what_it_saves(chart: Chart, tmp_path: Path) -> None:
    chart.save(tmp_path / "chart.json")
    again = load_chart(tmp_path / "chart.json")
    np.testing.assert_allclose(again.centres_mm, chart.centres_mm, rtol=0, atol=1e-6)
    assert again.to_json() == chart.to_json()
    assert again.sha256 == chart.sha256


def set_value(*keys: str | int, to: object) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        item: Any = document
        for key in keys[:-1]:
            item = item[key]
        item[keys[-1]] = to

    return change


def repeat_tags(document: dict[str, Any]) -> None:
    document["tags"] *= 2


def drop(key: str) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        del document[key]

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_value("format", to="crop.lut"), "format"),
        (set_value("version", to=2), "version"),
        (drop("page_mm"), "page_mm"),
        (set_value("page_mm", to=[60]), "page_mm"),
        (set_value("page_mm", 0, to=float("nan")), "page_mm"),
        (set_value("cell_mm", 0, to=0), "cell_mm"),
        (set_value("bits", to=6), "bits"),
        (set_value("bits", to=2), "64 colours"),
        (set_value("cells", "colour", 0, to=0), "one patch for each of its 8 colours"),
        (set_value("cells", "centre_mm", to=[[1, 2]]), "1 centres and 8 colours"),
        (set_value("cells", "centre_mm", 3, to=["a", 2]), "cells.centre_mm.3"),
        (set_value("tags", 0, "corners_mm", to=[[1, 2], [3, 4], [5, 6]]), "tags.0.corners_mm"),
        (set_value("tags", 0, "id", to=-1), "tags.0.id"),
        (set_value("references", 1, "rgb", to=[99, 99, 256]), "references.1.rgb"),
        (set_value("references", 1, "size_mm", to=[0, 1]), "references.1.size_mm"),
        (repeat_tags, "[3, 3]"),
    ],
)
def test_refuses_bad_chart(change: Callable[[dict[str, Any]], None], message: str, tmp_path: Path) -> None:
    document = json.loads(BY_HAND)
    change(document)
    path = tmp_path / "chart.json"
    path.write_text(json.dumps(document))
    with pytest.raises(FormatError) as refused:
        load_chart(path)
    assert message in str(refused.value)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("content", [b"", b"[]", b"\xff\xfe\x00"])
def test_refuses_files_without_json_object(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "chart.json"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=r"chart\.json: damaged") as refused:
        load_chart(path)
    assert "\n" not in str(refused.value)


def test_refuses_the_pdf_with_a_remedy(tmp_path: Path) -> None:
    pdf = tmp_path / "chart.pdf"
    pdf.write_bytes(b"%PDF-1.6\n\xff")
    with pytest.raises(FormatError) as caught:
        load_chart(pdf)
    assert "chart.json" in caught.value.remedy
