"""`evaluate run` with the user class of the documentation, and with estimates of other programs."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

from evaluation.cli import main
from evaluation.datasets import open_scenes
from evaluation.metrics import recovery_error, summarise

HOW_TO = Path(__file__).parents[3] / "docs" / "how-to" / "evaluate.md"


@pytest.fixture
def thumbnails(tmp_path: Path) -> Path:
    """Return an archive of nine thumbnails whose brightest pixels have the colour of the illuminant."""
    random = np.random.default_rng(5)
    lights = random.random((9, 3)) + 0.4
    images = (random.random((9, 16, 16, 1)) * lights[:, None, None]).astype(np.float32)
    path = tmp_path / "thumbs.npz"
    np.savez(path, images=images, gt=lights, names=[f"image {number}.png" for number in range(9)])
    return path


def write_example(folder: Path) -> None:
    """Write the example of the how-to page into a folder."""
    match = re.search(r"```python (\w+\.py)\n(.*?)```", HOW_TO.read_text(encoding="utf-8"), re.DOTALL)
    assert match is not None
    (folder / match[1]).write_text(match[2], encoding="utf-8")


@pytest.mark.slow
def test_example_of_the_documentation(
    thumbnails: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_example(tmp_path)
    (command,) = re.findall(r"^    evaluate (run DATA --method brightest\.py.*)$", HOW_TO.read_text(), re.MULTILINE)
    assert main([str(thumbnails) if word == "DATA" else word for word in command.split()]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"│ Brightest percent │ 0\.00", printed)
    assert re.search(r"│ Gray-world +│ 0\.00", printed)
    record = json.loads((tmp_path / "RESULTS" / "run.json").read_text())
    assert record["methods"][0]["class"] == "brightest.py:Brightest"
    assert len(record["methods"][0]["file_sha256"]) == 64
    rows = list(csv.DictReader((tmp_path / "RESULTS" / "results.csv").read_text().splitlines()))
    assert {row["method"] for row in rows} == {"Brightest percent", "Gray-world"}


@pytest.mark.slow
def test_evaluates_estimates_of_another_program(
    thumbnails: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenes = open_scenes(thumbnails).scenes
    lines = [f"{scene.name.removesuffix('.png')},1,1,1" for scene in scenes]
    (tmp_path / "grey.csv").write_text("image,r,g,b\n" + "\n".join(lines[::-1]))
    (tmp_path / "bad.csv").write_text("\n".join(["image,r,g,b", f"{scenes[0].name},nan,1,1", *lines[1:]]))
    options = ("--method", f"{tmp_path}/grey.csv,NoNo={tmp_path}/bad.csv")
    assert main(["run", str(thumbnails), *options, "--error", "recovery", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    expected = summarise(recovery_error([1, 1, 1], np.stack([scene.truth for scene in scenes])))
    for row in printed["errors"]:
        assert row["method"] in ("grey", "NoNo")
        if row["error"] == "recovery":
            assert row["median"] == pytest.approx(expected.median)
            assert row["below3"] == pytest.approx(expected.below3)
            assert row["no_estimate"] == (row["method"] == "NoNo")
    assert printed["notes"] == []
    assert main(["run", str(thumbnails), *options]) == 0
    replaced = "grey was used as their estimate"
    out = capsys.readouterr().out
    assert f"NoNo: no estimate for 1 of 9 images (image 0.png returned nan 1 1); {replaced}" in out
    assert "Gray-world" not in out  # Nothing but what was asked for.


@pytest.mark.slow
def test_output_of_a_method_is_not_in_json(
    thumbnails: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "chatty.py").write_text(
        "class Chatty:\n    name = 'Chatty'\n\n    def estimate(self, image, saturation=None, mask=None):\n"
        "        print('here')\n        return [1, 1, 1]\n"
    )
    assert main(["run", str(thumbnails), "--method", f"{tmp_path}/chatty.py:Chatty", "--json"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["errors"][0]["method"] == "Chatty"
    assert printed.err.count("here") == 9
