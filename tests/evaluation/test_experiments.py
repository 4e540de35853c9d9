"""Methods over a generated dataset, in Python and from the command line."""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from fsspec.core import url_to_fs

from acquisition.lights.illuminations import Illumination
from calibration.table.lut import LutWriter, Provenance, open_lut
from drivers.presenter import Colour
from evaluation import experiments
from evaluation.cli import main
from evaluation.datasets import open_scenes
from evaluation.experiments import evaluate, images_csv, table_csv
from evaluation.methods import GrayEdge, standard_methods
from foundation.errors import InputError
from generator.dataset.reader import generate_dataset
from generator.pictures.sources import random_scenes

LIGHTS = np.array([[2000.0, 3000, 1000], [1500, 3000, 2500]])


@pytest.fixture
def dataset(make_dataset: Callable[[int, int], Path]) -> Path:
    """Return a dataset of images of 96 x 64 px."""
    return make_dataset(96, 64)


@pytest.fixture
def make_dataset(tmp_path: Path) -> Callable[[int, int], Path]:
    """Return a maker of datasets of 8 random scenes whose colours reflect as their code, under two lights, no noise."""
    folder = tmp_path / "lut"
    folder.mkdir()
    index = np.arange(512)
    code = np.stack([index >> 6, index >> 3 & 7, index & 7], axis=-1) / 7
    writer = LutWriter(folder, 2, 512, 2)
    for number, light in enumerate(LIGHTS):
        writer.put(number, np.rint(code * light)[:, None, :].repeat(2, axis=1).astype(np.uint16))
    known = Provenance(camera="Test", bits=3, white_level=9000, session_sha256="0", chart_sha256="0", software="test")
    plan = [Illumination(number, "uniform", None, Colour(1, 2, 3)) for number in range(2)]
    writer.finish(plan, LIGHTS, known)

    def make(width: int, height: int) -> Path:
        scenes = random_scenes(8, width, height)
        generate_dataset(open_lut(folder), tmp_path / "made", scenes, [0, 1], previews=False)
        return tmp_path / "made"

    return make


def test_grey_on_average_is_what_gray_world_finds(dataset: Path) -> None:
    scenes = open_scenes(dataset)
    assert [scene.name for scene in scenes] == [f"{number:06d}.png" for number in range(16)]
    assert {scene.saturation for scene in scenes} == {9000.0}
    methods = [GrayEdge("Gray-world", 0, 1, 0), GrayEdge("White-Patch", 0, np.inf, 0)]
    results = evaluate(scenes, methods)
    # 5828 pixels of uniform codes: each channel's mean is off by 0.8 %, an angle of well below a degree.
    assert results[0].summary("recovery").worst25 < 1.5
    assert results[1].summary("reproduction").worst25 < 1e-6
    parallel = evaluate(scenes, methods, workers=3)
    for one, other in zip(results, parallel, strict=True):
        np.testing.assert_array_equal(one.estimates, other.estimates)


def test_the_tables_as_text(dataset: Path) -> None:
    scenes = open_scenes(dataset)
    results = evaluate(scenes, [GrayEdge("Gray-world", 0, 1, 0)])
    rows = list(csv.DictReader(table_csv(results, "recovery").splitlines()))
    assert list(rows[0]) == ["method", "mean", "median", "trimean", "best25", "worst25", "avg"]
    assert float(rows[0]["mean"]) == pytest.approx(results[0].errors["recovery"].mean(), abs=1e-6)
    images = list(csv.DictReader(images_csv(scenes, results).splitlines()))
    assert len(images) == 16
    assert float(images[3]["reproduction"]) == pytest.approx(results[0].errors["reproduction"][3], abs=1e-6)


def test_nothing_to_evaluate_is_said(dataset: Path) -> None:
    with pytest.raises(InputError, match="0 methods on 16 images"):
        evaluate(open_scenes(dataset), [])


@dataclass(frozen=True)
class Flat:
    """A scene of one colour that says when it is read."""

    name: str
    truth: npt.NDArray[np.float64]
    log: list[str]
    saturation: float | None = None

    def read(self) -> tuple[npt.NDArray[np.float32], None]:
        self.log.append(self.name)
        return np.ones((8, 8, 3), np.float32), None


@pytest.mark.parametrize("light", [(0, 0, 0), (np.nan, 1, 1), (np.inf, 1, 1), (1, 1, -1)])
def test_a_scene_without_a_light_is_named_before_the_work(light: tuple[float, ...]) -> None:
    read: list[str] = []
    good, dark = Flat("good.png", np.ones(3), read), Flat("dark.png", np.array(light), read)
    methods = [GrayEdge("Gray-world", 0, 1, 0)]
    evaluate([good], methods)
    with pytest.raises(InputError, match=r"the ground truth of dark\.png is .*, expected red, green and blue"):
        evaluate([good, dark], methods)
    assert read == ["good.png"]


def test_images_without_a_usable_pixel_are_told_from_grey_ones() -> None:
    truth = np.array([1.0, 2.0, 1.0])
    scenes = [Flat("grey.png", truth, []), Flat("clipped.png", truth, [], 1.0), Flat("grey.png", truth, [])]
    (flat, edges) = evaluate(scenes, [GrayEdge("Gray-world", 0, 1, 0), GrayEdge("Gray-Edge", 1, 1, 1)])
    assert flat.guessed.tolist() == [False, True, False]
    assert edges.guessed.all()
    np.testing.assert_allclose(np.stack([*flat.estimates, *edges.estimates]), 3**-0.5)


def call(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["evaluate", *arguments])
    return main()


def test_a_dataset_on_a_store(
    dataset: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(monkeypatch, str(dataset), "--methods", "white-patch") == 0
    table = capsys.readouterr().out.splitlines()[1:]
    store, top = url_to_fs("memory://evaluated/set")
    for path in dataset.rglob("*"):
        if path.is_file():
            store.pipe_file(f"{top}/{path.relative_to(dataset).as_posix()}", path.read_bytes())
    assert call(monkeypatch, "memory://evaluated/set/", "--methods", "white-patch") == 0
    title, *same = capsys.readouterr().out.splitlines()
    assert title == "set: reproduction angular error of 16 images, degrees"
    assert same == table
    assert call(monkeypatch, "memory://evaluated/nothing") == 2
    assert "memory://evaluated/nothing is no dataset" in capsys.readouterr().err


def test_the_command(dataset: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    table, images = dataset.parent / "table.csv", dataset.parent / "images.csv"
    wish = ("--methods", "white-patch,gray-world", "--csv", str(table), "--images", str(images))
    assert call(monkeypatch, str(dataset), *wish) == 0
    printed = capsys.readouterr().out
    assert "reproduction angular error of 16 images" in printed
    heads = [printed.index(head) for head in ("Mean", "Med.", "Tri.", "Best 25%", "Worst 25%", "Avg.")]
    assert heads == sorted(heads)
    assert printed.index("White-Patch") < printed.index("Gray-world")
    assert [row.split(",")[0] for row in table.read_text().splitlines()] == ["method", "White-Patch", "Gray-world"]
    assert len(images.read_text().splitlines()) == 33


def test_the_command_counts_images_without_a_usable_pixel(
    make_dataset: Callable[[int, int], Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(monkeypatch, str(make_dataset(12, 12))) == 0
    after = capsys.readouterr().out.rpartition("┘")[2]
    told = "no usable pixel in 16 of 16 images (too small for it, clipped, black or even); their light was taken to be"
    assert after.split("\n") == [
        "",
        f"General Gray-world: {told} grey",
        f"1st-order Gray-Edge: {told} grey",
        "",
    ]


@pytest.mark.parametrize("place", [".", "../set[a-1]", "splits/.."])
def test_the_table_names_the_dataset(
    dataset: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], place: str
) -> None:
    folder = dataset.rename(dataset.with_name("set[a-1]"))
    (folder / "splits").mkdir()
    monkeypatch.chdir(folder)
    assert call(monkeypatch, place, "--methods", "gray-world") == 0
    assert capsys.readouterr().out.startswith("set[a-1]: reproduction angular error of 16 images, degrees\n")


def test_a_file_gets_the_whole_table_however_narrow_the_terminal(
    dataset: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "30")
    assert call(monkeypatch, str(dataset)) == 0
    first, *table = capsys.readouterr().out.splitlines()
    assert first == "made: reproduction angular error of 16 images, degrees"
    assert {len(line) for line in table} == {len(table[0])}
    for method in standard_methods().values():
        assert [line for line in table if method.name in line and len(re.findall(r"\d\.\d\d ", line)) == 6]


def test_a_narrow_terminal_cuts_no_number(
    dataset: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # By which rich takes any output for a terminal.
    printed: dict[int, str] = {}
    for columns in (30, 75, 120):
        monkeypatch.setenv("COLUMNS", str(columns))
        assert call(monkeypatch, str(dataset)) == 0
        printed[columns] = re.sub(r"\x1b\[[\d;]*m", "", capsys.readouterr().out)
    numbers = {columns: re.findall(r"\d\.\d\d ", text) for columns, text in printed.items()}
    assert len(numbers[120]) == 6 * len(standard_methods())
    assert numbers[30] == numbers[75] == numbers[120]
    assert max(map(len, printed[75].splitlines())) <= 75
    for word in ("Gray-world", "2nd-order", "Worst 25%"):
        assert all(word in text for text in printed.values())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("made", "--methods", "magic"), "'magic' is no method; the methods are white-patch"),
        (("lut",), "is no dataset"),
        (("made", "--csv", "made"), "made already exists; name another place for the table"),
        (("made", "--csv", "made/gt.txt"), "made/gt.txt already exists; name another place for the table"),
        (("made", "--images", "empty"), "empty already exists; name another place for the images' errors"),
        (("made", "--csv", "new.csv", "--images", "lut/../new.csv"), "are both lut/../new.csv; give each a file"),
    ],
)
def test_what_cannot_be_done_is_one_sentence(
    dataset: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    message: str,
) -> None:
    def never(*given: object) -> None:
        pytest.fail("the work must not begin")

    monkeypatch.chdir(dataset.parent)
    monkeypatch.setattr(experiments, "evaluate", never)
    Path("empty").mkdir()
    before = {path: path.is_file() and path.read_bytes() for path in Path().rglob("*")}
    assert call(monkeypatch, *arguments) == 2
    assert message in capsys.readouterr().err
    assert {path: path.is_file() and path.read_bytes() for path in Path().rglob("*")} == before
