"""The command `evaluate`: output, files and exit codes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import pytest
from fsspec.core import url_to_fs

from evaluation.cli import main
from evaluation.experiments import run_folder

pytestmark = pytest.mark.slow


def test_reads_dataset_from_object_store(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(dataset), "--method", "white-patch"]) == 0
    table = capsys.readouterr().out.splitlines()[1:]
    store, top = url_to_fs("memory://evaluated/set")
    for path in dataset.rglob("*"):
        if path.is_file():
            store.pipe_file(f"{top}/{path.relative_to(dataset).as_posix()}", path.read_bytes())
    assert main(["memory://evaluated/set/", "--method", "white-patch"]) == 0
    title, *same = capsys.readouterr().out.splitlines()
    assert title == "set: reproduction angular error of 16 images, degrees"
    assert same == table
    assert main(["memory://evaluated/nothing"]) == 2
    assert "memory://evaluated/nothing is not a data set" in capsys.readouterr().err


def test_counts_images_without_usable_pixel(
    make_dataset: Callable[[int, int], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(make_dataset(12, 12))]) == 0
    notes = capsys.readouterr().out.rpartition("┘")[2].partition("black level: ")[0]
    reason = "no usable pixel in 16 of 16 images (too small for it, clipped, black or uniform)"
    assert notes.split("\n") == [
        "",
        f"General Gray-world: {reason}; grey was used as their estimate",
        f"1st-order Gray-Edge: {reason}; grey was used as their estimate",
        "",
    ]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("lut",), "has no supported layout"),
        (("made", "--out", "lut"), "lut already exists; choose another place for the results"),
        (("made", "--method", "none.npz"), "none.npz"),
        (("made", "--method", "lut/illuminations.csv"), "expected image,r,g,b"),
    ],
)
def test_refuses_with_one_sentence(
    dataset: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    message: str,
) -> None:
    monkeypatch.chdir(dataset.parent)
    monkeypatch.setattr(run_folder, "evaluate", Mock(side_effect=AssertionError("the work must not begin")))
    Path("empty").mkdir()
    files = {path: path.is_file() and path.read_bytes() for path in Path().rglob("*")}
    assert main([*arguments]) == 2
    assert message in capsys.readouterr().err
    assert {path: path.is_file() and path.read_bytes() for path in Path().rglob("*")} == files


def test_run_refuses_learner_and_suggests_train(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["split", "--method", "kernel-ridge"]) == 2
    assert "evaluate cv kernel-ridge" in " ".join(capsys.readouterr().err.split())
