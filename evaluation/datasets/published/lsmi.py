"""LSMI: 7486 images of 2700 scenes under one, two or three lights, with three cameras, and the share of each light.

It lies so::

    galaxy/meta.json         of each place: NumOfLights, MCCCoord (mcc1 … mcc3: four corners), Light1 … (r, 1, b)
    galaxy/split.json        places by part: two_illum_train, two_illum_val, two_illum_test, three_illum_…
    galaxy/Place1/Place1_12.tiff   the place under lights 1 and 2: 16 bits, half-size raw, black not subtracted
    galaxy/Place1/Place1_12.npy    (H, W, K): share of each light in the green of a pixel, -1 where it is not known

    galaxy_512/meta.json, split.json     what 2_preprocess_data.py makes of it: black subtracted, cut and resized
    galaxy_512/test/Place1_12.tiff, Place1_12.npy, Place1_mask.png (0 on the charts)

The .tiff files are made of the published raw files by the authors' 0_cvt2tiff.py (dcraw -h -D -4 -T), the .npy files
and the lights in meta.json by 1_make_mixture_map.py: run both first. D. Kim et al., "Large scale multi-illuminant
(LSMI) dataset for developing white balance algorithm under mixed illumination", ICCV 2021, and
github.com/DY112/LSMI-dataset, whose programs are the source of all that is applied here. Not verified against a real
copy.

The light of a pixel is the sum of the lights, green 1, weighted by their shares. The levels of Sony's files are those
of the authors' programs; they take the Galaxy's and Nikon's from a raw file of the camera, which is done here as well.
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
from evaluation.datasets.options import DataOptions, choose, stated
from evaluation.scene import Image, Scene, SceneSet
from foundation.errors import FormatError, InputError, first_few
from generator.files import decode_png

_SONY: Final = (128.0, 4095.0)  # Black level and saturation of Sony's .tiff files (1_make_mixture_map.py)
_HALF = 2  # The charts' corners are in px of the raw file, whose .tiff is half as large (1_make_mixture_map.py)
_PARTS = ("train", "val", "test")
_COUNTS: Final = {"single": (1,), "mixed": (2, 3)}
_IMAGE = re.compile(r"(?P<place>.+)_(?P<lights>[123]{1,3})\.tiff?")
_RAW = (".dng", ".nef", ".arw")


@dataclass(frozen=True, slots=True)
class LsmiScene(RawScene):
    """An image under one light.

    - `charts`: corners of each chart, x and y, px of the image; empty where `mask_path` is given.
    - `mask_path`: A picture that is 0 on the charts; "" for none.
    """

    charts: tuple[tuple[tuple[float, float], ...], ...] = ()
    mask_path: str = ""

    def mask(self, image: Image) -> Mask:
        """Return (H, W) bool, True on the charts, of an image (H, W, 3)."""
        height, width = image.shape[:2]
        if self.mask_path:
            return _read_mask(self.mask_path, (height, width))
        mask = np.zeros((height, width), dtype=bool)
        for chart in self.charts:
            mask |= chart_mask((height, width), np.array(chart), self.path)
        return mask


@dataclass(frozen=True, slots=True)
class LsmiMixedScene(LsmiScene):
    """An image under two or three lights; `light` is not used.

    - `several`: the lights (K of them), linear camera RGB with green 1.
    - `shares_path`: the file with the share of each light in each pixel.
    """

    several: tuple[Light, ...] = ()
    shares_path: str = ""
    _means: dict[str, npt.NDArray[np.float64]] = field(
        default_factory=dict[str, npt.NDArray[np.float64]], repr=False, compare=False
    )

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """The light (3,) float64, r + g + b = 1: the mean of the pixels' lights, where they are known; read once."""
        if "" not in self._means:
            weights = self.read_weights().reshape(-1, len(self.several))
            mean = weights[np.isfinite(weights[:, 0])].mean(axis=0, dtype=np.float64) @ self.lights
            self._means[""] = mean / mean.sum()
        return self._means[""]

    @property
    def lights(self) -> npt.NDArray[np.float64]:
        """The lights (K, 3) float64, linear camera RGB with green 1."""
        return np.array(self.several)

    def read_weights(self) -> npt.NDArray[np.float32]:
        """Return the share of each light in each pixel: (H, W, K) float32, 0 … 1, sum 1; NaN where it is not known."""
        try:
            shares = np.load(self.shares_path, allow_pickle=False)
        except Exception as error:  # NumPy evaluates the head of a file, whose damage shows as any error.
            raise FormatError(
                f"{self.shares_path} cannot be read: {error}; make it again with 1_make_mixture_map.py"
            ) from error
        if shares.ndim != 3 or shares.shape[2] != len(self.several) or shares.dtype.kind != "f":
            raise FormatError(
                f"{self.shares_path} holds {shares.dtype} {shares.shape}, expected float (height, width, "
                f"{len(self.several)}); make it again with 1_make_mixture_map.py"
            )
        weights = np.maximum(shares, 0).astype(np.float32)
        total = weights.sum(axis=2, keepdims=True)
        known = (total > 0) & np.isfinite(total)
        if not known.any():
            raise FormatError(f"{self.shares_path} knows the lights of no pixel; make it again")
        return np.asarray(np.where(known, weights / np.where(known, total, 1), np.float32(np.nan)), dtype=np.float32)

    def read_truth_map(self) -> npt.NDArray[np.float32]:
        """Return the light of each pixel: (H, W, 3) float32, r + g + b = 1; NaN where it is not known."""
        lights = self.read_weights() @ self.lights.astype(np.float32)
        return np.asarray(lights / lights.sum(axis=2, keepdims=True), dtype=np.float32)


def is_lsmi(folder: Folder) -> bool:
    """Return whether a folder looks like the data set or one camera of it: `meta.json` beside `split.json`."""
    return bool(_cameras(folder))


def open_lsmi(place: str, options: DataOptions, listed: Folder | None = None) -> SceneSet:
    """Return the images of all cameras or of one, of all parts or of one; they are read when they are used.

    `options.subset` is a part, "train", "val" or "test", or a number of lights, "single" or "mixed", or both:
    "test-mixed".
    """
    folder = listed or Folder(Path(place))
    cameras = _cameras(folder)
    if not cameras:
        raise FormatError(f"{place} is no copy of LSMI: it has no meta.json beside split.json; name a camera's folder")
    camera = choose(options.camera, cameras, "camera", place)
    part, count = _subset(options.subset, place)
    scenes: list[Scene] = []
    levels: list[tuple[str, str]] = []
    notes: list[str] = []
    for name, known in cameras.items():
        if camera in (None, name):
            reader = _Camera(name, known, _json(known, "meta.json"), options)
            found = list(reader.scenes(_places(known, part), part, _COUNTS.get(count or "", (1, 2, 3))))
            scenes.extend(found)
            mixed = sum(isinstance(scene, LsmiMixedScene) for scene in found)
            notes.append(f"{name} {len(found)}, {mixed} under several lights")
            levels.append(reader.stated())
    if not scenes:
        raise FormatError(f"{place} has no .tiff of {options.subset or 'any place'}; make them with 0_cvt2tiff.py")
    black, white = zip(*levels, strict=True)
    return SceneSet(
        name="LSMI" + "".join(f" {chosen}" for chosen in (camera, options.subset) if chosen),
        layout="lsmi",
        location=place,
        scenes=tuple(scenes),
        treatment={
            "images": ", ".join(notes),
            "black level": stated(options.black, ", ".join(black)),
            "saturation": stated(options.saturation, ", ".join(white)),
            "mask": "the three charts of each place, in every part (the authors' own test leaves them in)",
            "ground truth": "the lights of meta.json, green 1, weighted in each pixel by the shares in the .npy file; "
            "not known where those are -1 or all 0. Single-light methods are held to the mean over the known pixels",
        },
    )


def _cameras(folder: Folder) -> dict[str, Folder]:
    places = {folder.path.resolve().name: folder, **folder.folders}
    return {name: known for name, known in places.items() if known.has("meta.json") and known.has("split.json")}


def _subset(given: str | None, place: str) -> tuple[str | None, str | None]:
    if given is None:
        return None, None
    known = [*_PARTS, *_COUNTS, *(f"{part}-{count}" for part in _PARTS for count in _COUNTS)]
    words = (choose(given, known, "subset", place) or "").split("-")
    part = next((word for word in words if word in _PARTS), None)
    return part, next((word for word in words if word in _COUNTS), None)


def _json(folder: Folder, name: str) -> Mapping[str, Any]:
    path = folder.path / name
    try:
        content: Any = json.loads(read_text(path))
    except ValueError as error:
        raise FormatError(f"{path} is no JSON: {error}; restore it") from error
    if not isinstance(content, dict) or not content:
        raise FormatError(f"{path} holds no table of places; restore it")
    return cast("Mapping[str, Any]", content)


def _places(folder: Folder, part: str | None) -> dict[str, str]:
    """Return the part of each place of a camera, those of one part if it is given, in the order of `split.json`."""
    found: dict[str, str] = {}
    for key, places in _json(folder, "split.json").items():
        name = key.rpartition("_")[2]
        if name not in _PARTS or not isinstance(places, list):
            raise FormatError(f"{folder.path / 'split.json'} has the part {key!r}, expected …_train, …_val or …_test")
        if part in (None, name):
            found.update((str(place), name) for place in cast("list[Any]", places))
    return found


@dataclass(frozen=True)
class _Camera:
    """What the scenes of one camera are made of."""

    name: str
    folder: Folder
    meta: Mapping[str, Any]
    options: DataOptions

    @property
    def prepared(self) -> bool:
        """Whether 2_preprocess_data.py made this folder: its images lie by part, not by place."""
        return any(part in self.folder.folders for part in _PARTS)

    def stated(self) -> tuple[str, str]:
        """Return black level and saturation in words."""
        black, white, source = self.levels()
        if self.prepared:
            return f"0 of {self.name}: {source}", f"none of {self.name}: resized pixels do not show what was clipped"
        return f"{black:g} of {self.name}, subtracted ({source})", f"from {white:g} of {self.name} ({source})"

    def levels(self) -> tuple[float, float | None, str]:
        """Return black level, saturation, and their source."""
        given = self.options.black, self.options.saturation
        if self.prepared:
            return given[0] or 0.0, given[1], "subtracted by 2_preprocess_data.py"
        if None not in given:
            return float(given[0] or 0), given[1], "the user"
        if "sony" in self.name.lower():
            black, white, source = *_SONY, "1_make_mixture_map.py"
        else:
            black, white, source = self._levels_of_raw()
        return (black if given[0] is None else given[0]), (white if given[1] is None else given[1]), source

    def _levels_of_raw(self) -> tuple[float, float, str]:
        """Return the levels that a raw file of the camera states, as the authors' programs take them."""
        path = self._raw_file()
        if path is None:
            raise InputError(
                f"{self.folder.path} has no raw file of {self.name} to read black level and saturation from, expected "
                f"{self.name}.dng beside it (github.com/DY112/LSMI-dataset has it) or raw files by the .tiff files; "
                "put one there, or give --read black=LEVEL --read saturation=LEVEL"
            )
        import rawpy

        try:
            with rawpy.imread(str(path)) as raw:
                return float(min(raw.black_level_per_channel)), float(raw.white_level), path.name
        except rawpy.LibRawError as error:
            raise FormatError(
                f"{path} cannot be read as a raw file: {error}; give --read black=LEVEL --read saturation=LEVEL"
            ) from error

    def _raw_file(self) -> Path | None:
        for folder in (self.folder.path, self.folder.path.resolve().parent):
            if (folder / f"{self.name}.dng").is_file():
                return folder / f"{self.name}.dng"
        for place in self.folder.folders.values():
            for name in place.files:
                if name.lower().endswith(_RAW):
                    return place.path / name
        return None

    def scenes(self, places: Mapping[str, str], part: str | None, counts: Sequence[int]) -> Iterator[LsmiScene]:
        """Yield the images of places, in their order."""
        black, white, _ = self.levels()
        folders = self.folder.folders
        missing: list[str] = []
        by_part = {name: _by_place(folders[name]) for name in _PARTS if name in folders and part in (None, name)}
        for place, of in places.items():
            if self.prepared:
                folder, images = folders.get(of), by_part.get(of, {}).get(place, [])
            else:
                folder = folders.get(place)
                images = _by_place(folder).get(place, []) if folder else []
            if folder is None or not images:
                missing.append(place)
                continue
            for image, lights in images:
                if len(lights) in counts:
                    yield self._scene(folder, place, image, lights, black, white)
        if missing and not self.options.partial:
            raise FormatError(
                f"{self.folder.path} lacks the .tiff files of {len(missing)} of {len(places)} places "
                f"({first_few(missing)}); make them with 0_cvt2tiff.py, or take what is there with --read partial"
            )

    def _scene(
        self, folder: Folder, place: str, image: str, lights: str, black: float, white: float | None
    ) -> LsmiScene:
        where = f"{self.folder.path / 'meta.json'}, {place}"
        several = tuple(self._light(place, number, where) for number in lights)
        name, path = f"{self.name}/{image}", str(folder.path / image)
        charts, mask = self._charts(place, where) if not self.prepared else ((), str(folder.path / f"{place}_mask.png"))
        if len(several) == 1:
            return LsmiScene(name, path, several[0], black, white, charts, mask)
        shares = f"{path.rpartition('.')[0]}.npy"
        if not Path(shares).is_file():
            raise FormatError(f"{shares} is missing: the share of each light of {image}; run 1_make_mixture_map.py")
        return LsmiMixedScene(name, path, several[0], black, white, charts, mask, several, shares)

    def _light(self, place: str, number: str, where: str) -> Light:
        values = self._of(place).get(f"Light{number}")
        if not isinstance(values, list):
            raise FormatError(f"{where} has no Light{number}, expected red, green, blue; run 1_make_mixture_map.py")
        try:
            return check_light([float(value) for value in cast("list[Any]", values)], f"{where}, Light{number}")
        except (TypeError, ValueError) as error:
            raise FormatError(f"{where}: Light{number} is {values}, expected three numbers; restore it") from error

    def _charts(self, place: str, where: str) -> tuple[tuple[tuple[tuple[float, float], ...], ...], str]:
        try:
            corners = [
                np.asarray(self._of(place)["MCCCoord"][f"mcc{number}"], dtype=np.float64) for number in (1, 2, 3)
            ]
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(
                f"{where} has no MCCCoord with mcc1, mcc2, mcc3: the charts' corners; restore it"
            ) from error
        if any(chart.shape != (4, 2) or not np.isfinite(chart).all() for chart in corners):
            raise FormatError(f"{where}: MCCCoord holds other than four corners, x and y, of each chart; restore it")
        return tuple(tuple((float(x) / _HALF, float(y) / _HALF) for x, y in chart) for chart in corners), ""

    def _of(self, place: str) -> Mapping[str, Any]:
        known = self.meta.get(place)
        if not isinstance(known, dict):
            raise FormatError(f"{self.folder.path / 'meta.json'} does not know {place} of split.json; restore both")
        return cast("Mapping[str, Any]", known)


def _by_place(folder: Folder) -> dict[str, list[tuple[str, str]]]:
    found: dict[str, list[tuple[str, str]]] = {}
    for name in folder.files:
        match = _IMAGE.fullmatch(name)
        if match:
            found.setdefault(match["place"], []).append((name, match["lights"]))
    return found


def _read_mask(path: str, shape: tuple[int, int]) -> Mask:
    """Return (H, W) bool, True where a picture of one channel is 0."""
    try:
        picture = decode_png(Path(path).read_bytes())
    except Exception as error:
        raise FormatError(f"{path} cannot be read: {error}; make it again with 2_preprocess_data.py") from error
    if picture.shape != shape:
        raise FormatError(f"{path} is {picture.shape}, expected {shape} as its image; make it again")
    return np.asarray(picture == 0)
