"""Cube and Cube+: 1365 and 1707 images of a Canon EOS 550D with a SpyderCube in their lower right corner.

    cube+_gt.txt         r g b a line; line N is the light of image N (cube_gt.txt: Cube)
    cube+_left_gt.txt    the same of the left and right grey face of the SpyderCube, optional
    cube+_right_gt.txt
    1.PNG … 1707.PNG     16 bits, half-size demosaiced raw, 2601 × 1732; beside it, or in folders PNG…

N. Banić, K. Koščević, S. Lončarić, "Unsupervised learning for color constancy", arXiv:1712.00436, and the data set's
page, ipg.fer.hr/ipg/resources/color_constancy: black 2048 is to be subtracted, the calibration cube is masked by
leaving out the lower right rectangle from row 1050 and column 2050, and clipped pixels as `peaks` says. Layout, black
level and rectangle were held against four public preprocessing programs; not verified against a real copy.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from evaluation.datasets.names import Folder, gather, present
from evaluation.datasets.options import DataOptions, choose, stated
from evaluation.datasets.published.peaks import PEAK_RULE, Peaks, PeakScene
from evaluation.datasets.raw_scene import Mask, box_mask
from evaluation.datasets.truths import read_lights
from evaluation.scene import Image, SceneSet
from foundation.errors import FormatError

BLACK = 2048
"""Black level of the 550D's files; the data set's page."""
CUBE_ROW, CUBE_COLUMN = 1050, 2050
"""From where the calibration cube's rectangle reaches to the lower right corner, px; the data set's page."""

_OWN = {"cube+_gt.txt": ("Cube+", 1707), "cube_gt.txt": ("Cube", 1365)}
"""Name and number of images by the file of ground truths; arXiv:1712.00436."""


@dataclass(frozen=True, slots=True)
class CubePlusScene(PeakScene):
    """An image of Cube or Cube+."""

    def mask(self, image: Image) -> Mask:
        """Return (H, W) bool, True in the rectangle of the cube, of an image (H, W, 3)."""
        height, width = image.shape[:2]
        if height <= CUBE_ROW or width <= CUBE_COLUMN:
            raise FormatError(
                f"{self.path} is {width} × {height}, expected 2601 × 1732: the calibration cube is masked from row "
                f"{CUBE_ROW} and column {CUBE_COLUMN}; use the original files, or a folder of images with a CSV"
            )
        return box_mask((height, width), slice(CUBE_ROW, None), slice(CUBE_COLUMN, None))


def is_cube_plus(folder: Folder) -> bool:
    """Return whether a folder looks like Cube or Cube+."""
    return any(folder.has(name) for name in _OWN)


def open_cube_plus(place: str, options: DataOptions, listed: Folder | None = None) -> SceneSet:
    """Return Cube+ or Cube; images are read when they are used."""
    folder = listed or Folder(Path(place))
    file = next((name for name in _OWN if folder.has(name)), None)
    if file is None:
        raise FormatError(f"{place} is no copy of Cube+: it has no cube+_gt.txt; fetch it from the data set's page")
    name, published = _OWN[file]
    faces = {face: folder.path / file.replace("_gt", f"_{face}_gt") for face in ("left", "right")}
    truths = {"own": folder.path / file} | {face: path for face, path in faces.items() if path.is_file()}
    truth = choose(options.truth, truths, "truth", place) or "own"
    lights = read_lights(truths[truth])
    parts = [part for part_name, part in folder.folders.items() if part_name.upper().startswith("PNG")]
    images = gather([folder, *parts])
    looked = f"{folder.path} (itself and its folders PNG…: {', '.join(part.path.name for part in parts) or 'none'})"
    kept, note = present([str(number) for number in range(1, len(lights) + 1)], images, file, looked, options.partial)
    black = BLACK if options.black is None else options.black
    peaks = Peaks()
    return SceneSet(
        name=name,
        layout="cube-plus",
        place=place,
        scenes=tuple(
            CubePlusScene(
                f"{number + 1}.PNG", images[str(number + 1)], lights[number], black, options.saturation, peaks
            )
            for number in kept
        ),
        treatment={
            "images": note + ("" if len(kept) == published else f"; the published {name} has {published}"),
            "black level": stated(options.black, f"{BLACK}, subtracted (the data set's page)"),
            "saturation": stated(options.saturation, PEAK_RULE),
            "mask": f"the calibration cube: rows from {CUBE_ROW} and columns from {CUBE_COLUMN} (the data set's page)",
            "ground truth": f"{truths[truth].name}" + ("" if truth == "own" else f", the {truth} face of the cube"),
        },
    )
