"""Methods by name, from modules and from a user's file, and messages about missing ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.methods.method import Learner
from evaluation.methods.naming import find_method
from evaluation.methods.standard import standard_methods
from evaluation.methods.wrapped import PatchwiseMethod, ResizedMethod
from foundation.errors import InputError

TEN_LINES = """\
import numpy as np

class Brightest:
    name = "Brightest pixel"

    def estimate(self, image, saturation=None, mask=None):
        usable = np.ones(image.shape[:2], bool) if mask is None else ~mask
        pixels = image[usable].astype(np.float64)
        light = pixels[pixels.sum(axis=1).argmax()]
        return light / np.linalg.norm(light)
"""


@pytest.mark.parametrize("name", standard_methods())
def test_returns_methods_of_suite(name: str) -> None:
    assert find_method(f" {name} ") == standard_methods()[name]


def test_loads_class_from_file(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(TEN_LINES)
    method = find_method(f"{tmp_path}/own.py:Brightest")
    assert method.name == "Brightest pixel"
    image = np.ones((3, 3, 3), np.uint16)
    image[1, 1] = (30, 40, 0)
    assert not isinstance(method, Learner)
    np.testing.assert_allclose(method.estimate(image), [0.6, 0.8, 0])


def test_loads_learner_value_that_imports_module_of_folder(tmp_path: Path) -> None:
    (tmp_path / "beside_own.py").write_text("LABEL = 'from beside'\n")
    (tmp_path / "own.py").write_text(
        "from __future__ import annotations\nfrom dataclasses import dataclass\nfrom beside_own import LABEL\n"
        "@dataclass(frozen=True)\nclass Own:\n    p: int\n    name: str = LABEL\n"
        "    def fit(self, scenes, seed=0):\n        return self\n"
        "five = Own(5)\n"
    )
    method = find_method(f"{tmp_path}/own.py:five")
    assert isinstance(method, Learner)
    assert method.name == "from beside"
    assert type(find_method(f"{tmp_path}/own.py:five")) is type(method)
    with pytest.raises(InputError, match="'p'"):
        find_method(f"{tmp_path}/own.py:Own")


def test_loads_class_from_module() -> None:
    assert find_method("evaluation.methods.pca:BrightDark").name == "PCA bright and dark"


def test_applies_suffixes(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(TEN_LINES)
    assert find_method("gray-edge-2@360") == ResizedMethod(standard_methods()["gray-edge-2"], 360)
    assert find_method("gray-world@patches=5") == PatchwiseMethod(standard_methods()["gray-world"], 5)
    assert find_method(f"{tmp_path}/own.py:Brightest@90@patches").name == "Brightest pixel at 90 px by patches"
    folder = tmp_path / "a@b"
    folder.mkdir()
    (folder / "own.py").write_text(TEN_LINES)
    assert find_method(f"{folder}/own.py:Brightest").name == "Brightest pixel"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("gray-edge-1:p=4,sigma=2", "'p=4,sigma=2'"),
        ("gray-edge-1:sigma=inf", "1000"),
        ("", "method '' is unknown"),
        ("nowhere/own.py:Own", r"nowhere/own\.py"),
        ("evaluation.no_such:Own", r"'evaluation\.no_such'"),
    ],
)
def test_refuses_unknown_method(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        find_method(text)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("class Own:\n    name = 'own'\n", "has no method estimate"),
        (
            "class Own:\n    name = 'own'\n    def estimate_map(self, image): ...\n",
            "estimate_map",
        ),
        ("class Own:\n    def __init__(self, p): ...\n", "TypeError.*'p'"),
        ("class Own:\n    def estimate(self, image, saturation=None, mask=None): ...\n", 'has no name; add name = "…"'),
        ("def f(:\n", "fails when loaded: line 1: "),
        ("x = 1\nimport no_such_thing\n", "2.*ModuleNotFoundError.*no_such_thing"),
        ("x = 1\n\n1 / 0\n", "line 3: ZeroDivisionError"),
        ("import sys\n\nsys.exit(0)\n", "3.*SystemExit.*0"),
        (
            "class Own:\n    def fit(self, scenes): ...\n\n    @property\n    def name(self):\n        return 1 / 0\n",
            r"own\.py:Own.*own\.py.*6.*ZeroDivisionError",
        ),
        (
            "class Own:\n    def __init__(self):\n        raise OSError('no weights')\n",
            r"own\.py.*3.*OSError",
        ),
    ],
)
def test_reports_errors_of_file(tmp_path: Path, source: str, message: str) -> None:
    (tmp_path / "own.py").write_text(source)
    with pytest.raises(InputError, match=message):
        find_method(f"{tmp_path}/own.py:Own")


def test_loads_corrected_file(tmp_path: Path) -> None:
    file = tmp_path / "own.py"
    file.write_text("1 / 0\n")
    with pytest.raises(InputError):
        find_method(f"{file}:Brightest")
    file.write_text(TEN_LINES)
    assert find_method(f"{file}:Brightest").name == "Brightest pixel"


def test_suggests_file_ending_if_name_is_a_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("evaluation.py").write_text("class Mine:\n    pass\n")
    with pytest.raises(InputError, match=r"this suite.*evaluation\.py:Mine"):
        find_method("evaluation:Mine")
