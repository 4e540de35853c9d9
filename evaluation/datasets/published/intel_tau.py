"""Read INTEL-TAU: 7022 images of three cameras as processed 1080p files.

    CAMERA/field_1_cameras/NAME_12.tiff   16 bits; black subtracted, values scaled and faces masked by the authors
    CAMERA/field_1_cameras/NAME_12.wp     ground truth: red, green, blue (or with leading zeros: NAME_012.wp)
    CAMERA/field_3_cameras, lab_printouts, lab_realscene: as field_1_cameras
    splits/Intel-TAU_v3_filelist_subset01.txt … 10   the authors' ten folds, optional

Cameras: Canon_5DSR, Nikon_D810, Sony_IMX135_BLCCSC. F. Laakom et al., "INTEL-TAU: a color constancy dataset", IEEE
Access 9, 2021 (arXiv:1910.10404): processed images are corrected for the black level and normalised by saturation. The
layout follows the public loader of the first author and a published inventory of the archives: 2109 + 2793 + 2120
images with ground truth. The saturation 65535 and the zeros on masked faces and charts are not verified against a real
copy.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from evaluation.datasets.files import Folder, ZeroMaskedScene, read_text
from evaluation.datasets.options import DataOptions, choose_name, level_note
from evaluation.scene import SceneSet
from foundation.errors import FormatError, first_few

# Names of the subfolders of each camera.
SUBSETS = ("field_1_cameras", "field_3_cameras", "lab_printouts", "lab_realscene")
WHITE = 65535  # saturation of the files, counts: the authors scaled saturation to 16 bits

_PUBLISHED = 7022  # images of the whole data set (arXiv:1910.10404)
_FOLD_COUNT = 10  # number of the authors' folds, from their loader


def is_intel_tau(folder: Folder) -> bool:
    """Return True if a folder has the subfolders of one or several cameras."""
    return bool(_cameras(folder))


def open_intel_tau(location: str, options: DataOptions, scanned_folder: Folder | None = None) -> SceneSet:
    """Return the images of all or the selected cameras and subsets; images and ground truths are read on use."""
    folder = scanned_folder or Folder(Path(location))
    cameras = _cameras(folder)
    if not cameras:
        raise FormatError(f"{location}: no folder has {' or '.join(SUBSETS)}, expected INTEL-TAU; unpack it there")
    camera = choose_name(options.camera, cameras, "camera", location)
    available = [name for name in SUBSETS if any(name in camera_folder.folders for camera_folder in cameras.values())]
    subset = choose_name(options.subset, available, "subset", location)
    black = 0.0 if options.black is None else options.black
    white = float(WHITE) if options.saturation is None else options.saturation
    scenes: list[ZeroMaskedScene] = []
    counts: list[str] = []
    for name, camera_folder in cameras.items():
        if camera not in (None, name):
            continue
        count_before = len(scenes)
        for subset_dir in SUBSETS:
            if subset_dir in camera_folder.folders and subset in (None, subset_dir):
                prefix = f"{name}/{subset_dir}/"
                scenes.extend(_scenes(camera_folder.folders[subset_dir], prefix, black, white, options.partial))
        counts.append(f"{name} {len(scenes) - count_before}")
    if not scenes:
        raise FormatError(
            f"{location} has no image of {camera or 'any camera'} in {subset or 'any subset'}; unpack it there"
        )
    is_complete = camera is None and subset is None
    return SceneSet(
        name="INTEL-TAU" + "".join(f" {selection}" for selection in (camera, subset) if selection),
        layout="intel-tau",
        location=location,
        scenes=tuple(scenes),
        treatment={
            "images": ", ".join(counts)
            + (f"; the published data set has {_PUBLISHED}" if is_complete and len(scenes) != _PUBLISHED else ""),
            "black level": level_note(options.black, "0: subtracted by the authors (arXiv:1910.10404)"),
            "saturation": level_note(options.saturation, f"from {WHITE}, scaled by the authors"),
            "mask": "pixels that are zero in every channel: faces and charts that the authors painted over",
            "ground truth": "the .wp file of each image",
        },
        folds=_authors_folds(folder, scenes),
    )


def _cameras(folder: Folder) -> dict[str, Folder]:
    if any(name in folder.folders for name in SUBSETS):
        return {folder.path.resolve().name: folder}
    return {name: child for name, child in folder.folders.items() if not child.folders.keys().isdisjoint(SUBSETS)}


def _scenes(folder: Folder, prefix: str, black: float, white: float, partial: bool) -> list[ZeroMaskedScene]:
    images = folder.images((".tiff", ".tif"))
    lights = {_strip_zeros(name[:-3]): name for name in folder.files if name.endswith(".wp")}
    names_by_key = {_strip_zeros(name): name for name in images}
    without_truth = [name for key, name in names_by_key.items() if key not in lights]
    if without_truth:
        raise FormatError(
            f"{folder.path} lacks the .wp files of {len(without_truth)} images ({first_few(without_truth)}), expected "
            "one for each image; restore them"
        )
    without_image = [name for key, name in lights.items() if key not in names_by_key]
    if without_image and not partial:
        raise FormatError(
            f"{folder.path} lacks the .tiff files of {len(without_image)} ground truths ({first_few(without_image)}), "
            "expected one for each; complete the copy, or use the existing images with --read partial"
        )
    return [
        ZeroMaskedScene(f"{prefix}{name}.tiff", images[name], str(folder.path / lights[key]), black, white)
        for key, name in names_by_key.items()
    ]


def _strip_zeros(name: str) -> str:
    # The numbers in the names of an image and of its ground truth may have different leading zeros.
    stem, _, number = name.rpartition("_")
    return f"{stem}_{int(number)}" if number.isdecimal() else name


def _authors_folds(folder: Folder, scenes: Sequence[ZeroMaskedScene]) -> tuple[int, ...] | None:
    """Return the authors' fold of each scene; None if their lists are missing or incomplete."""
    lists = folder.folders.get("splits")
    paths = (
        [lists.path / f"Intel-TAU_v3_filelist_subset{fold:02d}.txt" for fold in range(1, _FOLD_COUNT + 1)]
        if lists
        else []
    )
    if not paths or not all(path.is_file() for path in paths):
        return None
    folds_by_key: dict[str, int] = {}
    for fold, path in enumerate(paths):
        for line in read_text(path).split():
            folds_by_key[_fold_key(line.replace("\\", "/"))] = fold
    keys = [_fold_key(scene.name) for scene in scenes]
    return tuple(folds_by_key[key] for key in keys) if folds_by_key.keys() >= set(keys) else None


def _fold_key(path: str) -> str:
    segments = path.split("/")[-3:]
    return "/".join([*segments[:-1], _strip_zeros(segments[-1].rpartition(".")[0])])
