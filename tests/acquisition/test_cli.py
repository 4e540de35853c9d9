"""The commands `acquire chart` and `acquire init`: files, output and exit codes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from pyapriltags import Detector

from acquisition.cli import main
from experiment.chart import layout
from experiment.chart.layout import design_chart
from experiment.chart.model import Chart, load_chart
from experiment.config import load_lab
from experiment.lights import load_illuminants, plan_illuminants, save_illuminants

Run = Callable[..., int]


@pytest.fixture
def chart(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Return a caller of `acquire chart` in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments: str) -> int:
        return main(["chart", *arguments])

    return call


@pytest.mark.slow
def test_writes_all_print_files(chart: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert chart("out", "--bits", "1") == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    assert printed.out.startswith("out: 8 colours, 4 tags, ")
    assert "patches of 5.29 mm" in printed.out
    assert sorted(path.name for path in Path("out").iterdir()) == [
        "PRINTING.txt",
        "chart.json",
        "chart.pdf",
        "chart.tif",
        "preview.png",
        "proof.pdf",
    ]
    saved = load_chart(Path("out/chart.json"))
    assert saved.seed == 1
    assert saved.sha256 == design_chart(1).sha256
    assert saved.sha256[:16] in Path("out/PRINTING.txt").read_text(encoding="utf-8")
    # The marks in the margins are not detected as tags.
    grey = tifffile.imread("out/chart.tif")[:, :, 1]
    found = Detector(families="tag36h11", nthreads=1, quad_decimate=1.0).detect(np.ascontiguousarray(grey))
    assert sorted(tag.tag_id for tag in found) == [tag.id for tag in saved.tags]


@pytest.mark.slow
def test_small_page_gets_small_patches(chart: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert chart("out", "--bits", "2", "--page", "A8", "--no-tiff") == 0
    printed = capsys.readouterr()
    assert printed.err == "", "a camera goes nearer to a small sheet, so its cells are as large in the frame"
    # 85 px: 16 × 10 slots, less 4 × 16 of tags, are the 64 colours and 32 references; of 90 px there are 15 × 9.
    assert "on 74 × 52 mm, patches of 3.60 mm" in printed.out
    assert not Path("out/chart.tif").exists()


@pytest.mark.slow
def test_warns_of_small_patches(chart: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert chart("out", "--bits", "2", "--page", "900x34", "--no-tiff") == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warning: patches of 2.12 mm are small for a camera")
    # 0.94 × 2601 and 3132 px for 900 mm: 2.72 and 3.27 px a millimetre, of which a module has 0.847 and a cell 2.117.
    assert "EOS 550D: 5.8 px a patch, 2.3 px a tag module; EOS 6D Mark II: 6.9 px a patch, 2.8 px a tag module" in line
    assert load_chart(Path("out/chart.json")).cell_mm[0] == pytest.approx(50 * 25.4 / 600)


@pytest.mark.slow
def test_arranges_chart_of_paper(chart: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert chart("out", "--arrangement", "paper", "--bits", "2", "--page", "A6", "--no-tiff") == 0
    assert "64 colours, 0 tags, 10 references on 148 × 105 mm, patches of 16.47 × 11.09 mm" in capsys.readouterr().out
    assert load_chart(Path("out/chart.json")).tags == ()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--page", "A5"), "32768"),
        (("--page", "1e9x1e9"), "10000 mm"),
    ],
)
def test_refuses_impossible_page(
    chart: Run, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], message: str
) -> None:
    assert chart("out", *arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert message in line
    assert not Path("out").exists()


def begun(folder: Path) -> Path:
    """Return a folder with a small chart and few lights, which `acquire init` leaves alone."""
    (folder / "chart").mkdir(parents=True)
    design_chart(2, None, 1).save(folder / "chart" / "chart.json")
    save_illuminants(plan_illuminants(1, [5000.0]), folder / "illuminations.csv")
    return folder


@pytest.mark.parametrize(("options", "rig"), [([], "lab"), (["--rig", "simulated"], "simulated")])
def test_init_keeps_existing_files(
    options: list[str], rig: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lab = begun(tmp_path / "lab")
    before = (lab / "chart" / "chart.json").read_bytes(), (lab / "illuminations.csv").read_bytes()
    assert main(["init", str(lab), *options]) == 0
    assert ((lab / "chart" / "chart.json").read_bytes(), (lab / "illuminations.csv").read_bytes()) == before
    settings = load_lab(lab / "LAB.toml")
    assert settings.rig == rig
    assert settings.chart.is_file()
    assert settings.illuminations.is_file()
    assert f"acquire check {lab / 'LAB.toml'}" in capsys.readouterr().out


def test_init_never_overwrites_settings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lab = begun(tmp_path)
    (lab / "LAB.toml").write_text("mine")
    assert main(["init", str(lab)]) == 2
    assert (lab / "LAB.toml").read_text() == "mine"
    assert "LAB.toml" in capsys.readouterr().err


@pytest.mark.slow
def test_init_fills_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = list[object]()

    def designed(*design: object) -> Chart:
        asked.append(design)
        return design_chart(1)

    monkeypatch.setattr(layout, "design_chart", designed)
    lab = tmp_path / "new" / "lab"
    assert main(["init", str(lab), "--rig", "simulated"]) == 0
    assert asked == [(5, None)], "the chart of all colours, of which a small one is drawn here"
    assert len(load_illuminants(lab / "illuminations.csv")) == 707
    names = {path.name for path in (lab / "chart").iterdir()}
    assert names == {"chart.json", "chart.pdf", "preview.png", "proof.pdf", "PRINTING.txt"}


@pytest.mark.slow
def test_init_makes_a_chart_of_the_given_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def small(bits: int, page: str | None) -> Chart:
        return design_chart(1, page)

    monkeypatch.setattr(layout, "design_chart", small)
    assert main(["init", str(tmp_path / "lab"), "--page", "A5"]) == 0
    # ISO 216: A5 is 148 mm × 210 mm.
    assert load_chart(load_lab(tmp_path / "lab" / "LAB.toml").chart).page_mm == (210, 148)


@pytest.mark.parametrize("name", ["", "chart.json"])
@pytest.mark.parametrize("folder", ["print", "lab/my print"])
def test_init_takes_an_existing_chart(name: str, folder: str, tmp_path: Path) -> None:
    lab, drawn = begun(tmp_path / "lab"), design_chart(2)
    (tmp_path / folder).mkdir()
    drawn.save(tmp_path / folder / "chart.json")
    assert main(["init", str(lab), "--chart", str(tmp_path / folder / name)]) == 0
    settings = load_lab(lab / "LAB.toml")
    assert load_chart(settings.chart).sha256 == load_chart(tmp_path / folder / "chart.json").sha256
    is_inside = folder.startswith("lab/")
    assert ('chart = "my print/chart.json"' in (lab / "LAB.toml").read_text()) is is_inside


@pytest.mark.parametrize("options", [("--chart", "missing"), ("--page", "A3"), ("--page", "A3", "--chart", "missing")])
def test_init_refuses_a_chart_that_it_cannot_use(options: tuple[str, ...], tmp_path: Path) -> None:
    lab = begun(tmp_path / "lab")
    assert main(["init", str(lab), *options]) == 2
    assert not (lab / "LAB.toml").exists()
