"""The ColorChecker data set of Gehler, in the linear 12-bit files of Shi and Funt: 568 images, two cameras.

    8D5U5524.png …           86 images of a Canon EOS-1Ds ("1D"), 16-bit files of 12 bits, linear, black not subtracted
    IMG_0281.png …           482 images of a Canon EOS 5D
    coordinates/NAME_macbeth.txt   the size of the image that was annotated, then four corners of the chart: 1 2, 3 4
    ColorCheckerData.mat     with REC_groundtruth (568, 3): the recommended truth; REC_groundtruth.mat is taken too
    real_illum_568..mat      with real_rgb (568, 3): Shi's truth of 2010

Files are found down to three folders deep, so the archives may be unpacked as they are (png/, Canon1D/png/ …).

P. Gehler et al., "Bayesian color constancy revisited", CVPR 2008; L. Shi, B. Funt,
www2.cs.sfu.ca/~colour/data/shi_gehler.
G. Hemrit et al., "Rehabilitating the ColorChecker dataset for illuminant estimation" (CIC 26, 2018, arXiv:1805.12262)
found that three sets of ground truths are in use, each with errors, and made the recommended one (data sets page of
colorconstancy.com), after subtracting black; errors by Shi's truth are not comparable with it. Rows of both belong to
the images in the order of their names. Black levels and saturation: internal/GehlerShiSensor.m of
github.com/google/ffcc, which says that 3580 of older papers "does not appear to be correct"; some programs take black 1
for the 1D. The chart's corners are used as in internal/ReadImage.m there. Not verified against a real copy.
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
    gather,
    numbers_in,
    present,
    read_text,
)
from evaluation.datasets.options import DataOptions, choose, stated
from evaluation.datasets.published.matlab import read_mat, table
from evaluation.scene import Image, SceneSet
from foundation.errors import FormatError, InputError

BLACK: Final = {"1D": 0, "5D": 129}  # Black levels of the two cameras' files (GehlerShiSensor.m of FFCC)
WHITE = 3692  # Saturation of both cameras' files, black not subtracted (GehlerShiSensor.m of FFCC)

# Folders below the one given in which files are looked for: Canon1D/png is two deep, an archive's own one more.
_DEPTH = 3
_SAMPLE = 1000  # Names of a folder that are looked at for corners of charts; the data set has 568
_TRUTHS: Final = {
    "recommended": (("ColorCheckerData.mat", "REC_groundtruth.mat"), "REC_groundtruth"),
    "shi": (("real_illum_568..mat", "real_illum_568.mat"), "real_rgb"),
}
_1D = "5524-5541 5543-5545 5547-5550 5552-5558 5560-5589 5592-5594 5596-5604 5606-5608 5611-5615 5617-5620"
_5D = (
    "281-287 289-293 295-298 300-303 305-307 310 313-321 323-325 327-329 332-337 339-345 350-355 361-372 374-390 "
    "392-414 416-453 455-474 477 479-531 533-534 538-540 542-547 549-556 558-568 570-572 574-578 580-581 583-589 "
    "592-638 661 666 670-688 743-747 749-750 753-763 765-768 770-780 782-826 828-847 849 851 853-855 857-867 869-870 "
    "872-888 890-896 899-903"
)


def _numbers(runs: str) -> Iterator[int]:
    for run in runs.split():
        first, _, last = run.partition("-")
        yield from range(int(first), int(last or first) + 1)


# The 568 images in the order of the rows of both truths: those names that the files of the recommended release carry
# behind the number of their row.
NAMES: Final = tuple([f"8D5U{number}" for number in _numbers(_1D)] + [f"IMG_{number:04d}" for number in _numbers(_5D)])
_KNOWN = frozenset(NAMES)


@dataclass(frozen=True, slots=True)
class MacbethScene(RawScene):
    """An image with its ColorChecker.

    `corners_path`: the text file with the chart's corners.
    """

    corners_path: str = ""

    def mask(self, image: Image) -> Mask:
        """Return (H, W) bool, True on the chart, of an image (H, W, 3)."""
        text = read_text(self.corners_path)
        lines = [numbers_in(line, self.corners_path) for line in text.strip().splitlines()[:5]]
        if len(lines) < 5 or any(len(line) != 2 for line in lines) or min(lines[0]) <= 0:
            raise FormatError(
                f"{self.corners_path} holds something else, expected width and height and then the corners of the "
                "chart, two numbers a line; restore it from the data set's archive"
            )
        height, width = image.shape[:2]
        corners = np.array([lines[number] for number in (1, 2, 4, 3)]) * [width / lines[0][0], height / lines[0][1]]
        return chart_mask((height, width), corners, self.corners_path)


def is_gehler_shi(folder: Folder) -> bool:
    """Return whether a folder looks like the data set: a truth of it, or corners of its charts, are in it or below."""
    known = {name for files, _ in _TRUTHS.values() for name in files}
    return any(
        known.intersection(place.files) or any(name.endswith("_macbeth.txt") for name in place.files[:_SAMPLE])
        for place in folder.within(1)
    )


def open_gehler_shi(place: str, options: DataOptions, listed: Folder | None = None) -> SceneSet:
    """Return the data set, or one camera of it; images are read when they are used."""
    folder = listed or Folder(Path(place))
    places = list(folder.within(_DEPTH))
    truth = choose(options.truth, _TRUTHS, "truth", place) or "recommended"
    path, lights = _read_truth(places, truth, place)
    camera = choose(options.camera, BLACK, "camera", place)
    # Pictures of a mask or a preview lie in folders without any image of the data set.
    found = gather(
        each
        for each in places
        if any(name.lower().endswith(".png") and Path(name).stem in _KNOWN for name in each.files)
    )
    wanted = [name for name in NAMES if camera in (None, camera_of(name))]
    others = set(NAMES).difference(wanted)
    images = {name: file for name, file in found.items() if name not in others}
    kept, note = present(wanted, images, "the data set", folder.path, options.partial)
    corners = {
        name: str(where.path / name) for where in places for name in where.files if name.endswith("_macbeth.txt")
    }
    lacking = [wanted[number] for number in kept if f"{wanted[number]}_macbeth.txt" not in corners]
    if lacking:
        raise FormatError(
            f"{place} lacks {len(lacking)} files of corners of charts, coordinates/{lacking[0]}_macbeth.txt the first; "
            "without them the charts cannot be masked: unpack the archive of measured illumination there"
        )
    rows = {name: number for number, name in enumerate(NAMES)}
    scenes = tuple(
        MacbethScene(
            f"{name}.png",
            images[name],
            check_light(lights[rows[name]].tolist(), f"{path}, row {rows[name] + 1}"),
            BLACK[camera_of(name)] if options.black is None else options.black,
            WHITE if options.saturation is None else options.saturation,
            corners[f"{name}_macbeth.txt"],
        )
        for name in (wanted[number] for number in kept)
    )
    return SceneSet(
        name="Gehler-Shi" + (f" {camera}" if camera else ""),
        layout="gehler-shi",
        location=place,
        scenes=scenes,
        treatment={
            "images": note,
            "black level": stated(
                options.black,
                ", ".join(f"{level} of the {name}" for name, level in BLACK.items())
                + ", subtracted (GehlerShiSensor.m of github.com/google/ffcc)",
            ),
            "saturation": stated(options.saturation, f"from {WHITE}, black not subtracted (GehlerShiSensor.m)"),
            "mask": "the ColorChecker, by the corners in coordinates/*_macbeth.txt",
            "ground truth": f"{_TRUTHS[truth][1]} of {path.name}: "
            + (
                "recommended by Hemrit et al., 2018"
                if truth == "recommended"
                else "Shi's of 2010, which Hemrit et al. replaced in 2018; not comparable with results by theirs"
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


def _read_truth(places: list[Folder], truth: str, place: str) -> tuple[Path, npt.NDArray[np.float64]]:
    files, variable = _TRUTHS[truth]
    found = [folder.path / name for name in files for folder in places if folder.has(name)]
    if not found:
        others = [
            other
            for other, (names, _) in _TRUTHS.items()
            if other != truth and any(folder.has(name) for name in names for folder in places)
        ]
        remedy = f", or take the one that is there with --read truth={others[0]}" if others else ""
        source = (
            "colorconstancy.com, data sets, ColorChecker RECommended"
            if truth == "recommended"
            else "www2.cs.sfu.ca/~colour/data/shi_gehler"
        )
        raise InputError(f"{place} has no {' or '.join(files)}, the {truth} ground truth; fetch it ({source}){remedy}")
    lights = table(read_mat(found[0]), variable, found[0], 3)
    if len(lights) != len(NAMES):
        raise FormatError(f"{found[0]}: {variable} has {len(lights)} rows, expected {len(NAMES)}; restore the file")
    return found[0], lights
