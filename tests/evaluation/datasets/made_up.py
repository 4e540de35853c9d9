"""Synthetic copies of all layouts; their results can be computed by hand."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import imagecodecs
import numpy as np
import numpy.typing as npt

from evaluation.datasets.published.gehler_shi import NAMES

Image = npt.NDArray[np.uint16] | npt.NDArray[np.uint8]

# Red, green and blue of an image, in counts; different, so that exchanged channels are noticed.
COLOUR = (3000, 5000, 4000)


def image_of(height: int, width: int, colour: Sequence[int] = COLOUR) -> npt.NDArray[np.uint16]:
    """Return an image (H, W, 3) uint16 of one colour, red first, whose first pixel is (9000, 100, 7000)."""
    image = np.full((height, width, 3), colour, np.uint16)
    image[0, 0] = (9000, 100, 7000)
    return image


def write_png(path: Path, image: Image) -> None:
    """Write an image (H, W, 3) uint16 or uint8, red first; the reader uses another library."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(_png(image))


def write_large_png(path: Path, height: int, width: int) -> None:
    """Write the image of `image_of`; the encoded file is cached."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(_large_png(height, width))


@lru_cache(maxsize=8)
def _large_png(height: int, width: int) -> bytes:
    return _png(image_of(height, width))


def _png(image: Image) -> bytes:
    is_encoded, data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert is_encoded
    return data.tobytes()


def write_tiff(path: Path, image: npt.NDArray[Any]) -> None:
    """Write an image (H, W, 3) of any dtype, red first."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(imagecodecs.tiff_encode(np.ascontiguousarray(image), photometric="rgb"))


def write_mat(path: Path, variables: Mapping[str, Any]) -> None:
    from scipy.io import savemat

    path.parent.mkdir(parents=True, exist_ok=True)
    savemat(path, dict(variables))


def cells(names: Sequence[str]) -> npt.NDArray[Any]:
    """Return names (N, 1) as MATLAB's cell array of strings."""
    array = np.empty((len(names), 1), dtype=object)
    array[:, 0] = names
    return array


def cube_plus(folder: Path) -> None:
    """Write three images of 1060 × 2060 px; the rectangle of the cube has 10 × 10 px."""
    for name in ("1.PNG", "2.PNG", "PNG_3_9/3.PNG"):
        write_large_png(folder / name, 1060, 2060)
    (folder / "cube+_gt.txt").write_text("0.1 0.5 0.4\n0.2 0.5 0.3\n0.3 0.5 0.2\n")
    (folder / "cube+_left_gt.txt").write_text("0.25 0.5 0.25\n" * 3)


CUBE_PLUS_PLUS_HEADER = "image," + ",".join(
    f"{face}_{channel}" for face in ("mean", "left", "right", "left_white", "right_white") for channel in "rgb"
)


def cube_plus_plus(folder: Path) -> None:
    """Write two images, the first with a white level, the second without a mean ground truth."""
    for name in ("00_0001", "00_0002"):
        write_large_png(folder / "PNG" / f"{name}.png", 1728, 2592)
    rest = "0.1,0.5,0.4,0.2,0.5,0.3,0.11,0.5,0.39,0.21,0.5,0.29"
    (folder / "gt.csv").write_text(f"{CUBE_PLUS_PLUS_HEADER}\n00_0001,0.15,0.5,0.35,{rest}\n00_0002,,,,{rest}\n")
    (folder / "properties.csv").write_text(
        "image,estimation,MakerNotes:NormalWhiteLevel\n00_0001,full,8000\n00_0002,partial,\n"
    )


def simple_cube(folder: Path) -> None:
    """Write one image of 648 × 432 px in each subset, the rectangle of the cube painted over."""
    image = image_of(432, 648)
    image[182:, 473:] = 0
    for part, name, light in (("train", "00_0003", "0.15,0.5,0.35"), ("test", "01_0004", "0.2,0.5,0.3")):
        write_png(folder / part / "PNG" / f"{name}.png", image)
        (folder / part / "gt.csv").write_text(f"image,r,g,b\n{name},{light}\n")
    (folder / "auxiliary").mkdir()


def nus8(folder: Path) -> None:
    """Write two cameras of two images each, 8 × 10 px, the charts in rows 2 to 4 and columns 6 to 10."""
    for camera, black, white in (("SonyA57", 128, 4093), ("NikonD5200", 0, 15892)):
        names = [f"{camera}_{number:04d}" for number in (1, 3)]
        for name in names:
            write_png(folder / camera / f"{name}.PNG", image_of(8, 10))
        write_mat(
            folder / camera / f"{camera}_gt.mat",
            {
                "groundtruth_illuminants": np.array([[0.1, 0.5, 0.4], [0.2, 0.5, 0.3]]),
                "darkness_level": np.array([[black]], np.uint16),
                "saturation_level": np.array([[white]], np.uint16),
                "CC_coords": np.array([[2, 4, 6, 10], [1, 8, 1, 1]], np.uint16),
                "all_image_names": cells(names),
            },
        )


# Corners of a chart, annotated on an image of 16 × 20 px: columns 2 to 6, rows 2 to 4 at half the size.
MACBETH = "20 16\n4 4\n11.98 4\n4 8\n12 8\n"


def gehler_shi(folder: Path) -> None:
    """Write the first and last image of the data set and one between, 8 × 10 px, with both ground truths."""
    for name, part in ((NAMES[0], "Canon1D"), (NAMES[86], "Canon5D"), (NAMES[567], "Canon5D")):
        write_png(folder / part / "png" / f"{name}.png", image_of(8, 10))
        corners = folder / "coordinates" / f"{name}_macbeth.txt"
        corners.parent.mkdir(exist_ok=True)
        corners.write_text(MACBETH)
    rows = np.arange(568)[:, None] + np.array([[1.0, 1000.0, 2000.0]])
    write_mat(folder / "ColorCheckerData.mat", {"REC_groundtruth": rows})
    write_mat(folder / "real_illum_568..mat", {"real_rgb": rows[:, ::-1].copy()})


def levi(folder: Path) -> None:
    """Write 11 images of 8 × 10 px, so that 10 and 2 are in another order by name; the chart has two pixels."""
    mask = np.zeros((8, 10, 3), np.uint8)
    mask[3, 4:6] = 255
    for number in range(1, 12):
        write_png(folder / "img" / f"{number}.png", image_of(8, 10))
        write_png(folder / "msk" / f"{number}.png", mask)
    write_mat(folder / "gt.mat", {"gts": np.arange(1, 12)[:, None] + np.array([[0.0, 100.0, 200.0]])})
    (folder / "LEVI dataset EXIF information.csv").write_text("name,ISO\n1.png,500\n")


def intel_tau(folder: Path) -> None:
    """Write two cameras with one and two subsets, 8 × 10 px, two pixels painted over."""
    image = image_of(8, 10)
    image[3, 4:6] = 0
    for path, light in (
        ("Canon_5DSR/field_1_cameras/C_5DSR_field_2", "0.3 0.5 0.2"),
        ("Canon_5DSR/lab_printouts/C_5DSR_lab_10", "0.25 0.5 0.25"),
        ("Nikon_D810/field_1_cameras/N_D810_field_7", "0.2\n0.5\n0.3"),
    ):
        write_tiff(folder / f"{path}.tiff", image)
        stem, _, number = path.rpartition("_")
        (folder / f"{stem}_{number.zfill(3)}.wp").write_text(light)


# Corners in px of the raw file: columns 2 to 4 and rows 2 to 4 of the half-size image.
CHARTS = {f"mcc{number}": [[4, 4], [8, 4], [8, 8], [4, 8]] for number in (1, 2, 3)}

LIGHTS = {"Light1": [0.5, 1, 0.5], "Light2": [2.0, 1, 1.0], "Light3": [1.0, 1, 3.0]}


def lsmi(folder: Path) -> None:
    """Write a place under one and two illuminants and one under three, with a Sony camera, 8 × 10 px."""
    camera = folder / "sony"
    two = np.full((8, 10, 2), (0.25, 0.75))
    two[7, 9] = -1
    three = np.full((8, 10, 3), (0.2, 0.2, 0.4))
    for place, image, shares in (
        ("Place1", "1", None),
        ("Place1", "12", two),
        ("Place2", "1", None),
        ("Place2", "123", three),
    ):
        write_tiff(camera / place / f"{place}_{image}.tiff", image_of(8, 10))
        if shares is not None:
            np.save(camera / place / f"{place}_{image}.npy", shares)
    meta = {
        "Place1": {"NumOfLights": 2, "MCCCoord": CHARTS, "Light1": LIGHTS["Light1"], "Light2": LIGHTS["Light2"]},
        "Place2": {"NumOfLights": 3, "MCCCoord": CHARTS, **LIGHTS},
    }
    (camera / "meta.json").write_text(json.dumps(meta))
    (camera / "split.json").write_text(
        json.dumps({"two_illum_train": ["Place1"], "two_illum_val": [], "three_illum_test": ["Place2"]})
    )


def lsmi_preprocessed(folder: Path) -> None:
    """Write output of 2_preprocess_data.py: folders by subset, black subtracted, masks as pictures."""
    camera = folder / "sony_512"
    mask = np.ones((8, 10), np.uint8)
    mask[2:5, 2:5] = 0
    two = np.full((8, 10, 2), (0.25, 0.75))
    two[7, 9] = 0
    for name in ("Place1_1", "Place1_12"):
        write_tiff(camera / "train" / f"{name}.tiff", image_of(8, 10))
        write_tiff(camera / "train" / f"{name}_gt.tiff", image_of(8, 10))
    np.save(camera / "train" / "Place1_12.npy", two)
    np.save(camera / "train" / "Place1_12_illum.npy", two)
    assert cv2.imwrite(str(camera / "train" / "Place1_mask.png"), mask)
    meta = {"Place1": {"NumOfLights": 2, "Light1": LIGHTS["Light1"], "Light2": LIGHTS["Light2"]}}
    (camera / "meta.json").write_text(json.dumps(meta))
    (camera / "split.json").write_text(json.dumps({"two_illum_train": ["Place1"]}))


def ffcc(folder: Path) -> None:
    """Write thumbnails of 8 and 16 bits in two folders, one with a pixel of zeros."""
    image = image_of(8, 10)
    image[1, 2] = 0
    write_png(folder / "folder_1" / "000001.png", image)
    (folder / "folder_1" / "000001.txt").write_text("0.500249\n0.819743\n0.278876\n")
    write_png(folder / "folder_2" / "000001.png", np.full((8, 10, 3), (30, 50, 40), np.uint8))
    (folder / "folder_2" / "000001.txt").write_text("0.1 0.2 0.3\n")


def plain_folder(folder: Path) -> None:
    """Write a PNG with a mask, a TIFF of floats and a NumPy file, with individual levels."""
    write_png(folder / "a.png", image_of(8, 10))
    write_tiff(folder / "more" / "b.tiff", image_of(8, 10).astype(np.float32) / 2)
    np.save(folder / "c.npy", image_of(8, 10))
    mask = np.zeros((8, 10), np.uint8)
    mask[5:, :2] = 255
    assert cv2.imwrite(str(folder / "a_mask.png"), mask)
    (folder / "gt.csv").write_text(
        "image,r,g,b,black,saturation,mask,fold\n"
        "a.png,0.2,0.5,0.3,512,8192,a_mask.png,1\n"
        "more/b,0.3,0.5,0.2,,,,0\n"
        "c,1,2,1,100.5,4000,,1\n"
    )


def thumbnails(folder: Path) -> None:
    """Write an archive of two thumbnails, the first with a pixel of zeros."""
    images = np.stack([image_of(4, 5), image_of(4, 5)]).astype(np.float32)
    images[0, 1, 1] = 0
    np.savez(folder / "thumbs.npz", images=images, gt=np.array([[0.2, 0.5, 0.3], [1, 2, 1]]), names=["one", "two"])


@dataclass(frozen=True)
class MadeUp:
    """Synthetic copy of a layout.

    - `layout`: name of the layout.
    - `make`: writes the copy into an empty folder.
    - `subfolder`: path of the data set in that folder.
    - `partial`: images of the published data set are missing.
    """

    layout: str
    make: Callable[[Path], None]
    subfolder: str = "."
    partial: bool = False


# One copy of each layout, for each path that a user may give.
COPIES = {
    "cube-plus": MadeUp("cube-plus", cube_plus),
    "cube++": MadeUp("cube++", cube_plus_plus),
    "simple-cube++": MadeUp("simple-cube++", simple_cube),
    "simple-cube++ train": MadeUp("simple-cube++", simple_cube, "train"),
    "nus8": MadeUp("nus8", nus8),
    "nus8 camera": MadeUp("nus8", nus8, "SonyA57"),
    "gehler-shi": MadeUp("gehler-shi", gehler_shi, partial=True),
    "intel-tau": MadeUp("intel-tau", intel_tau),
    "intel-tau camera": MadeUp("intel-tau", intel_tau, "Canon_5DSR"),
    "lsmi": MadeUp("lsmi", lsmi),
    "lsmi camera": MadeUp("lsmi", lsmi, "sony"),
    "lsmi prepared": MadeUp("lsmi", lsmi_preprocessed, "sony_512"),
    "levi": MadeUp("levi", levi),
    "ffcc": MadeUp("ffcc", ffcc),
    "folder": MadeUp("folder", plain_folder),
    "folder table": MadeUp("folder", plain_folder, "gt.csv"),
    "thumbnails": MadeUp("thumbnails", thumbnails, "thumbs.npz"),
}
