"""Open data sets of every supported layout. The layout is given by name or recognised from the files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from evaluation.datasets.ffcc import is_ffcc, open_ffcc
from evaluation.datasets.files import IMAGE_ENDINGS, Folder, RawScene, black_level_warning, require_black_below_peak
from evaluation.datasets.generated import open_generated
from evaluation.datasets.options import DataOptions
from evaluation.datasets.plain_folder import ASSUMED_BLACK, is_plain_folder, open_plain_folder, refuse_unusable_table
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
from evaluation.datasets.published.levi import is_levi, open_levi
from evaluation.datasets.published.lsmi import is_lsmi, open_lsmi
from evaluation.datasets.published.nus8 import is_nus8, open_nus8
from evaluation.datasets.thumbnails import open_thumbnails
from evaluation.scene import SceneSet
from foundation.errors import FormatError, InputError, first_few

_LEVELS = ("black", "saturation")


@dataclass(frozen=True)
class Layout:
    """File layout of data sets on a disk.

    - `title`: description for help and messages: "a dataset made by generate".
    - `signature`: files by which the layout is recognised: "cube+_gt.txt".
    - `matches`: returns True if a folder has the layout; reads only names and first lines of tables.
    - `open`: returns the data set at a path or URL; the `Folder` is passed if its file names were already read.
    - `options`: fields of `DataOptions` that apply to the layout.
    - `is_generic`: many data sets may have the layout; it is tried only if no other layout matches.
    - `is_unverified`: the reader was never tested on a published copy; results report this.
    - `path_type`: "folder" or "file"; None if the location may be either of them, or a URL.
    """

    title: str
    signature: str
    matches: Callable[[Folder], bool]
    open: Callable[[str, DataOptions, Folder | None], SceneSet]
    options: tuple[str, ...] = ()
    is_generic: bool = False
    is_unverified: bool = False
    path_type: str | None = "folder"


# Printed with results if the reader was only tested on synthetic copies of the data set.
_UNVERIFIED_NOTE = "not verified against a published copy; compare one image with the authors' program"


# Layouts by their names on the command line.
LAYOUTS: Mapping[str, Layout] = {
    "generated": Layout(
        "a dataset made by generate",
        "dataset.json",
        lambda folder: folder.has("dataset.json"),
        lambda location, options, _: open_generated(location, options.subset),
        ("subset",),
        path_type=None,
    ),
    "thumbnails": Layout(
        "thumbnails in a NumPy archive",
        "a file .npz",
        lambda _: False,
        lambda location, options, _: open_thumbnails(location, options.saturation),
        ("saturation",),
        path_type="file",
    ),
    "cube-plus": Layout(
        "Cube+, or Cube",
        "cube+_gt.txt",
        is_cube_plus,
        open_cube_plus,
        ("truth", *_LEVELS, "partial"),
        is_unverified=True,
    ),
    "cube++": Layout(
        "Cube++",
        "gt.csv with left_r",
        is_cube_plus_plus,
        open_cube_plus_plus,
        ("truth", *_LEVELS, "partial"),
        is_unverified=True,
    ),
    "simple-cube++": Layout(
        "SimpleCube++",
        "gt.csv and a folder PNG, or both in train and test",
        is_simple_cube,
        open_simple_cube,
        ("subset", *_LEVELS, "partial"),
        is_unverified=True,
    ),
    "nus8": Layout(
        "NUS 8 cameras, or one of them",
        "CAMERA_gt.mat",
        is_nus8,
        open_nus8,
        ("camera", *_LEVELS, "partial"),
        is_unverified=True,
    ),
    "gehler-shi": Layout(
        "Gehler's ColorChecker data set as Shi and Funt processed it",
        "ColorCheckerData.mat, real_illum_568..mat or coordinates",
        is_gehler_shi,
        open_gehler_shi,
        ("camera", "truth", *_LEVELS, "partial"),
        is_unverified=True,
    ),
    "intel-tau": Layout(
        "INTEL-TAU, processed to 1080p",
        "folders field_1_cameras, field_3_cameras, lab_printouts or lab_realscene",
        is_intel_tau,
        open_intel_tau,
        ("camera", "subset", *_LEVELS, "partial"),
        is_unverified=True,
    ),
    "lsmi": Layout(
        "LSMI, several illuminants",
        "meta.json and split.json",
        is_lsmi,
        open_lsmi,
        ("camera", "subset", *_LEVELS, "partial"),
        is_unverified=True,
    ),
    "levi": Layout(
        "LEVI, night images",
        "gt.mat and folders img and msk",
        is_levi,
        open_levi,
        (*_LEVELS, "partial"),
        is_unverified=True,
    ),
    "ffcc": Layout(
        "FFCC's thumbnails",
        "NAME.png with NAME.txt",
        is_ffcc,
        open_ffcc,
        (*_LEVELS, "partial"),
        is_generic=True,
        is_unverified=True,
    ),
    "folder": Layout(
        "images of your own",
        "a .csv with image,r,g,b, or a .txt with name r g b",
        is_plain_folder,
        open_plain_folder,
        (*_LEVELS, "partial"),
        is_generic=True,
        path_type=None,
    ),
}


def open_scenes(location: Path | str, layout: str | None = None, options: DataOptions | None = None) -> SceneSet:
    """Return the data set at a location; images are read when they are used.

    Parameters
    ----------
    location
        Folder or file of a data set, or URL of a data set made by `generate`.
    layout
        Name in `LAYOUTS`; None to recognise the layout from the files.
    options
        Selected part of the data set, and levels that replace the levels of the layout; None for `DataOptions()`.

    Returns
    -------
    SceneSet
        At least one image with its ground truth.

    Raises
    ------
    InputError
        The layout is unknown, several layouts match, or an option does not apply to the layout.
    FormatError
        No layout matches, or files are missing or damaged; the message names them.
    """
    chosen_options = DataOptions() if options is None else options
    address = str(location)
    name, folder = _recognise_layout(address) if layout is None else (layout, None)
    if name not in LAYOUTS:
        raise InputError(f"layout {name!r} is unknown, expected one of {', '.join(LAYOUTS)}; choose one of these")
    entry = LAYOUTS[name]
    if layout is not None and entry.path_type is not None:
        _require_file_type(address, name, entry)
    unused_options = [option for option in chosen_options.set_options if option not in entry.options]
    if unused_options:
        supporting = [key for key, other in LAYOUTS.items() if unused_options[0] in other.options]
        raise InputError(
            f"--read {unused_options[0]} does not apply to {address}, {entry.title} ({name}), only to "
            f"{', '.join(supporting)}; leave it out"
        )
    data = entry.open(address, chosen_options, folder)
    return replace(data, treatment={**data.treatment, "reader": _UNVERIFIED_NOTE}) if entry.is_unverified else data


def check_black_level(data: SceneSet, black: float | None) -> SceneSet:
    """Return the data set, with a warning in `treatment` if the black level was probably not subtracted.

    `black` is the level given by the user. Raises InputError if a given level is not below the largest
    pixel of all images.
    """
    # Both checks read images until one has plausible values; usually this is the first image.
    scenes = [scene for scene in data.scenes if isinstance(scene, RawScene)]
    if black is not None or data.layout == "folder":
        require_black_below_peak(scenes)
    source = data.treatment.get("black level", "")
    note = black_level_warning(scenes) if source == ASSUMED_BLACK else ""
    return replace(data, treatment={**data.treatment, "black level": f"{source}{note}"}) if note else data


def layout_of(location: str) -> str:
    """Return the name of the layout of a location.

    Raises InputError if several layouts match, and FormatError if none matches or the location does not exist.
    """
    return _recognise_layout(location)[0]


def _require_file_type(location: str, name: str, entry: Layout) -> None:
    path = Path(location)
    if not path.exists():
        raise FormatError(f"{location} does not exist, expected a {entry.path_type} with {entry.title} ({name})")
    if path.is_dir() != (entry.path_type == "folder"):
        raise FormatError(
            f"{location} is a {'folder' if path.is_dir() else 'file'}, expected a {entry.path_type} of {entry.title} "
            f"({name}); correct it, or leave out --read layout to have the layout recognised"
        )


def _refuse_results(folder: Path, location: str) -> None:
    # The file errors.csv has the columns image, r, g and b, so a results folder would be read as a data set.
    if (folder / "run.json").is_file() and any((folder / name).is_file() for name in ("errors.csv", "results.csv")):
        raise FormatError(
            f"{location} is a results folder of evaluate, expected a data set; give the data set in its run.json, or "
            "use evaluate compare for results"
        )


def _refuse_pictures(folder: Folder, location: str) -> None:
    pictures = [name for name in folder.files if name.lower().endswith((*IMAGE_ENDINGS, ".jpg", ".jpeg"))]
    if pictures and not any(name.endswith((".csv", ".mat", ".txt", ".json")) for name in folder.files):
        raise FormatError(
            f"{location} has pictures ({first_few(pictures)}) without ground truths, expected a data set; give the "
            "whole folder of a published set, add a .csv with image,r,g,b to images of 16 bits, or generate a data set "
            f"from the pictures: generate LUT OUT --sources {location}"
        )


def _recognise_layout(location: str) -> tuple[str, Folder | None]:
    if "://" in location:
        return "generated", None
    path = Path(location)
    if path.is_file():
        by_ending = {".npz": "thumbnails", ".csv": "folder", ".txt": "folder"}
        if path.name in ("errors.csv", "results.csv"):
            _refuse_results(path.parent, location)
        if path.suffix.lower() in by_ending:
            return by_ending[path.suffix.lower()], None
        raise FormatError(
            f"{location} is a file, expected an archive .npz or a table .csv or .txt; give one, or a folder"
        )
    if not path.is_dir():
        raise FormatError(f"{location} does not exist, expected a data set; give its folder, file or URL")
    _refuse_results(path, location)
    folder = Folder(path)
    matches = [name for name, entry in LAYOUTS.items() if not entry.is_generic and entry.matches(folder)]
    matches = matches or [name for name, entry in LAYOUTS.items() if entry.is_generic and entry.matches(folder)]
    if not matches:
        _refuse_pictures(folder, location)
        refuse_unusable_table(folder)
        signatures = "; ".join(f"{entry.signature} ({name})" for name, entry in LAYOUTS.items())
        raise FormatError(f"{location} has no supported layout, expected {signatures}; give a data set's folder")
    if len(matches) > 1:
        raise InputError(f"{location} matches {' and '.join(matches)}, expected one; choose with --read layout=NAME")
    return matches[0], folder
