"""The door to data sets: one function opens each layout that is known, by its name or by what it looks like."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from evaluation.datasets.ffcc import is_ffcc, open_ffcc
from evaluation.datasets.files import IMAGE_ENDINGS, Folder, RawScene, pedestal_note, require_above_black
from evaluation.datasets.generated import open_generated
from evaluation.datasets.options import DataOptions
from evaluation.datasets.plain_folder import ASSUMED_BLACK, is_plain_folder, open_plain_folder, require_no_other_table
from evaluation.datasets.published.cube import (
    is_cube_plus,
    is_cube_plus_plus,
    is_simple_cube,
    open_cube_plus,
    open_cube_plus_plus,
    open_simple_cube,
)
from evaluation.datasets.published.gehler_shi import is_gehler_shi, open_gehler_shi
from evaluation.datasets.published.intel_tau import is_intel_tau, open_intel_tau
from evaluation.datasets.published.lsmi import is_lsmi, open_lsmi
from evaluation.datasets.published.nus8 import is_nus8, open_nus8
from evaluation.datasets.thumbnails import open_thumbnails
from evaluation.scene import SceneSet
from foundation.errors import FormatError, InputError, first_few

_LEVELS = ("black", "saturation")


@dataclass(frozen=True)
class Layout:
    """A way in which data sets lie on the disk.

    - `title`: what lies so, for help and messages: "a dataset made by generate".
    - `signs`: what a place is told by: "cube+_gt.txt".
    - `matches`: whether a folder looks like it; reads names, and the first lines of tables, at most.
    - `open`: returns the data set at a path or URL; takes the names in its folder where they were read already.
    - `options`: the fields of `DataOptions` that have a meaning for it.
    - `general`: whether it is no particular data set's, and asked only where no other matches.
    - `unverified`: whether it is others' and its reader was never tried on a copy that they published; results then say
      so.
    - `takes`: "folder" or "file", which a place must be; None if it may be either, or a URL.
    """

    title: str
    signs: str
    matches: Callable[[Folder], bool]
    open: Callable[[str, DataOptions, Folder | None], SceneSet]
    options: tuple[str, ...] = ()
    general: bool = False
    unverified: bool = False
    takes: str | None = "folder"


# What is stated with results of a data set whose reader has met made-up copies only.
_UNVERIFIED = "not verified against a published copy; compare one image with the authors' program"


# By the names that the command takes.
LAYOUTS: Mapping[str, Layout] = {
    "generated": Layout(
        "a dataset made by generate",
        "dataset.json",
        lambda folder: folder.has("dataset.json"),
        lambda place, options, _: open_generated(place, options.subset),
        ("subset",),
        takes=None,
    ),
    "thumbnails": Layout(
        "thumbnails in a NumPy archive",
        "a file .npz",
        lambda _: False,
        lambda place, options, _: open_thumbnails(place, options.saturation),
        ("saturation",),
        takes="file",
    ),
    "cube-plus": Layout(
        "Cube+, or Cube", "cube+_gt.txt", is_cube_plus, open_cube_plus, ("truth", *_LEVELS, "partial"), unverified=True
    ),
    "cube++": Layout(
        "Cube++",
        "gt.csv with left_r",
        is_cube_plus_plus,
        open_cube_plus_plus,
        ("truth", *_LEVELS, "partial"),
        unverified=True,
    ),
    "simple-cube++": Layout(
        "SimpleCube++",
        "gt.csv beside PNG, or those in train and test",
        is_simple_cube,
        open_simple_cube,
        ("subset", *_LEVELS, "partial"),
        unverified=True,
    ),
    "nus8": Layout(
        "NUS 8 cameras, or one of them",
        "CAMERA_gt.mat",
        is_nus8,
        open_nus8,
        ("camera", *_LEVELS, "partial"),
        unverified=True,
    ),
    "gehler-shi": Layout(
        "Gehler's ColorChecker data set as Shi and Funt processed it",
        "ColorCheckerData.mat, real_illum_568..mat or coordinates",
        is_gehler_shi,
        open_gehler_shi,
        ("camera", "truth", *_LEVELS, "partial"),
        unverified=True,
    ),
    "intel-tau": Layout(
        "INTEL-TAU, processed to 1080p",
        "folders field_1_cameras, field_3_cameras, lab_printouts or lab_realscene",
        is_intel_tau,
        open_intel_tau,
        ("camera", "subset", *_LEVELS, "partial"),
        unverified=True,
    ),
    "lsmi": Layout(
        "LSMI, several lights",
        "meta.json beside split.json",
        is_lsmi,
        open_lsmi,
        ("camera", "subset", *_LEVELS, "partial"),
        unverified=True,
    ),
    "ffcc": Layout(
        "FFCC's thumbnails",
        "NAME.png beside NAME.txt",
        is_ffcc,
        open_ffcc,
        (*_LEVELS, "partial"),
        general=True,
        unverified=True,
    ),
    "folder": Layout(
        "images of your own",
        "a .csv with image,r,g,b",
        is_plain_folder,
        open_plain_folder,
        (*_LEVELS, "partial"),
        general=True,
        takes=None,
    ),
}


def open_scenes(place: Path | str, layout: str | None = None, options: DataOptions | None = None) -> SceneSet:
    """Return the data set at a place; images are read when they are used.

    `place`: folder, file or URL; URLs are those of datasets made by `generate`. `layout`: a name of `LAYOUTS`; by
    default the one that the place looks like. `options`: what to take of it, and levels that replace those of the
    layout.

    Raises `InputError`: there is no layout of that name, the place looks like several, or an option has no meaning for
    its layout; `FormatError`: the place looks like no layout; or the data set is not as its layout has it: the message
    says what is missing.
    """
    chosen = DataOptions() if options is None else options
    text = str(place)
    name, names = _recognise(text) if layout is None else (layout, None)
    if name not in LAYOUTS:
        raise InputError(f"{name!r} is no layout; the layouts are {', '.join(LAYOUTS)}")
    known = LAYOUTS[name]
    if layout is not None and known.takes is not None:
        _require_kind(text, name, known)
    idle = [option for option in chosen.given if option not in known.options]
    if idle:
        able = [other for other, it in LAYOUTS.items() if idle[0] in it.options]
        raise InputError(
            f"--read {idle[0]} has no meaning for {text}, {known.title} ({name}); it has one for {', '.join(able)}"
        )
    data = known.open(text, chosen, names)
    return replace(data, treatment={**data.treatment, "reader": _UNVERIFIED}) if known.unverified else data


def with_black_judged(data: SceneSet, black: float | None) -> SceneSet:
    """Return a data set, stated that a black level may be missing where images look so.

    Reads images, mostly one: until one says that nothing is wrong.

    `data`: what was opened. `black`: the level that the user gave.

    Raises `InputError`: the level of the user, or of a table of theirs, is above every pixel of all images.
    """
    scenes = [scene for scene in data.scenes if isinstance(scene, RawScene)]
    if black is not None or data.layout == "folder":
        require_above_black(scenes)
    stated = data.treatment.get("black level", "")
    note = pedestal_note(scenes) if stated == ASSUMED_BLACK else ""
    return replace(data, treatment={**data.treatment, "black level": f"{stated}{note}"}) if note else data


def layout_of(place: str) -> str:
    """Return the name of the layout that a place looks like.

    Raises `InputError`: it looks like several; `FormatError`: it looks like none, or is not there.
    """
    return _recognise(place)[0]


def _require_kind(place: str, name: str, known: Layout) -> None:
    path = Path(place)
    if not path.exists():
        raise FormatError(f"{place} is not there, expected a {known.takes} of {known.title} ({name}); name that")
    if path.is_dir() != (known.takes == "folder"):
        raise FormatError(
            f"{place} is a {'folder' if path.is_dir() else 'file'}, expected a {known.takes} of {known.title} "
            f"({name}); name that, or leave out --read layout to have the layout told by the place"
        )


def _refuse_results(folder: Path, place: str) -> None:
    """Refuse a folder that holds results of `evaluate`, whose errors.csv has the columns of a table of images."""
    if (folder / "run.json").is_file() and any((folder / name).is_file() for name in ("errors.csv", "results.csv")):
        raise FormatError(
            f"{place} is a results folder of evaluate, expected a data set; name the data that its run.json tells, or "
            "compare results with evaluate compare"
        )


def _refuse_pictures(folder: Folder, place: str) -> None:
    pictures = [name for name in folder.files if name.lower().endswith((*IMAGE_ENDINGS, ".jpg", ".jpeg"))]
    if pictures and not any(name.endswith((".csv", ".mat", ".txt", ".json")) for name in folder.files):
        raise FormatError(
            f"{place} is no dataset: pictures ({first_few(pictures)}) without ground truths; name a published set's "
            "whole folder, put a .csv with image,r,g,b beside images of 16 bits, or make a dataset of pictures: "
            f"generate LUT OUT --sources {place}"
        )


def _recognise(place: str) -> tuple[str, Folder | None]:
    if "://" in place:
        return "generated", None
    path = Path(place)
    if path.is_file():
        by_ending = {".npz": "thumbnails", ".csv": "folder"}
        if path.name in ("errors.csv", "results.csv"):
            _refuse_results(path.parent, place)
        if path.suffix.lower() in by_ending:
            return by_ending[path.suffix.lower()], None
        raise FormatError(f"{place} is a file, expected a folder, an archive .npz or a table .csv; name one of these")
    if not path.is_dir():
        raise FormatError(f"{place} is no dataset: it does not exist; name its folder, file or URL")
    _refuse_results(path, place)
    folder = Folder(path)
    found = [name for name, known in LAYOUTS.items() if not known.general and known.matches(folder)]
    found = found or [name for name, known in LAYOUTS.items() if known.general and known.matches(folder)]
    if not found:
        _refuse_pictures(folder, place)
        require_no_other_table(folder)
        signs = "; ".join(f"{known.signs} ({name})" for name, known in LAYOUTS.items())
        raise FormatError(f"{place} is no dataset of a layout that is known. Looked for: {signs}. Name its folder")
    if len(found) > 1:
        raise InputError(f"{place} looks like {' and '.join(found)}; choose with --read layout=NAME")
    return found[0], folder
