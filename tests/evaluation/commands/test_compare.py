"""`evaluate compare`, run as a command."""

from __future__ import annotations

import csv
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from evaluation.cli import main

pytestmark = pytest.mark.slow

HEAD = "image,method,truth_r,truth_g,truth_b,recovery,reproduction,guessed\n"


@pytest.fixture
def runs(tmp_path: Path) -> tuple[str, str]:
    """Return two runs of methods A and B on 30 images; the second has smaller errors of A and one image less."""
    random = np.random.default_rng(1)
    hard = random.gamma(1.5, 2, 30)
    folders = tmp_path / "first", tmp_path / "second"
    for folder, gain in zip(folders, (1, 0.7), strict=True):
        folder.mkdir()
        lines = [
            f"im {number},{method},1,2,1,{error / 2:.6f},{error:.6f},0\n"
            for number in range(30 if gain == 1 else 29)
            for method, error in (("A", gain * hard[number]), ("B <i>", 2 + hard[number]))
        ]
        (folder / "errors.csv").write_text(HEAD + "".join(lines))
    return str(folders[0]), str(folders[1])


def test_two_runs(runs: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", *runs]) == 0
    printed = capsys.readouterr().out
    first, second = runs
    assert f"A ({second}) lacks 1 image of A ({first}), excluded here: im 29" in printed
    assert f"A ({second}) on 0 of 29 images, larger on 29, equal on 0: A ({second}) is better" in printed
    assert f"B <i> ({second}) on 0 of 29 images, larger on 0, equal on 29: not" in printed


def test_accepts_short_method_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = ("Gray-world", "PCA bright and dark", "Shades-of-Gray (p=4)", "Own")
    lines = [
        f"im {number},{name},1,2,1,1.5,{1 + index + number / 10},0\n"
        for number in range(9)
        for index, name in enumerate(names)
    ]
    (tmp_path / "errors.csv").write_text(HEAD + "".join(lines))
    assert main(["compare", str(tmp_path), "--method", "pca", "--method", "shades-of-gray:p=4"]) == 0
    output = capsys.readouterr().out
    assert "PCA bright and dark has smaller errors than Shades-of-Gray (p=4) on 9 of 9 images" in output


def test_refuses_runs_without_common_method(runs: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    path = Path(runs[1]) / "errors.csv"
    path.write_text(path.read_text().replace(",A,", ",C,").replace(",B <i>,", ",D,"))
    assert main(["compare", *runs]) == 2
    assert "--method FIRST=SECOND" in capsys.readouterr().err
    path.write_text(path.read_text().replace(",1,2,1,", ",1,1,1,"))
    assert main(["compare", *runs, "--method", "A=C"]) == 2
    assert f"im 0 in A ({runs[0]}) and C ({runs[1]}) differ by 19.47 degrees" in capsys.readouterr().err


def test_compares_results_folders(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "one"
    assert main(["run", str(dataset), "--method", "white-patch,gray-world", "--out", str(out)]) == 0
    shutil.copytree(out, tmp_path / "two")
    capsys.readouterr()
    assert main(["compare", str(out), str(tmp_path / "two")]) == 0
    printed = capsys.readouterr().out
    assert "on 0 of 8 groups of 16 images, larger on 0, equal on 8" in printed
    assert main(["compare", str(out)]) == 0
    # Random codes: white is in every image, and grey on average only by chance.
    assert "White-Patch has smaller errors than Gray-world on 8 of 8 groups of 16 images" in capsys.readouterr().out


def test_reports_different_treatments(runs: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    for folder, black in zip(runs, ("0", "500"), strict=True):
        record = {"data_set": {"place": "photos"}, "treatment": {"black level": black, "mask": "none"}}
        (Path(folder) / "run.json").write_text(json.dumps(record))
    assert main(["compare", *runs]) == 0
    notes = [line for line in capsys.readouterr().out.splitlines() if "the runs differ in" in line]
    assert notes == ["the runs differ in black level: first 0, second 500"]


def test_writes_tables_and_page(runs: tuple[str, str], tmp_path: Path) -> None:
    out = tmp_path / "comparison"
    assert main(["compare", *runs, "--out", str(out)]) == 0
    assert {path.name for path in out.iterdir()} == {"tests.csv", "statistics.csv", "tables.tex", "report.html"}
    rows = list(csv.DictReader((out / "statistics.csv").read_text().splitlines()))
    assert [row["Statistic"] for row in rows[:7]] == [
        *("Mean", "Med.", "Tri.", "Best 25%", "Worst 25%", "Avg.", "Worst 5%")
    ]
    assert float(rows[0]["Ratio"]) == pytest.approx(1 / 0.7, rel=1e-5)
    page = (out / "report.html").read_text()
    assert "B &lt;i&gt;" in page
    assert page.count("<svg") == 2
    assert main(["compare", *runs, "--out", str(out)]) == 2


def test_writes_figures_for_papers(runs: tuple[str, str], tmp_path: Path) -> None:
    for form in ("pdf", "svg"):
        for name in ("one", "two"):
            assert main(["compare", *runs, "--figures", form, "--out", str(tmp_path / form / name)]) == 0
    pdf, svg = (tmp_path / form / "one" / f"scatter_1.{form}" for form in ("pdf", "svg"))
    # Fonts are embedded as TrueType (FontFile2 of ISO 32000-1, table 126), not as Type 3.
    assert pdf.read_bytes()[:5] == b"%PDF-"
    assert b"/FontFile2" in pdf.read_bytes()
    assert b"/Type3" not in pdf.read_bytes()
    assert not re.search(rb"var\(--|<text", svg.read_bytes())
    for path in (pdf, svg):
        assert path.read_bytes() == (path.parents[1] / "two" / path.name).read_bytes()


def test_figures_need_results_folder(runs: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", *runs, "--figures", "pdf"]) == 2
    assert "add --out" in capsys.readouterr().err
