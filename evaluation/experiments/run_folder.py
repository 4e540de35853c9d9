"""A run of methods on a data set, and its results folder, which appears whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.datasets.identity import known_again
from evaluation.experiments.folds import folds_to_csv, groups_of
from evaluation.experiments.running import SceneMethod, evaluate, require_truths
from evaluation.experiments.suspicions import suspicions
from evaluation.learning.model_files import StoredMethod, TrainingRecord, scenes_sha256
from evaluation.methods.method import Method
from evaluation.metrics import ErrorKind
from evaluation.reports.run_page import MOST_SHOWN, chosen_images, developed, run_page
from evaluation.reports.table_output import table_to_latex
from evaluation.results.files import ERRORS_FILE, errors_csv, run_json, several_lights_csv
from evaluation.results.method_records import describe_method
from evaluation.results.result import Result, Run, Subject, indistinct
from evaluation.results.tables import lights_tables, statistics_rows, summary_table, table_to_csv
from evaluation.scene import MixedScene, Scene, SceneSet
from foundation.compiled import ordered_map
from foundation.errors import InputError, first_few
from foundation.files import write_atomic
from foundation.folders import atomic_folder
from foundation.version import software


def run_methods(
    data: SceneSet,
    methods: Sequence[Method | SceneMethod],
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> Run:
    """Return the estimates and errors of methods on a data set; `on_scene` is called for each finished image."""
    names = [method.name for method in methods]
    twice = [name for number, name in enumerate(names) if name in names[:number]]
    if twice:
        raise InputError(f"two methods are called {twice[0]!r}; give one another name, or leave one out")
    truths = require_truths(data.scenes, methods)
    # Methods are described before they run, since they may keep or import something while they do.
    run = describe_run(data, (), [describe_method(method) for method in methods])
    records = {one.name: one.provenance for one in methods if isinstance(one, StoredMethod) and one.provenance}
    trained = [_trained_on(name, record, data, run.data_sha256) for name, record in records.items()]
    results = evaluate(data.scenes, methods, workers, on_scene)
    odd = suspicions(run.subject.images, truths, results)
    notes = (*filter(None, trained), *odd, *indistinct(results, data.truth_uncertainty_deg))
    return replace(run, results=results, notes=notes)


def write_run(
    run: Run, scenes: Sequence[Scene], folder: Path, kind: ErrorKind = "reproduction", workers: int = 1
) -> None:
    """Write results to a new results folder."""
    with atomic_folder(folder, "the results") as partial:
        for name, text in _files(run, kind, _pictures(run, scenes, kind, workers)).items():
            write_atomic(partial / name, text)


def describe_run(
    data: SceneSet,
    results: tuple[Result, ...],
    methods: Sequence[Mapping[str, Any]],
    settings: Mapping[str, Any] | None = None,
    folds: npt.NDArray[np.int64] | None = None,
    notes: tuple[str, ...] = (),
) -> Run:
    """Return results as a run.

    `folds`: (N,) int64, the fold of each image; None where the methods were not cross-validated.
    """
    return Run(
        subject=Subject(
            data.name,
            tuple(scene.name for scene in data.scenes),
            tuple(isinstance(scene, MixedScene) for scene in data.scenes),
            groups_of(data.scenes),
        ),
        layout=data.layout,
        place=data.place,
        treatment=data.treatment,
        data_sha256=scenes_sha256(data.scenes),
        truths=np.stack([scene.truth for scene in data.scenes]),
        results=results,
        methods=tuple(methods),
        settings={} if settings is None else settings,
        folds=folds,
        notes=notes,
        software=software(),
        truth_uncertainty_deg=data.truth_uncertainty_deg,
    )


def _trained_on(name: str, record: TrainingRecord, data: SceneSet, sha256: str) -> str:
    """Return a sentence if a model was, or may have been, trained on images of a data set, else ""."""
    if record.sha256 == sha256:
        return f"{name} was trained on these very images: its errors say nothing of others"
    common = known_again(data.scenes, record.images)
    if common:
        return (
            f"{name}: {len(common)} of {len(data.scenes)} images were trained on, by name and light or by source "
            f"picture: {first_few(common, 3)}; their errors say nothing of images that it has not seen"
        )
    if record.data_name != data.name:
        return ""
    return (
        f"{name} was trained on {record.scenes} images of a data set of the same name: none of these has the name and "
        "light, or the source picture, of one of them"
    )


def _files(run: Run, kind: ErrorKind, pictures: Mapping[tuple[int, int], bytes]) -> dict[str, str]:
    subject, results = run.subject, run.results
    tables = [summary_table(subject, results, kind), *lights_tables(subject, results, kind)]
    pixels, regions = several_lights_csv(subject.images, results)
    content = {
        "data_set": {
            "name": subject.name,
            "layout": run.layout,
            "place": run.place,
            "images": len(subject.images),
            "images_under_several_lights": sum(subject.mixed),
            "groups": len(set(subject.groups or subject.images)),
            "sha256": run.data_sha256,
            **({} if run.truth_uncertainty_deg is None else {"truth_uncertainty_deg": run.truth_uncertainty_deg}),
        },
        "treatment": dict(run.treatment),
        "methods": [dict(method) for method in run.methods],
        "settings": dict(run.settings),
        "notes": [*run.notes, *tables[0].notes],
        "no_estimate": {result.method: int(result.guessed.sum()) for result in results},
        "software": run.software,
    }
    texts = {
        "run.json": run_json(content),
        "results.csv": table_to_csv(statistics_rows(subject, results)),
        ERRORS_FILE: errors_csv(subject.images, run.truths, results, subject.groups),
        "table.tex": "\n".join(map(table_to_latex, tables)),
        "report.html": run_page(run, kind, pictures),
    }
    if any(result.maps is not None for result in results):
        texts |= {"pixels.csv": pixels, "regions.csv": regions}
    if run.folds is not None:
        texts["folds.csv"] = folds_to_csv(subject.images, run.folds)
    return texts


def _pictures(run: Run, scenes: Sequence[Scene], kind: ErrorKind, workers: int) -> dict[tuple[int, int], bytes]:
    """Return the pictures of each method's worst and median images; each image is read once."""
    shown: dict[int, list[int]] = {}
    for number, result in enumerate(run.results[:MOST_SHOWN]):
        for place in sum(chosen_images(result, kind), ()):
            shown.setdefault(place, []).append(number)

    def develop(place: int) -> list[bytes]:
        return developed(scenes[place], [run.results[number].estimates[place] for number in shown[place]])

    made = ordered_map(develop, shown, workers)
    return {
        (number, place): picture
        for (place, numbers), those in zip(shown.items(), made, strict=True)
        for number, picture in zip(numbers, those, strict=True)
    }
