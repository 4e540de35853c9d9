"""What the page of a known table is told, as it was before."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from foundation.local_server import Refusal, Request
from generator.explore.explorer import Explorer, ExploreServer
from generator.pictures.sources import Preparation, find_pictures
from tests.generator.dataset.known import table_in
from tests.generator.said import said
from tests.pinned import Pinned

pytestmark = pytest.mark.slow

LIGHTS = ("0", "1:.3+2:.7", "r=.3,b=.3", "r=.9,b=.05", "5600K", "E", "9", "")


def png(seed: int, height: int, width: int) -> bytes:
    codes = np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)
    return cv2.imencode(".png", codes)[1].tobytes()


def test_what_the_page_is_told(tmp_path: Path, pinned: Pinned, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("in folder").mkdir()
    Path("in folder/a.png").write_bytes(png(1, 30, 47))
    sources = find_pictures(["in folder"], Preparation(max_side=20))
    explorer = Explorer("lut", table_in(Path("lut")), sources, 20)
    found: dict[str, Any] = {"added": explorer.add("/x/-b\n.PNG", png(2, 9, 8))}
    for number in (0, 1, 2):
        for light in LIGHTS[number : number + 6]:
            found[f"shown {number} {light}"] = said(explorer.show, number, light)
        for light in LIGHTS[:3]:
            for rendering in ("codes", "colorimetric"):
                counts = said(explorer.counts, number, light, rendering)
                pixel = said(explorer.pixel, number, light, rendering, 3, 5)
                found[f"counts {number} {light} {rendering}"] = [
                    counts if isinstance(counts, dict) else counts.copy(),
                    pixel,
                ]
    found["outside"] = [said(explorer.pixel, 1, "0", "codes", x, y) for x, y in ((8, 0), (0, 9), (-1, 0), (7, 8))]
    dropped = [explorer.add(f"{number}.png", png(number, 4, 4)) for number in range(8)]
    found["dropped"] = [dropped, said(explorer.show, 1, "0"), said(explorer.show, 2, "0")["picture"]]
    with ExploreServer(explorer, "127.0.0.1", 0) as server:
        query = {"picture": "0", "light": "1", "x": "3", "y": "2"}
        asked = [
            Request("table.json"),
            Request("shown.json", query),
            Request("counts", query),
            Request("pixel.json", query),
        ]
        asked += [
            Request("other"),
            Request("counts", {**query, "rendering": "no"}),
            Request("counts", {"picture": "x"}),
        ]
        asked += [Request("shown.json", {"picture": "1234567890"}), Request("picture", {"name": "c.png"}, png(3, 5, 6))]
        asked += [Request("other", {}, b"1"), Request("picture", {}, b"no picture")]
        answers = [server.answer(request) for request in asked]
        page = server.answer(Request(""))
    found["answers"] = [
        one if isinstance(one, Refusal) else json.loads(one.body) if one.kind.endswith("json") else [one.kind, one.body]
        for one in answers
    ]
    assert not isinstance(page, Refusal)
    found["page"] = [page.kind, b"Explore Known camera" in page.body, sorted(page.headers)]
    pinned("what the page of a table is told", found)
