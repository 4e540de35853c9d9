"""A lab that is begun: what it needs, and nothing that was there is touched."""

from __future__ import annotations

from pathlib import Path

import pytest

from acquisition.cli import main
from experiment.chart import layout
from experiment.chart.layout import design_chart
from experiment.chart.model import Chart
from experiment.config import load_lab
from experiment.lights import load_illuminations, plan_illuminations, save_illuminations


def begun(folder: Path) -> Path:
    """Return a folder with a small chart and few lights, which `acquire init` leaves alone."""
    (folder / "chart").mkdir(parents=True)
    design_chart(2, None, 1).save(folder / "chart" / "chart.json")
    save_illuminations(plan_illuminations(1, [5000.0]), folder / "illuminations.csv")
    return folder


@pytest.mark.parametrize(("options", "rig"), [([], "lab"), (["--rig", "simulated"], "simulated")])
def test_what_is_there_stays_and_the_rest_is_written(
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


def test_settings_are_never_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lab = begun(tmp_path)
    (lab / "LAB.toml").write_text("mine")
    assert main(["init", str(lab)]) == 2
    assert (lab / "LAB.toml").read_text() == "mine"
    assert "LAB.toml" in capsys.readouterr().err


@pytest.mark.slow
def test_an_empty_folder_gets_the_whole_experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = list[object]()

    def designed(*design: object) -> Chart:
        asked.append(design)
        return design_chart(1)

    monkeypatch.setattr(layout, "design_chart", designed)
    lab = tmp_path / "new" / "lab"
    assert main(["init", str(lab), "--rig", "simulated"]) == 0
    assert asked == [(5, None)], "the chart of all colours, of which a small one is drawn here"
    assert len(load_illuminations(lab / "illuminations.csv")) == 707
    names = {path.name for path in (lab / "chart").iterdir()}
    assert names == {"chart.json", "chart.pdf", "preview.png", "proof.pdf", "PRINTING.txt"}
