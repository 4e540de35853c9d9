"""Results of several transfers pooled: every image once, and what does not belong together refused."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.datasets.opening import open_scenes
from evaluation.experiments.bootstrap import paired
from evaluation.experiments.pool import TransferResults, make_tables, pool_transfers, read_transfer, save_pool
from evaluation.experiments.transfer.outcome import figures_of
from evaluation.experiments.transfer.rows import Kind, TransferRow
from evaluation.metrics import summarise
from evaluation.results.result import Result
from foundation.errors import FormatError, InputError

RANDOM = np.random.default_rng(5)
Errors = npt.NDArray[np.float64]


def errors(count: int, scale: float = 1.0) -> Errors:
    return np.abs(RANDOM.normal(2, 1, count)) * scale


def row(kind: Kind, *seeds: Errors, data: str = "made", method: str = "Trees", images: int = 9) -> TransferRow:
    results = tuple(
        Result(method, np.ones((len(each), 3)), {"recovery": each, "reproduction": 2 * each}, np.zeros(len(each), bool))
        for each in seeds
    )
    return TransferRow(method, kind, "" if kind in ("cross-validation", "none") else data, images, results)


def part(place: str, *rows: TransferRow, test: str | None = None, first: int = 0) -> TransferResults:
    count = len(rows[0].results[0].guessed)
    truths = np.stack([np.array([1.0, 2.0, 1 + number / 100]) for number in range(first, first + count)])
    names = tuple(f"{number}.png" for number in range(first, first + count))
    return TransferResults(place, test or place, names, truths, rows, "recovery")


def test_a_pooled_ratio_is_of_all_images_together() -> None:
    # A mean of the cameras' own medians or ratios would be another number: the second camera has five times the images
    # and five times the errors.
    real, made = (errors(30), errors(150, 5)), (errors(30, 2), errors(150, 5))
    parts = [
        part(
            f"camera {number}",
            row("cross-validation", real[number]),
            row("generated", made[number]),
            first=100 * number,
        )
        for number in range(2)
    ]
    found = figures_of(pool_transfers(parts).rows, "recovery")
    both = np.concatenate(made), np.concatenate(real)
    np.testing.assert_allclose(
        [figure.value for figure in found.to_real[0].ratios],
        np.array(summarise(both[0]).as_tuple()[:6]) / summarise(both[1]).as_tuple()[:6],
    )
    for compared, figure in zip(paired(*both), found.to_real[0].ratios, strict=True):
        assert (figure.low, figure.high) == pytest.approx(compared.ratio[1:])
    single = [summarise(one).median / summarise(other).median for one, other in zip(made, real, strict=True)]
    assert abs(found.to_real[0].ratios[1].value - np.mean(single)) > 0.1


def test_pairing_holds_across_folders() -> None:
    # Each image's error doubles: on any images drawn the ratio is 2. Unpaired, or with the folders in another order for
    # one row than for the other, it would not be.
    parts: list[TransferResults] = []
    for number in range(3):
        plain = errors(40, 1 + number)
        parts.append(part(f"{number}", row("cross-validation", plain), row("generated", 2 * plain), first=100 * number))
    for figure in figures_of(pool_transfers(parts).rows, "recovery").to_real[0].ratios:
        assert (figure.value, figure.low, figure.high) == pytest.approx((2, 2, 2))


def test_seeds_stay_apart() -> None:
    one, two = [errors(20), errors(20)], [errors(30), errors(30)]
    pool = pool_transfers([part("a", row("generated", *one)), part("b", row("generated", *two), first=50)])
    for seed in range(2):
        expected = np.concatenate([one[seed], two[seed]])
        np.testing.assert_array_equal(pool.rows[0].results[seed].errors["recovery"], expected)
    with pytest.raises(InputError, match=r"Trees .*2 in a, 1 in b"):
        pool_transfers([part("a", row("generated", *one)), part("b", row("generated", two[0]), first=50)])


def test_single_training_sets_are_matched_whatever_their_names() -> None:
    parts = [
        part("a", row("cross-validation", errors(9)), row("generated", errors(9), data="600d", images=700)),
        part("b", row("cross-validation", errors(9)), row("generated", errors(9), data="1ds", images=900), first=20),
    ]
    pool = pool_transfers(parts)
    assert [one.training for one in pool.rows] == ["real, cross-validated", "each camera's own: generated"]
    assert pool.rows[1].images == 700
    assert pool.images[9:11] == ("b/20.png", "b/21.png")
    assert not pool.notes


def test_several_training_sets_are_matched_by_their_names() -> None:
    first = part("a", row("generated", errors(9), data="codes"), row("generated", errors(9), data="dither"))
    other = part("b", row("generated", errors(9), data="dither"), row("generated", errors(9), data="veil"), first=20)
    pool = pool_transfers([first, other])
    assert [one.training for one in pool.rows] == ["dither: generated"]
    assert pool.notes == (
        "Left out, since not all of the results have them: Trees, generated, codes; Trees, generated, veil",
    )
    strange = part("c", row("generated", errors(9), data="x"), row("generated", errors(9), data="y"), first=40)
    with pytest.raises(InputError, match="no row in common"):
        pool_transfers([first, strange])


def test_an_image_that_would_count_twice_is_refused() -> None:
    rows = row("cross-validation", errors(9))
    with pytest.raises(InputError, match=r"8\.png .*of a and of b"):
        pool_transfers([part("a", rows), part("b", rows, first=8)])
    with pytest.raises(InputError, match=r"0\.png .*of a and of a"):
        pool_transfers([part("a", rows), part("a", rows)])
    with pytest.raises(InputError, match="no results to pool"):
        pool_transfers([])


def test_conditions_that_differ_are_told() -> None:
    made = [part(name, row("cross-validation", errors(9)), first=20 * at) for at, name in enumerate("abc")]
    alike = {"--side": "64", "the settings of Trees": "null"}
    parts = [replace(one, conditions=alike) for one in made]
    assert pool_transfers(parts).notes == ()
    parts[1] = replace(parts[1], conditions=alike | {"--side": "null"}, generated=True)
    assert pool_transfers(parts).notes == (
        "The results do not have the same conditions: --side is 64 in a, c; null in b",
        "Made by generate, so that they say nothing of real images: the test sets b",
    )


def test_the_same_name_under_another_light_is_another_image() -> None:
    one = part("a", row("cross-validation", errors(9)))
    other = TransferResults("b", "b", one.images, one.truths[:, ::-1] * [3, 2, 1], one.rows, "recovery")
    assert len(pool_transfers([one, other]).images) == 18


def test_halves_of_one_camera_are_one_test_set() -> None:
    parts = [
        part(
            f"{number}", row("cross-validation", errors(10)), row("generated", errors(10)), test=test, first=20 * number
        )
        for number, test in enumerate(("600D", "600D", "5DSR"))
    ]
    table = make_tables(pool_transfers(parts), "recovery").shown[-1]
    assert table.columns[2:] == ("600D, 20 images", "5DSR, 10 images")
    pooled = np.concatenate([part.rows[1].results[0].errors["recovery"] for part in parts[:2]])
    real = np.concatenate([part.rows[0].results[0].errors["recovery"] for part in parts[:2]])
    assert table.texts()[0][2].split(" / ")[0] == f"{np.median(pooled) / np.median(real):.2f}"


@pytest.mark.slow
def test_the_report_has_the_pool_the_test_sets_and_what_was_told(tmp_path: Path) -> None:
    def made(*kinds: Kind, tests: tuple[str, ...], base: str | None = None) -> str:
        parts = [
            part(f"{number}{test}", *(row(kind, errors(10)) for kind in kinds), test=test, first=20 * number)
            for number, test in enumerate(tests)
        ]
        pool = replace(pool_transfers(parts), notes=("A note & more",))
        out = tmp_path / f"{len(list(tmp_path.iterdir()))}"
        save_pool(pool, make_tables(pool, "recovery", base), ["one/here", "two"], "recovery", out)
        return (out / "report.html").read_text()

    text = made("cross-validation", "generated", "naive with matrix", tests=("A<b", "C"))
    assert "<h1>Transfer to A&lt;b + C</h1>" in text
    assert "20 images of A&lt;b (10 images), C (10 images)" in text
    assert "errors in parts of the same method&#39;s real cross-validation" in text
    assert "A note &amp; more" in text
    assert text.count("<svg") == 2
    assert text.count("Squares: each test set by itself.") == 2
    assert "made / naive with matrix" in text
    for table in ("intervals of these errors", "Each test set by itself", "in parts of those with the same pictures"):
        assert table in text
    asked = made("cross-validation", "generated", "naive with matrix", tests=("C",), base="real, cross-validated")
    assert "<h2>Against real, cross-validated</h2>" in asked
    assert asked.count("<svg") == 3
    assert "trained on real, cross-validated" in asked
    written = [json.loads(path.read_text())["base"] for path in sorted(tmp_path.glob("*/run.json"))]
    assert written == [None, "real, cross-validated"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a results folder as the command writes it."""
    from evaluation.experiments.transfer.outcome import TransferOutcome, save_outcome
    from evaluation.experiments.transfer.plan import TransferPlan

    place, random = tmp_path_factory.mktemp("made"), np.random.default_rng(1)
    names = np.array([f"{number}.png" for number in range(12)])
    images = random.uniform(0.1, 1, (12, 4, 4, 3)).astype(np.float32)
    np.savez(place / "real.npz", images=images, gt=random.dirichlet([40, 60, 40], 12), names=names)
    data = open_scenes(place / "real.npz")
    rows = (
        row("cross-validation", errors(12), errors(12)),
        row("generated", errors(12), errors(12), data="a, b"),
        row("none", errors(12), method="Gray-world", images=0),
    )
    outcome = TransferOutcome(
        *(data, data, TransferPlan((), (), ()), rows, figures_of(rows, "recovery")),
        folds=(np.arange(12) % 3,) * 2,
        settings={"error": "recovery"},
    )
    save_outcome(outcome, place / "out")
    return place / "out"


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    """Return a copy of it, which a test may damage."""
    return shutil.copytree(made, tmp_path / "out")


def test_a_folder_comes_back_as_it_was_written(folder: Path) -> None:
    found = read_transfer(folder)
    assert (found.test, found.error, len(found.images)) == ("real", "recovery", 12)
    assert [(one.method, one.training, one.images, len(one.results)) for one in found.rows] == [
        ("Trees", "real, cross-validated", 9, 2),
        ("Trees", "a, b: generated", 9, 2),
        ("Gray-world", "none", 0, 1),
    ]
    lines = list(csv.DictReader((folder / "results.csv").read_text().splitlines()))
    (told,) = [
        float(line["degrees"]) for line in lines if line["statistic"] == "median" and line["training"] == "generated"
    ]
    medians = [summarise(result.errors["recovery"]).median for result in found.rows[1].results]
    assert np.mean(medians) == pytest.approx(told, abs=2e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "before", "after", "message"),
    [
        ("run.json", '"crop.transfer"', '"crop.run"', "format 'crop.run', expected 'crop.transfer'"),
        ("run.json", "{", "", "is no JSON"),
        ("run.json", '"error"', '"mistake"', "does not say the 'error'"),
        ("results.csv", "method,", "procedure,", "is no table of a transfer: 'method'"),
        ("results.csv", ",generated,", ",imagined,", "has the training imagined; expected one of cross-validation"),
        ("errors.csv", "Trees, real", "Bushes, real", "errors.csv lacks Trees, real, cross-validated, seed 0"),
        ("errors.csv", "truth_r", "true_r", "has other images than .*, or lights are missing"),
    ],
)
def test_damage_is_named(folder: Path, file: str, before: str, after: str, message: str) -> None:
    text = (folder / file).read_text()
    assert before in text
    (folder / file).write_text(text.replace(before, after))
    with pytest.raises((FormatError, InputError), match=message):
        read_transfer(folder)


def test_what_is_not_there_is_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"run\.json.*name a folder"):
        read_transfer(tmp_path / "nothing")
    (folder / "results.csv").unlink()
    with pytest.raises(InputError, match=r"cannot read .*results.csv"):
        read_transfer(folder)
    assert json.loads((folder / "run.json").read_text())["format"] == "crop.transfer"
