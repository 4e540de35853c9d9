"""`evaluate describe` as a user meets it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.cli import main
from tests.evaluation.datasets.made_up import nus8

pytestmark = pytest.mark.slow


@pytest.fixture
def thumbnails(tmp_path: Path) -> str:
    """Return an archive of 12 thumbnails of random colours."""
    random = np.random.default_rng(1)
    lights = np.array([0.6, 1, 0.5]) * np.exp(random.normal(0, 0.1, (12, 3)))
    images = np.exp(random.normal(-2, 0.6, (12, 16, 16, 3))) * lights[:, None, None]
    path = tmp_path / "real [1].npz"
    np.savez(path, images=images.astype(np.float32), gt=lights, names=np.array([f"im{number}" for number in range(12)]))
    return str(path)


def test_sets_of_one_name_are_told_apart(thumbnails: str, capsys: pytest.CaptureFixture[str]) -> None:
    stats = Path(thumbnails).parent / "s.json"
    assert main(["describe", thumbnails, "--out", str(stats)]) == 0
    capsys.readouterr()
    assert main(["describe", thumbnails, "--against", str(stats)]) == 0
    printed = capsys.readouterr().out
    assert f"in real [1] ({thumbnails}), " in printed
    assert f"in real [1] ({stats}): 1.00 times as much" in printed


def test_options_of_the_set_beside(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nus8(tmp_path / "nus")
    place = str(tmp_path / "nus")
    (tmp_path / "nus" / "SonyA57" / "SonyA57_0003.PNG").unlink()
    assert main(["describe", str(dataset), "--against", place, "--against-camera", "SonyA57"]) == 2
    assert "SonyA57_0003" in capsys.readouterr().err
    options = ["--against-camera", "SonyA57", "--against-partial"]
    assert main(["describe", str(dataset), "--against", place, *options]) == 0
    printed = capsys.readouterr().out
    assert "│ made        │     16 │" in printed
    assert "│ NUS SonyA57 │      1 │" in printed  # Neither Nikon's two images nor the one that is missing.
    assert main(["describe", str(dataset), "--against", str(dataset), "--against-subset", "test"]) == 2
    assert "was not divided; generate --split" in capsys.readouterr().err


def test_options_that_nothing_is_read_by_are_refused(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["describe", str(dataset), "--against-subset", "test"]) == 2
    assert "no data set beside DATA; add --against" in capsys.readouterr().err
    stats = tmp_path / "stats.json"
    assert main(["describe", str(dataset), "--out", str(stats)]) == 0
    for words in (["--camera", "1D"], ["--against", str(stats), "--against-camera", "1D"]):
        place = str(stats) if words[0] == "--camera" else str(dataset)
        assert main(["describe", place, *words]) == 2
        assert "so --camera has no meaning for it" in capsys.readouterr().err
