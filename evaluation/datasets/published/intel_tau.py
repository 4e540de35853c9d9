"""INTEL-TAU: 7022 images of three cameras, half of them of the same scenes, as the authors' processed 1080p files.

    CAMERA/field_1_cameras/NAME_12.tiff   16 bits, black subtracted and scaled by the authors, privacy masked
    CAMERA/field_1_cameras/NAME_12.wp     red, green, blue of the light (the number may be padded: NAME_012.wp)
    CAMERA/field_3_cameras, lab_printouts, lab_realscene
    splits/Intel-TAU_v3_filelist_subset01.txt … 10   the authors' ten folds, optional

Cameras: Canon_5DSR, Nikon_D810, Sony_IMX135_BLCCSC. F. Laakom et al., "INTEL-TAU: a color constancy dataset", IEEE
Access 9, 2021 (arXiv:1910.10404): processed images are corrected for the black level and normalised by saturation. The
layout is that of the first author's own loader (a public program) and of a published inventory of the archives, 2109 +
2793 + 2120 pairs. That the scale ends at 65535, and that masked faces and charts are zero, is not verified against a
real copy.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from evaluation.datasets.files import Folder, PaintedScene, read_text
from evaluation.datasets.options import DataOptions, choose, stated
from evaluation.scene import SceneSet
from foundation.errors import FormatError, first_few

# The parts of each camera, as its folders are named.
SUBSETS = ("field_1_cameras", "field_3_cameras", "lab_printouts", "lab_realscene")
WHITE = 65535  # End of the scale of 16-bit files that are normalised by saturation

_PUBLISHED = 7022  # Images of the whole data set (arXiv:1910.10404)
_FOLDS = 10  # The authors' folds; their loader reads as many lists


def is_intel_tau(folder: Folder) -> bool:
    """Return whether a folder looks like the data set or one camera of it: it has the parts that the authors name."""
    return bool(_cameras(folder))


def open_intel_tau(place: str, options: DataOptions, listed: Folder | None = None) -> SceneSet:
    """Return the images, or those of a camera or a part; images and lights are read when they are used."""
    folder = listed or Folder(Path(place))
    cameras = _cameras(folder)
    if not cameras:
        raise FormatError(f"{place} is no copy of INTEL-TAU: no folder has {', '.join(SUBSETS)}; unpack a camera there")
    camera = choose(options.camera, cameras, "camera", place)
    there = [name for name in SUBSETS if any(name in known.folders for known in cameras.values())]
    subset = choose(options.subset, there, "subset", place)
    black = 0.0 if options.black is None else options.black
    white = float(WHITE) if options.saturation is None else options.saturation
    scenes: list[PaintedScene] = []
    counts: list[str] = []
    for name, known in cameras.items():
        if camera not in (None, name):
            continue
        before = len(scenes)
        for part in SUBSETS:
            if part in known.folders and subset in (None, part):
                scenes.extend(_scenes(known.folders[part], f"{name}/{part}/", black, white, options.partial))
        counts.append(f"{name} {len(scenes) - before}")
    if not scenes:
        raise FormatError(
            f"{place} has no image of {camera or 'any camera'} in {subset or 'any part'}; unpack it there"
        )
    whole = camera is None and subset is None
    return SceneSet(
        name="INTEL-TAU" + "".join(f" {chosen}" for chosen in (camera, subset) if chosen),
        layout="intel-tau",
        location=place,
        scenes=tuple(scenes),
        treatment={
            "images": ", ".join(counts)
            + (f"; the published data set has {_PUBLISHED}" if whole and len(scenes) != _PUBLISHED else ""),
            "black level": stated(options.black, "0: subtracted by the authors (arXiv:1910.10404)"),
            "saturation": stated(options.saturation, f"from {WHITE}, to which the authors scaled it"),
            "mask": "pixels that are zero in every channel: faces and charts that the authors painted over",
            "ground truth": "the .wp file beside each image",
        },
        folds=_folds(folder, scenes),
    )


def _cameras(folder: Folder) -> dict[str, Folder]:
    """Return the folders of cameras by name: those right below, or the folder itself."""
    if any(name in folder.folders for name in SUBSETS):
        return {folder.path.resolve().name: folder}
    return {name: below for name, below in folder.folders.items() if any(part in below.folders for part in SUBSETS)}


def _scenes(folder: Folder, prefix: str, black: float, white: float, partial: bool) -> list[PaintedScene]:
    images = folder.images((".tiff", ".tif"))
    lights = {_unpadded(name[:-3]): name for name in folder.files if name.endswith(".wp")}
    known = {_unpadded(name): name for name in images}
    without = [name for key, name in known.items() if key not in lights]
    if without:
        raise FormatError(
            f"{folder.path} lacks the .wp files of {len(without)} images ({first_few(without)}), expected one beside "
            "each; restore them"
        )
    alone = [name for key, name in lights.items() if key not in known]
    if alone and not partial:
        raise FormatError(
            f"{folder.path} lacks the .tiff files of {len(alone)} lights ({first_few(alone)}), expected one beside "
            "each; complete the copy, or take what is there with --read partial"
        )
    return [
        PaintedScene(f"{prefix}{name}.tiff", images[name], str(folder.path / lights[key]), black, white)
        for key, name in known.items()
    ]


def _unpadded(name: str) -> str:
    """Return a name with the number at its end without zeros before it: some files have them, their partners not."""
    head, _, number = name.rpartition("_")
    return f"{head}_{int(number)}" if number.isdecimal() else name


def _folds(folder: Folder, scenes: Sequence[PaintedScene]) -> tuple[int, ...] | None:
    """Return the authors' fold of each scene, or None where their lists are not there or do not name every scene."""
    lists = folder.folders.get("splits")
    paths = (
        [lists.path / f"Intel-TAU_v3_filelist_subset{number:02d}.txt" for number in range(1, _FOLDS + 1)]
        if lists
        else []
    )
    if not paths or not all(path.is_file() for path in paths):
        return None
    fold_of: dict[str, int] = {}
    for number, path in enumerate(paths):
        for line in read_text(path).split():
            fold_of[_key(line.replace("\\", "/"))] = number
    keys = [_key(scene.name) for scene in scenes]
    return tuple(fold_of[key] for key in keys) if fold_of.keys() >= set(keys) else None


def _key(path: str) -> str:
    parts = path.split("/")[-3:]
    return "/".join([*parts[:-1], _unpadded(parts[-1].rpartition(".")[0])])
