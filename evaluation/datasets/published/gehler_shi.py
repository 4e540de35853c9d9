"""Read the ColorChecker data set of Gehler, in the linear 12-bit files of Shi and Funt: 568 images, two cameras.

    8D5U5524.png …           86 images of a Canon EOS-1Ds ("1D"), 12-bit values in 16-bit files, black not subtracted
    IMG_0281.png …           482 images of a Canon EOS 5D
    coordinates/NAME_macbeth.txt   size of the annotated image, then four chart corners in reading order
    ColorCheckerData.mat     REC_groundtruth (568, 3): recommended ground truth; REC_groundtruth.mat is read too
    real_illum_568..mat      real_rgb (568, 3): Shi's ground truth of 2010

Subfolders are searched to a depth of three, so that the archives may be unpacked unchanged (png/, Canon1D/png/ …).

P. Gehler et al., "Bayesian color constancy revisited", CVPR 2008; L. Shi, B. Funt,
www2.cs.sfu.ca/~colour/data/shi_gehler. G. Hemrit et al., "Rehabilitating the ColorChecker dataset for illuminant
estimation" (CIC 26, 2018, arXiv:1805.12262) describe errors in the three earlier sets of ground truths, and recommend a
new set (colorconstancy.com). Results with Shi's ground truth and with the new set are not comparable. Rows of both sets
are in the order of the image names. Black levels and saturation are from internal/GehlerShiSensor.m of
github.com/google/ffcc. According to this file, the saturation 3580 of older papers is not correct. Some programs use
black 1 for the 1D. Chart corners are read as in internal/ReadImage.m of FFCC. Not verified against a real copy.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from evaluation.datasets.files import (
    Folder,
    Mask,
    RawScene,
    chart_mask,
    check_light,
    gather_images,
    match_images,
    read_text,
    to_numbers,
)
from evaluation.datasets.options import DataOptions, choose_name, level_note
from evaluation.datasets.published.matlab import numeric_table, read_mat
from evaluation.scene import Image, SceneSet
from foundation.errors import FormatError, InputError

BLACK: Final = {"1D": 0, "5D": 129}  # black levels of both cameras' files, counts (GehlerShiSensor.m of FFCC)
WHITE = 3692  # saturation of both cameras' files, counts, black not subtracted (GehlerShiSensor.m of FFCC)

# Levels of subfolders that are searched: two for Canon1D/png, one for the folder of an archive.
_SEARCH_DEPTH = 3
_SAMPLED_NAMES = 1000  # names of a folder that are searched for chart corners; the data set has 568
_TRUTHS: Final = {
    "recommended": (("ColorCheckerData.mat", "REC_groundtruth.mat"), "REC_groundtruth"),
    "shi": (("real_illum_568..mat", "real_illum_568.mat"), "real_rgb"),
}
_IDS_1D = "5524-5541 5543-5545 5547-5550 5552-5558 5560-5589 5592-5594 5596-5604 5606-5608 5611-5615 5617-5620"
_IDS_5D = (
    "281-287 289-293 295-298 300-303 305-307 310 313-321 323-325 327-329 332-337 339-345 350-355 361-372 374-390 "
    "392-414 416-453 455-474 477 479-531 533-534 538-540 542-547 549-556 558-568 570-572 574-578 580-581 583-589 "
    "592-638 661 666 670-688 743-747 749-750 753-763 765-768 770-780 782-826 828-847 849 851 853-855 857-867 869-870 "
    "872-888 890-896 899-903"
)


def _expand(ranges: str) -> Iterator[int]:
    for number_range in ranges.split():
        first, _, last = number_range.partition("-")
        yield from range(int(first), int(last or first) + 1)


# The 568 images in the order of the rows of both ground truths, from the file names of the recommended release.
NAMES: Final = (*(f"8D5U{id_:d}" for id_ in _expand(_IDS_1D)), *(f"IMG_{id_:04d}" for id_ in _expand(_IDS_5D)))
_NAME_SET = frozenset(NAMES)


@dataclass(frozen=True, slots=True)
class MacbethScene(RawScene):
    """Image with a ColorChecker; `corners_path` is the text file with the corners of the chart."""

    corners_path: str = ""

    def mask(self, image: Image) -> Mask:
        """Return (H, W) bool for an image (H, W, 3), True on the chart."""
        text = read_text(self.corners_path)
        lines = [to_numbers(line, self.corners_path) for line in text.strip().splitlines()[:5]]
        if len(lines) < 5 or any(len(line) != 2 for line in lines) or min(lines[0]) <= 0:
            raise FormatError(
                f"{self.corners_path}, line 1: {text.strip().partition(chr(10))[0][:80] or 'empty'!r}; expected five "
                "lines of two numbers, the image size and four chart corners; restore it from the data set's archive"
            )
        height, width = image.shape[:2]
        corners = np.array([lines[number] for number in (1, 2, 4, 3)]) * [width / lines[0][0], height / lines[0][1]]
        return chart_mask((height, width), corners, self.corners_path)


def is_gehler_shi(folder: Folder) -> bool:
    """Return True if the folder or a direct subfolder has a ground truth or chart corners of the data set."""
    truth_files = {name for files, _ in _TRUTHS.values() for name in files}
    return any(
        truth_files.intersection(child.files)
        or any(name.endswith("_macbeth.txt") for name in child.files[:_SAMPLED_NAMES])
        for child in folder.within(1)
    )


def open_gehler_shi(location: str, options: DataOptions, scanned_folder: Folder | None = None) -> SceneSet:
    """Return the images of both cameras, or of the selected one; images are read on use."""
    folder = scanned_folder or Folder(Path(location))
    folders = list(folder.within(_SEARCH_DEPTH))
    truth = choose_name(options.truth, _TRUTHS, "truth", location) or "recommended"
    path, lights = _read_truth(folders, truth, location)
    camera = choose_name(options.camera, BLACK, "camera", location)
    # Folders without an image of the data set are ignored, because they may contain masks or previews.
    all_images = gather_images(
        candidate
        for candidate in folders
        if any(name.lower().endswith(".png") and Path(name).stem in _NAME_SET for name in candidate.files)
    )
    selected_names = [name for name in NAMES if camera in (None, camera_of(name))]
    other_names = set(NAMES).difference(selected_names)
    images = {name: file for name, file in all_images.items() if name not in other_names}
    indices, note = match_images(selected_names, images, "the data set", folder.path, options.partial)
    corners = {
        name: str(child.path / name) for child in folders for name in child.files if name.endswith("_macbeth.txt")
    }
    missing = [selected_names[index] for index in indices if f"{selected_names[index]}_macbeth.txt" not in corners]
    if missing:
        raise FormatError(
            f"{location} lacks {len(missing)} files of chart corners, first coordinates/{missing[0]}_macbeth.txt; "
            "expected one for each image, to mask its chart; unpack the archive with the coordinates there"
        )
    rows = {name: index for index, name in enumerate(NAMES)}
    scenes = tuple(
        MacbethScene(
            f"{name}.png",
            images[name],
            check_light(lights[rows[name]].tolist(), f"{path}, row {rows[name] + 1}"),
            BLACK[camera_of(name)] if options.black is None else options.black,
            WHITE if options.saturation is None else options.saturation,
            corners[f"{name}_macbeth.txt"],
        )
        for name in (selected_names[index] for index in indices)
    )
    return SceneSet(
        name="Gehler-Shi" + (f" {camera}" if camera else ""),
        layout="gehler-shi",
        location=location,
        scenes=scenes,
        treatment={
            "images": note,
            "black level": level_note(
                options.black,
                ", ".join(f"{level} for the {name}" for name, level in BLACK.items())
                + ", subtracted (GehlerShiSensor.m of github.com/google/ffcc)",
            ),
            "saturation": level_note(options.saturation, f"from {WHITE}, black not subtracted (GehlerShiSensor.m)"),
            "mask": "the ColorChecker, by the corners in coordinates/*_macbeth.txt",
            "ground truth": f"{_TRUTHS[truth][1]} of {path.name}: "
            + (
                "recommended by Hemrit et al., 2018"
                if truth == "recommended"
                else "by Shi, 2010, replaced by Hemrit et al. in 2018; results with the two are not comparable"
            ),
        },
    )


def camera_of(name: str) -> str:
    """Return the camera of an image: "1D" or "5D".

    Examples
    --------
    >>> camera_of("8D5U5524"), camera_of("IMG_0281")
    ('1D', '5D')
    """
    return "5D" if name.startswith("IMG_") else "1D"


def _read_truth(folders: list[Folder], truth: str, location: str) -> tuple[Path, npt.NDArray[np.float64]]:
    files, variable = _TRUTHS[truth]
    paths = [folder.path / name for name in files for folder in folders if folder.has(name)]
    if not paths:
        alternatives = [
            other_truth
            for other_truth, (names, _) in _TRUTHS.items()
            if other_truth != truth and any(folder.has(name) for name in names for folder in folders)
        ]
        remedy = f", or use --read truth={alternatives[0]}" if alternatives else ""
        source = (
            "colorconstancy.com, data sets, ColorChecker RECommended"
            if truth == "recommended"
            else "www2.cs.sfu.ca/~colour/data/shi_gehler"
        )
        raise InputError(f"{location} has no {' or '.join(files)}, the {truth} ground truth; get it ({source}){remedy}")
    lights = numeric_table(read_mat(paths[0]), variable, paths[0], 3)
    if len(lights) != len(NAMES):
        raise FormatError(f"{paths[0]}: {variable} has {len(lights)} rows, expected {len(NAMES)}; restore the file")
    return paths[0], lights
