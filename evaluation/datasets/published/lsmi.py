"""Read LSMI: 7486 images of 2700 places by three cameras, under one to three illuminants that are known by pixel.

Layout::

    galaxy/meta.json         for each place: NumOfLights, MCCCoord (mcc1 … mcc3: corners of a chart), Light1 … (r, 1, b)
    galaxy/split.json        places by subset: two_illum_train, two_illum_val, two_illum_test, three_illum_…
    galaxy/Place1/Place1_12.tiff   the place under illuminants 1 and 2: 16 bits, half-size raw, black not subtracted
    galaxy/Place1/Place1_12.npy    (H, W, K): fraction of each illuminant in the green of a pixel, -1 if unknown

    galaxy_512/meta.json, split.json     output of 2_preprocess_data.py: black subtracted, cropped and resized
    galaxy_512/test/Place1_12.tiff, Place1_12.npy, Place1_mask.png (0 on the charts)

Run the authors' programs first. 0_cvt2tiff.py makes the .tiff files from the published raw files (dcraw -h -D -4 -T).
1_make_mixture_map.py makes the .npy files and the illuminants in meta.json. D. Kim et al., "Large scale
multi-illuminant (LSMI) dataset for developing white balance algorithm under mixed illumination", ICCV 2021, and
github.com/DY112/LSMI-dataset, the source of all levels and masks. Not verified against a real copy.

The illuminants of a place are scaled to green 1. The illuminant of a pixel is their mean, weighted by their fractions
in the pixel. As in the authors' programs, levels of the Sony are constants; levels of the Galaxy and Nikon are read
from a raw file.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt

from evaluation.datasets.files import Folder, Light, Mask, RawScene, chart_mask, check_light, read_text
from evaluation.datasets.options import DataOptions, choose_name, level_note
from evaluation.scene import Image, Scene, SceneSet
from foundation.errors import FormatError, InputError, first_few
from generator.files import decode_png

# Black level and saturation of Sony's .tiff files, counts (1_make_mixture_map.py).
_SONY_LEVELS: Final = (128.0, 4095.0)
_REDUCTION = 2  # chart corners are in px of the raw file; the .tiff is half as large (1_make_mixture_map.py)
_SUBSETS = ("train", "val", "test")
_MIXES: Final = {"single": (1,), "mixed": (2, 3)}  # numbers of illuminants of the images
_IMAGE_NAME = re.compile(r"(?P<place>.+)_(?P<lights>[123]{1,3})\.tiff?")
_RAW_ENDINGS = (".dng", ".nef", ".arw")


@dataclass(frozen=True, slots=True)
class LsmiScene(RawScene):
    """Image under one illuminant.

    - `charts`: corners of each chart, x and y, px of the image; empty if `mask_path` is given.
    - `mask_path`: picture that is 0 on the charts; empty if `charts` are given.
    """

    charts: tuple[tuple[tuple[float, float], ...], ...] = ()
    mask_path: str = ""

    def mask(self, image: Image) -> Mask:
        """Return (H, W) bool for an image (H, W, 3), True on the charts."""
        height, width = image.shape[:2]
        if self.mask_path:
            return _read_mask(self.mask_path, (height, width))
        mask = np.zeros((height, width), dtype=bool)
        for chart in self.charts:
            mask |= chart_mask((height, width), np.array(chart), self.path)
        return mask


@dataclass(frozen=True, slots=True)
class LsmiMixedScene(LsmiScene):
    """Image under two or three illuminants; `light` is not used.

    - `illuminants`: K illuminants, linear camera RGB with green 1.
    - `shares_path`: file with the fraction of each illuminant in each pixel.
    """

    illuminants: tuple[Light, ...] = ()
    shares_path: str = ""
    _cached: dict[str, npt.NDArray[np.float64]] = field(
        default_factory=dict[str, npt.NDArray[np.float64]], repr=False, compare=False
    )

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """Ground truth (3,) float64, r + g + b = 1: mean over the pixels whose illuminant is known."""
        if "truth" not in self._cached:
            weights = self.read_weights().reshape(-1, len(self.illuminants))
            mean = weights[np.isfinite(weights[:, 0])].mean(axis=0, dtype=np.float64) @ self.lights
            self._cached["truth"] = mean / mean.sum()
        return self._cached["truth"]

    @property
    def lights(self) -> npt.NDArray[np.float64]:
        """Illuminants (K, 3) float64, linear camera RGB with green 1."""
        return np.array(self.illuminants)

    def read_weights(self) -> npt.NDArray[np.float32]:
        """Return the fraction of each illuminant in each pixel: (H, W, K) float32, 0 … 1, sum 1; NaN if unknown."""
        try:
            shares = np.load(self.shares_path, allow_pickle=False)
        except Exception as error:  # NumPy evaluates file headers, so a damaged file may raise any error.
            raise FormatError(
                f"{self.shares_path} cannot be read: {error}; make it again with 1_make_mixture_map.py"
            ) from error
        if shares.ndim != 3 or shares.shape[2] != len(self.illuminants) or shares.dtype.kind != "f":
            raise FormatError(
                f"{self.shares_path} is {shares.dtype} {shares.shape}, expected float (height, width, "
                f"{len(self.illuminants)}); make it again with 1_make_mixture_map.py"
            )
        weights = np.maximum(shares, 0).astype(np.float32)
        total = weights.sum(axis=2, keepdims=True)
        valid = (total > 0) & np.isfinite(total)
        if not valid.any():
            raise FormatError(f"{self.shares_path} has no pixel with known illuminants, expected some; make it again")
        return np.asarray(np.where(valid, weights / np.where(valid, total, 1), np.float32(np.nan)), dtype=np.float32)

    def read_truth_map(self) -> npt.NDArray[np.float32]:
        """Return the illuminant of each pixel: (H, W, 3) float32, r + g + b = 1; NaN if unknown."""
        lights = self.read_weights() @ self.lights.astype(np.float32)
        return np.asarray(lights / lights.sum(axis=2, keepdims=True), dtype=np.float32)


def is_lsmi(folder: Folder) -> bool:
    """Return True if a folder or a direct subfolder has `meta.json` and `split.json`."""
    return bool(_cameras(folder))


def open_lsmi(location: str, options: DataOptions, scanned_folder: Folder | None = None) -> SceneSet:
    """Return the images of the selected camera and subset; they are read on use.

    `options.subset` is "train", "val" or "test", or "single" or "mixed" illuminants, or both: "test-mixed".
    """
    folder = scanned_folder or Folder(Path(location))
    cameras = _cameras(folder)
    if not cameras:
        raise FormatError(f"{location} has no meta.json and split.json, expected LSMI; give a camera's folder")
    camera = choose_name(options.camera, cameras, "camera", location)
    subset, mix = _parse_subset(options.subset, location)
    scenes: list[Scene] = []
    levels: list[tuple[str, str]] = []
    notes: list[str] = []
    for name, camera_folder in cameras.items():
        if camera in (None, name):
            reader = _Camera(name, camera_folder, _read_json(camera_folder, "meta.json"), options)
            places = _subsets_by_place(camera_folder, subset)
            camera_scenes = list(reader.scenes(places, subset, _MIXES.get(mix or "", (1, 2, 3))))
            scenes.extend(camera_scenes)
            mixed_count = sum(isinstance(scene, LsmiMixedScene) for scene in camera_scenes)
            notes.append(f"{name} {len(camera_scenes)}, {mixed_count} under several illuminants")
            if reader.excluded:
                notes.append(f"{len(reader.excluded)} without ground truth are excluded ({first_few(reader.excluded)})")
            levels.append(reader.describe_levels())
    if not scenes:
        raise FormatError(f"{location} has no .tiff of {options.subset or 'any place'}; make them with 0_cvt2tiff.py")
    black, white = zip(*levels, strict=True)
    return SceneSet(
        name="LSMI" + "".join(f" {selection}" for selection in (camera, options.subset) if selection),
        layout="lsmi",
        location=location,
        scenes=tuple(scenes),
        treatment={
            "images": ", ".join(notes),
            "black level": level_note(options.black, ", ".join(black)),
            "saturation": level_note(options.saturation, ", ".join(white)),
            "mask": "the three charts of each place, in every subset (not masked in the test of the authors)",
            "ground truth": "illuminants of meta.json, green 1, weighted in each pixel by the fractions in the .npy "
            "file; unknown if these are -1 or all 0. Single-illuminant methods are compared with the mean over the "
            "known pixels",
        },
    )


def _cameras(folder: Folder) -> dict[str, Folder]:
    candidates = {folder.path.resolve().name: folder, **folder.folders}
    return {name: folder for name, folder in candidates.items() if folder.has("meta.json") and folder.has("split.json")}


def _parse_subset(requested: str | None, location: str) -> tuple[str | None, str | None]:
    if requested is None:
        return None, None
    names = [*_SUBSETS, *_MIXES, *(f"{subset}-{mix}" for subset in _SUBSETS for mix in _MIXES)]
    words = (choose_name(requested, names, "subset", location) or "").split("-")
    subset = next((word for word in words if word in _SUBSETS), None)
    return subset, next((word for word in words if word in _MIXES), None)


def _read_json(folder: Folder, name: str) -> Mapping[str, Any]:
    path = folder.path / name
    try:
        content: Any = json.loads(read_text(path))
    except ValueError as error:
        raise FormatError(f"{path} cannot be read as JSON: {error}; restore it") from error
    if not isinstance(content, dict) or not content:
        raise FormatError(f"{path} has no places, expected an object with a key for each place; restore it")
    return cast("Mapping[str, Any]", content)


def _subsets_by_place(folder: Folder, subset: str | None) -> dict[str, str]:
    """Return the subset of each place, in the order of `split.json`; with `subset`, only the places of that subset."""
    subsets: dict[str, str] = {}
    for key, places in _read_json(folder, "split.json").items():
        name = key.rpartition("_")[2]
        if name not in _SUBSETS or not isinstance(places, list):
            raise FormatError(
                f"{folder.path / 'split.json'} has {key!r}, expected …_train, …_val or …_test; restore it"
            )
        if subset in (None, name):
            subsets.update((str(place), name) for place in cast("list[Any]", places))
    return subsets


@dataclass(frozen=True)
class _Camera:
    """Reader of the scenes of one camera."""

    name: str
    folder: Folder
    meta: Mapping[str, Any]
    options: DataOptions
    excluded: list[str] = field(default_factory=list[str])  # images without ground truth, with --read partial

    @property
    def is_preprocessed(self) -> bool:
        """True if the folder was made by 2_preprocess_data.py: its subfolders are subsets, not places."""
        return any(subset in self.folder.folders for subset in _SUBSETS)

    def describe_levels(self) -> tuple[str, str]:
        """Return black level and saturation with their sources, as text."""
        black, white, source = self.levels()
        if self.is_preprocessed:
            return f"{self.name} 0: {source}", f"{self.name} none: clipping cannot be detected in resized pixels"
        return f"{self.name} {black:g}, subtracted ({source})", f"{self.name} from {white:g} ({source})"

    def levels(self) -> tuple[float, float | None, str]:
        """Return black level, saturation and their source."""
        black_option, white_option = self.options.black, self.options.saturation
        if self.is_preprocessed:
            return black_option or 0.0, white_option, "subtracted by 2_preprocess_data.py"
        if black_option is not None and white_option is not None:
            return float(black_option), white_option, "the user"
        if "sony" in self.name.lower():
            black, white, source = *_SONY_LEVELS, "1_make_mixture_map.py"
        else:
            black, white, source = self._read_raw_levels()
        return black if black_option is None else black_option, white if white_option is None else white_option, source

    def _read_raw_levels(self) -> tuple[float, float, str]:
        # The authors' programs use the same fields of a raw file.
        path = self._find_raw_file()
        if path is None:
            raise InputError(
                f"{self.folder.path} has no raw file of {self.name} for black level and saturation, expected "
                f"{self.name}.dng in it or next to it (from github.com/DY112/LSMI-dataset), or raw files next to the "
                ".tiff files; add one, or give --read black=LEVEL --read saturation=LEVEL"
            )
        import rawpy

        try:
            with rawpy.imread(str(path)) as raw:
                return float(min(raw.black_level_per_channel)), float(raw.white_level), path.name
        except rawpy.LibRawError as error:
            raise FormatError(
                f"{path} cannot be read as a raw file: {error}; give --read black=LEVEL --read saturation=LEVEL"
            ) from error

    def _find_raw_file(self) -> Path | None:
        for folder in (self.folder.path, self.folder.path.resolve().parent):
            if (folder / f"{self.name}.dng").is_file():
                return folder / f"{self.name}.dng"
        for place in self.folder.folders.values():
            for name in place.files:
                if name.lower().endswith(_RAW_ENDINGS):
                    return place.path / name
        return None

    def scenes(self, places: Mapping[str, str], subset: str | None, counts: Sequence[int]) -> Iterator[LsmiScene]:
        """Yield the images of places, in order. `counts`: numbers of illuminants of the images that are included."""
        black, white, _ = self.levels()
        folders = self.folder.folders
        missing: list[str] = []
        selected = [name for name in _SUBSETS if name in folders and subset in (None, name)]
        images_by_subset = {name: _images_by_place(folders[name]) for name in selected}
        for place, place_subset in places.items():
            if self.is_preprocessed:
                folder, images = folders.get(place_subset), images_by_subset.get(place_subset, {}).get(place, [])
            else:
                folder = folders.get(place)
                images = _images_by_place(folder).get(place, []) if folder else []
            if folder is None or not images:
                missing.append(place)
                continue
            for image, lights in images:
                if len(lights) not in counts:
                    continue
                origin = f"{self.folder.path / 'meta.json'}, {place}"
                try:
                    illuminants = tuple(self._parse_light(place, number, origin) for number in lights)
                except FormatError:
                    # The authors' meta.json has NaN as the illuminant of some places.
                    if not self.options.partial:
                        raise
                    self.excluded.append(image)
                    continue
                yield self._scene(folder, place, image, illuminants, black, white)
        if missing and not self.options.partial:
            raise FormatError(
                f"{self.folder.path} lacks the .tiff files of {len(missing)} of {len(places)} places "
                f"({first_few(missing)}); make them with 0_cvt2tiff.py, or use the existing ones with --read partial"
            )

    def _scene(
        self,
        folder: Folder,
        place: str,
        image: str,
        illuminants: tuple[Light, ...],
        black: float,
        white: float | None,
    ) -> LsmiScene:
        origin = f"{self.folder.path / 'meta.json'}, {place}"
        name, path = f"{self.name}/{image}", str(folder.path / image)
        mask_path = str(folder.path / f"{place}_mask.png") if self.is_preprocessed else ""
        charts = () if self.is_preprocessed else self._chart_corners(place, origin)
        if len(illuminants) == 1:
            return LsmiScene(name, path, illuminants[0], black, white, charts, mask_path)
        shares = f"{path.rpartition('.')[0]}.npy"
        if not Path(shares).is_file():
            raise FormatError(f"{shares} is missing, the illuminant fractions of {image}; run 1_make_mixture_map.py")
        return LsmiMixedScene(name, path, illuminants[0], black, white, charts, mask_path, illuminants, shares)

    def _parse_light(self, place: str, number: str, origin: str) -> Light:
        values = self._record(place).get(f"Light{number}")
        if not isinstance(values, list):
            raise FormatError(f"{origin} has no Light{number}, expected red, green, blue; run 1_make_mixture_map.py")
        try:
            return check_light(
                [float(value) for value in cast("list[Any]", values)],
                f"{origin}, Light{number}",
                "restore the file, or exclude the images without ground truth with --read partial",
            )
        except (TypeError, ValueError) as error:
            raise FormatError(f"{origin}: Light{number} is {values}, expected three numbers; restore it") from error

    def _chart_corners(self, place: str, origin: str) -> tuple[tuple[tuple[float, float], ...], ...]:
        try:
            corners = [
                np.asarray(self._record(place)["MCCCoord"][f"mcc{number}"], dtype=np.float64) for number in (1, 2, 3)
            ]
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(
                f"{origin} has no MCCCoord with mcc1, mcc2, mcc3: the charts' corners; restore it"
            ) from error
        if any(chart.shape != (4, 2) or not np.isfinite(chart).all() for chart in corners):
            raise FormatError(f"{origin}: MCCCoord is wrong, expected four corners, x and y, of each chart; restore it")
        return tuple(tuple((float(x) / _REDUCTION, float(y) / _REDUCTION) for x, y in chart) for chart in corners)

    def _record(self, place: str) -> Mapping[str, Any]:
        record = self.meta.get(place)
        if not isinstance(record, dict):
            raise FormatError(f"{self.folder.path / 'meta.json'} lacks {place} of split.json; restore both")
        return cast("Mapping[str, Any]", record)


def _images_by_place(folder: Folder) -> dict[str, list[tuple[str, str]]]:
    images: dict[str, list[tuple[str, str]]] = {}
    for name in folder.files:
        match = _IMAGE_NAME.fullmatch(name)
        if match:
            images.setdefault(match["place"], []).append((name, match["lights"]))
    return images


def _read_mask(path: str, shape: tuple[int, int]) -> Mask:
    try:
        picture = decode_png(Path(path).read_bytes())
    except Exception as error:
        raise FormatError(f"{path} cannot be read: {error}; make it again with 2_preprocess_data.py") from error
    if picture.shape != shape:
        raise FormatError(f"{path} is {picture.shape}, expected {shape} like its image; make it again")
    return np.asarray(picture == 0)
