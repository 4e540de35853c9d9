"""A run into a results folder: taken up where it was stopped, published whole.

While methods run, `.RESULTS.partial` holds the answers for each image so far. A run of the same data set, methods,
settings and software goes on there, wherever it was killed; its folder is the same to the last byte as that of a run
that was left alone. When all images are done, the files are written there and the folder gets its name.

The answers are a file that grows by one line an image. Each line is a checksum (CRC-32 of what follows, eight
hexadecimal digits), the image's number, and its answers as JSON; the first says whose answers they are. A line that a
kill or a crash left half, and all after it, are cut off.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from evaluation.datasets.identity import known_again, state_of
from evaluation.experiments.folds import folds_to_csv, groups_of
from evaluation.experiments.running import SceneMethod, answer_scenes, require_truths
from evaluation.experiments.suspicions import suspicions
from evaluation.learning.model_files import StoredMethod, TrainingRecord, scenes_sha256
from evaluation.methods.method import Method
from evaluation.metrics import ErrorKind
from evaluation.reports.run_page import MOST_SHOWN, chosen_images, developed, run_page
from evaluation.reports.table_output import table_to_latex
from evaluation.results.files import ERRORS_FILE, errors_csv, run_json, several_lights_csv
from evaluation.results.method_records import describe_method
from evaluation.results.result import Result, Run, SceneAnswer, Subject, indistinct, results_of
from evaluation.results.tables import lights_tables, statistics_rows, summary_table, table_to_csv
from evaluation.scene import MixedScene, Scene, SceneSet
from foundation.compiled import ordered_map
from foundation.errors import InputError, first_of
from foundation.files import make_folder, partial_path, storage_error, write_whole
from foundation.folders import clear_folder, held_folder, publish_folder, require_free
from foundation.records import from_plain, to_plain
from foundation.version import software

JOURNAL_FILE = "answers.jsonl"
"""Its name in the hidden folder of a run."""


_Answers = tuple[SceneAnswer, ...]


def read_journal(path: Path, identity: dict[str, Any]) -> list[tuple[SceneAnswer, ...]]:
    """Return the answers of the first images, and cut off what is not whole; begin the file where there is none."""
    try:
        content = path.read_bytes() if path.exists() else b""
        whole, lines = _whole_lines(content)
        head: dict[str, Any] = json.loads(lines[0]) if lines else {}
        same = head == json.loads(json.dumps(identity))
        if not same and len(lines) <= 1:
            # Nothing was answered, so nothing is lost: a method that failed on the first image was corrected, say.
            path.write_bytes(_line(identity))
            return []
        if not same:
            differing = " and ".join(
                name for name in {**head, **identity} if head.get(name) != json.loads(json.dumps(identity.get(name)))
            )
            raise InputError(
                f"{path.parent} holds what another run has made so far: its {differing} differ; go "
                "on with that run by its own options, name another place, or remove that folder to begin anew"
            )
        answers: list[tuple[SceneAnswer, ...]] = []
        kept = len(_line(identity))
        for line in lines[1:]:
            stored = json.loads(line)
            if stored["image"] != len(answers):
                break
            answers.append(from_plain(_Answers, stored["answers"], path, "remove it to begin anew"))
            kept += len(line) + _OVERHEAD
        kept = min(kept, whole)
        if kept < len(content):
            with path.open("r+b") as stream:
                stream.truncate(kept)
    except OSError as error:
        raise storage_error(path, error) from error
    return answers


def append_answers(stream: BinaryIO, image: int, answers: Sequence[SceneAnswer], folder: Path) -> None:
    """Add the answers for the next image to the open file."""
    try:
        stream.write(_line({"image": image, "answers": to_plain(tuple(answers), _Answers)}))
    except OSError as error:
        raise storage_error(folder, error) from error


_OVERHEAD = len("00000000 \n")
"""Bytes of a line beside its JSON: checksum, space, end."""


def _line(content: dict[str, Any]) -> bytes:
    text = json.dumps(content, separators=(",", ":")).encode()
    return b"%08x %s\n" % (zlib.crc32(text), text)


def _whole_lines(content: bytes) -> tuple[int, list[bytes]]:
    """Return the length of the lines that are whole, and their JSON."""
    lines: list[bytes] = []
    place = 0
    while (end := content.find(b"\n", place)) >= 0:
        check, _, text = content[place:end].partition(b" ")
        if check != b"%08x" % zlib.crc32(text):
            break
        lines.append(text)
        place = end + 1
    return place, lines


WHAT = "the results"
"""What the folder holds, for messages."""

_WAIT = "wait for it, or name another place"


def run_methods(
    data: SceneSet,
    methods: Sequence[Method | SceneMethod],
    folder: Path | None = None,
    kind: ErrorKind = "reproduction",
    workers: int = 1,
    on_scene: Callable[[int, int], None] | None = None,
) -> Run:
    """Return what methods make of a data set, and write it to a results folder where one is named.

    `folder`: the new results folder; None for none.
    """
    names = [method.name for method in methods]
    twice = [name for number, name in enumerate(names) if name in names[:number]]
    if twice:
        raise InputError(f"two methods are called {twice[0]!r}; give one another name, or leave one out")
    truths = require_truths(data.scenes, methods)
    # Methods are described before they run: what they keep or import while they do depends on where a run went on.
    run = describe_run(data, (), [describe_method(method) for method in methods])
    records = {one.name: one.provenance for one in methods if isinstance(one, StoredMethod) and one.provenance}
    seen = (_seen_before(name, record, data, run.data_sha256) for name, record in records.items())
    run = replace(run, notes=tuple(filter(None, seen)))

    def finished(answers: Sequence[Sequence[SceneAnswer]]) -> Run:
        results = results_of(names, truths, answers)
        odd = suspicions(run.subject.images, truths, results)
        return replace(run, results=results, notes=(*run.notes, *odd, *indistinct(results, data.truth_uncertainty_deg)))

    if folder is None:
        return finished(list(_answers(data.scenes, methods, [], workers, on_scene)))
    with _held(folder) as partial:
        journal = partial / JOURNAL_FILE
        answers = read_journal(journal, _identity(run, state_of(data.scenes)))
        if answers:
            _require_same(data.scenes, methods, answers, partial)
        with journal.open("ab", buffering=0) as stream:
            for given in _answers(data.scenes, methods, answers, workers, on_scene):
                append_answers(stream, len(answers), given, folder)
                answers.append(given)
        run = finished(answers)
        _publish(run, data.scenes, folder, kind, workers)
    return run


@contextmanager
def _held(folder: Path) -> Generator[Path]:
    """Hold the hidden folder of a new results folder, and yield it."""
    require_free(folder, WHAT)
    make_folder(folder.parent, folder)
    with held_folder(partial_path(folder), f"another program works on {folder}; {_WAIT}", of=folder):
        yield partial_path(folder)


def write_run(
    run: Run, scenes: Sequence[Scene], folder: Path, kind: ErrorKind = "reproduction", workers: int = 1
) -> None:
    """Write results that were made otherwise, such as by cross-validation, to a new results folder."""
    with _held(folder):
        _publish(run, scenes, folder, kind, workers)


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


def _seen_before(name: str, record: TrainingRecord, data: SceneSet, sha256: str) -> str:
    """Return what the reader is told where a model was, or may have been, trained on images of a data set."""
    if record.sha256 == sha256:
        return f"{name} was trained on these very images: its errors say nothing of others"
    common = known_again(data.scenes, record.images)
    if common:
        return (
            f"{name}: {len(common)} of {len(data.scenes)} images were trained on, by name and light or by source "
            f"picture: {first_of(common, 3)}; their errors say nothing of images that it has not seen"
        )
    if record.data_name != data.name:
        return ""
    told = f"{name} was trained on {record.scenes} images of a data set of the same name: "
    if len(record.images):
        return f"{told}none of these has the name and light, or the source picture, of one of them"
    return f"{told}whether these are among them is not known"


def _require_same(
    scenes: Sequence[Scene],
    methods: Sequence[Method | SceneMethod],
    known: Sequence[Sequence[SceneAnswer]],
    place: Path,
) -> None:
    """Answer for the first, middle and last known image again: pixels and what a method reads may have changed."""
    again = sorted({0, len(known) // 2, len(known) - 1})
    for number, answers in zip(again, answer_scenes([scenes[number] for number in again], methods), strict=True):
        for method, now, before in zip(methods, answers, known[number], strict=True):
            if json.dumps(to_plain(now)) != json.dumps(to_plain(before)):
                raise InputError(
                    f"{method.name} answers otherwise for {scenes[number].name} than when the run was stopped: the "
                    "image, or a file that the method reads, has changed, or it answers by chance; remove "
                    f"{place} to begin anew"
                )


def _identity(run: Run, state: str) -> dict[str, Any]:
    """Return what must be the same for a run to go on with what another has made; its keys stand in messages.

    Names and lights do not tell whether the pixels are the same, so the state of the image files belongs to it.
    """
    return {
        "data set": {
            "images": len(run.subject.images),
            "sha256": run.data_sha256,
            "several lights": sum(run.subject.mixed),
            "state": state,
        },
        "treatment": dict(run.treatment),
        "methods": list(run.methods),
        "settings": dict(run.settings),
        "software": run.software,
    }


def _answers(
    scenes: Sequence[Scene],
    methods: Sequence[Method | SceneMethod],
    known: Sequence[tuple[SceneAnswer, ...]],
    workers: int,
    on_scene: Callable[[int, int], None] | None,
) -> Iterator[tuple[SceneAnswer, ...]]:
    """Yield the answers for the scenes behind the first ones, which are known; each counts when it was taken."""
    done = len(known)
    if on_scene:
        on_scene(done, len(scenes))
    for given in answer_scenes(scenes[done:], methods, workers):
        yield given
        done += 1
        if on_scene:
            on_scene(done, len(scenes))


def _publish(run: Run, scenes: Sequence[Scene], folder: Path, kind: ErrorKind, workers: int) -> None:
    partial = partial_path(folder)
    pictures = _pictures(run, scenes, kind, workers)
    for name, text in _files(run, kind, pictures).items():
        write_whole(partial / name, text)
    (partial / JOURNAL_FILE).unlink(missing_ok=True)
    # Writes that never finished left something.
    clear_folder(partial, _files_of(run))
    publish_folder(partial, folder, WHAT)


def _files_of(run: Run) -> tuple[str, ...]:
    """Return the names of the files of a results folder."""
    several = any(result.maps is not None for result in run.results)
    return (
        *("run.json", "results.csv", ERRORS_FILE, "table.tex", "report.html"),
        *(("pixels.csv", "regions.csv") if several else ()),
        *(("folds.csv",) if run.folds is not None else ()),
    )


def _files(run: Run, kind: ErrorKind, pictures: Mapping[tuple[int, int], bytes]) -> dict[str, str]:
    """Return the texts of the files of a results folder by their names."""
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
        "pixels.csv": pixels,
        "regions.csv": regions,
        "folds.csv": "" if run.folds is None else folds_to_csv(subject.images, run.folds),
    }
    return {name: texts[name] for name in _files_of(run)}


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
