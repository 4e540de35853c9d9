"""Pinned results of readers for damaged files and values at limits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from evaluation.experiments import folds
from evaluation.experiments.paper.material import read_truths
from evaluation.learning.adapting import restore
from evaluation.learning.feature_learner import FeatureLearner
from evaluation.learning.kernel_ridge import KernelRidge
from evaluation.learning.model_files import load_model, save_model
from evaluation.learning.standard import standard_learners
from evaluation.results.files import read_errors, read_estimates
from foundation.errors import CropError
from tests.evaluation.learning.made_up_world import world
from tests.evaluation.learning.stories import story
from tests.pinned import Pinned

pytestmark = pytest.mark.slow


REFUSED = {"refused": 1}


def attempt(read: Callable[[], Any]) -> Any:
    """Return the value that `read` returns, or that it was refused."""
    try:
        return read()
    except (CropError, KeyError, TypeError, ValueError):
        return REFUSED


ERRORS = """image,method,r,g,b,truth_r,truth_g,truth_b,recovery,reproduction,guessed,cause,group
a,M,0.2,0.5,0.3,0.25,0.5,0.25,5.25,6.5,0,,x
b,M,0.3,0.4,0.3,0.25,0.5,0.25,1.5,2.5,1,dark,x
a,N,,,,0.25,0.5,0.25,0,0.0,0,,y
"""
ESTIMATES = "image,r,g,b\na.png,0.2,0.5,0.3\nb,1,2,1\nmore/c.png,0.1,0.1,0.1\n"
IMAGES = ("a.png", "b.tiff", "more/c.png")
FOLDS = "image,fold\na.png,x\nb.tiff,y\nmore/c.png,x\n"
TRUTHS = "File,GT_R,GT_G,GT_B\nA_1,0.2,0.5,0.3\nA_2,0.3,0.5,0.2\nB_1,1,2,1\n"


def damages(text: str) -> Iterator[tuple[str, str]]:
    """Yield damaged versions of a text with their names."""
    lines = text.splitlines(keepends=True)
    last = lines[-1]
    yield "empty", ""
    yield "without its end", "".join(lines[:-1])
    yield "its end twice", text + ("" if text.endswith("\n") else "\n") + last
    yield "without its head", "".join(lines[1:])
    digits = [place for place, mark in enumerate(last) if mark.isdigit() or mark == "."]
    for instead in ("-", "x", "nan ", "inf ", "0 0 0 ", ",", '"'):
        if digits:
            at = digits[len(digits) // 2]
            yield f"with {instead.strip()}", text[: len(text) - len(last) + at] + instead + last[at:]
    yield "no number but 0", "".join("0" if mark in "123456789" else mark for mark in text)


def test_damaged_tables(tmp_path: Path, pinned: Pinned) -> None:
    readers: dict[str, tuple[str, Callable[[Path], Any]]] = {
        "errors": (ERRORS, read_errors),
        "estimates": (ESTIMATES, lambda path: read_estimates(path, IMAGES).lights),
        "estimates with semicolons": (ESTIMATES.replace(",", ";"), lambda path: read_estimates(path, IMAGES).lights),
        "folds": (FOLDS, lambda path: folds.read_folds(path, IMAGES)),
        "truths": (TRUTHS, lambda path: [read_truths(f"{path}{of}") for of in ("", "#A", "#B_1")]),
    }
    found: dict[str, Any] = {}
    path = tmp_path / "table.csv"
    for name, (whole, read) in readers.items():
        rows = whole.splitlines(keepends=True)
        others = {
            "whole": whole,
            "with blank lines": whole.replace("\n", "\r\n\r\n"),
            "in another order": "".join([rows[0], *rows[:0:-1]]),
            "with a row of another": whole + rows[1].replace("a.png", "z").replace("a,", "z,"),
            "with negative numbers": whole.replace(",0.", ",-0."),
            "with heads twice": rows[0].replace("r,", "image,") + "".join(rows[1:]),
        }
        for how, text in [*others.items(), *damages(whole)][: 3 if " with" in name else None]:
            path.write_text(text)
            found[f"{name} {how}"] = attempt(partial(read, path))
    pinned("damaged tables of results", found)


def changed(array: Any) -> dict[str, Any]:
    """Return changed versions of an array."""
    return {
        "shorter": array[:-1] if array.ndim else np.zeros(2),
        "of floats": np.real(array).astype(np.float32),
        "of whole numbers": np.nan_to_num(np.real(array)).astype(np.int64),
        "with nan": np.full_like(array, np.nan) if array.dtype.kind in "fc" else array,
        "negative": -np.abs(array).astype(np.float64) - 1,
        "large": array * 0 + 99,
        "of ones": np.ones_like(array),
        "flat": array.ravel(),
    }


def test_damaged_models(tmp_path: Path, pinned: Pinned) -> None:
    scenes = world(12, 0, size=16)
    quick: dict[str, dict[str, int]] = {
        "color-beaver": {"population": 9, "generations": 1},
        "log-chroma": {"pretraining": 0, "training": 1},
        "regression-trees": {"windows": 1, "depth": 2},
    }
    found: dict[str, Any] = {}
    for key, learner in standard_learners().items():
        if key == "convnet":
            continue
        made = cast("FeatureLearner", replace(cast("Any", learner), **quick.get(key, {})))
        arrays = dict(made.fit(scenes).model.arrays())
        for name, array in arrays.items():
            left = {other: arrays[other] for other in arrays if other != name}
            given = [arrays | {name: other} for other in changed(array).values()] + [left]
            read = [attempt(partial(restore, made, one)) for one in given]
            found[f"{key} {name}"] = [one is REFUSED for one in read]
    both = {f"{part}.{name}": array for part in ("elsewhere", "here") for name, array in arrays_of_ridge().items()}
    for share in (-0.1, 0.0, 0.5, 1.0, 1.1, [0.5]):
        restored = attempt(partial(restore, KernelRidge(), both | {"share": np.array(share)}))
        found[f"share {share}"] = restored if restored is REFUSED else restored.share
    path = tmp_path / "model.npz"
    save_model(path, KernelRidge().fit(scenes), story(scenes))
    with np.load(path) as content:
        parts: dict[str, Any] = dict(content)
    about = str(parts["about"])
    for how, text in (
        ("format", about.replace("model 1", "model 2")),
        ("method", about.replace("kernel-ridge", "magic")),
        ("setting", about.replace('"penalty"', '"penalties"')),
        ("kind of setting", about.replace("0.3", '"0.3"')),
        ("without brightness", about.replace('"brightness": 1.0,', "")),
        ("scenes", about.replace('"scenes": 12', '"scenes": 13')),
        ("adapted", about.replace('"adapted_from": ""', '"adapted_from": "x"').replace(": 12", ": 11")),
    ):
        np.savez(path, allow_pickle=False, **(parts | {"about": np.array(text)}))
        found[how] = attempt(partial(load_model, path)) is REFUSED
    for name, array in (("shorter", parts["trained_on"][:5]), ("of floats", parts["trained_on"].astype(float))):
        np.savez(path, allow_pickle=False, **(parts | {"trained_on": array}))
        found[name] = attempt(partial(load_model, path)) is REFUSED
    pinned("damaged models", found)


def arrays_of_ridge() -> dict[str, Any]:
    return dict(KernelRidge().fit(world(3, 0, size=8)).model.arrays())
