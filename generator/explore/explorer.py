"""`generate explore`: server of a page that shows a LUT, and computed sample pictures.

Images are rendered by `generator.dataset.shards.photograph`, as the first image of a data set of one picture and one
illuminant with seed 0. The command on the page therefore makes the same bytes as the page shows. The server
(`foundation.local_server`) keeps uploaded pictures in memory only.
"""

from __future__ import annotations

import json
import os
import shlex
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, ClassVar, Final, get_args

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import srgb_codes
from foundation.errors import CropError, FormatError, InputError
from foundation.files import sha256_of, write_atomic
from foundation.folders import cache_folder
from foundation.local_server import LocalServer, Refusal, Request, Response
from foundation.pages import render
from foundation.remote import is_remote
from foundation.secret_texts import masked
from generator.dataset.plan import DatasetOptions
from generator.dataset.shards import chromaticity, light_of, photograph
from generator.kernels.unfit import replace_unfit_colours
from generator.lights.choices import parse_light
from generator.lights.gamut import Gamut, black_body, rb_of
from generator.lights.lighting import Lighting, Mixture
from generator.pictures.random_scenes import RandomScene
from generator.pictures.sources import SUFFIXES, Picture, PictureFile, Preparation, open_picture
from generator.rendering import DEFAULT, Rendering
from generator.rendering.colorimetric import reference_light
from generator.rendering.matrices import ColourMatrix, matrix_for

if TYPE_CHECKING:
    from calibration.table.lut import Lut


MAX_SIDE: Final = 1000  # Longest side of a picture on the page, px; it fits a window and renders in milliseconds

MOST_UPLOADS: Final = 8  # Largest number of uploaded pictures that are kept, and of decoded pictures in the cache

# Largest number of pixels of an uploaded picture. Decoding of such a picture needs 200 MB.
MOST_UPLOADED_PIXELS: Final = 1 << 26

# Side of the uniform area in which noise is measured, px. With its 256 pixels, the standard deviation has a standard
# error of 5 %.
_NOISE_SIDE: Final = 16

_CURVE_POINTS: Final = 33  # Points of the black-body curve

_OUTPUT: Final = "dataset"  # Output folder in the command on the page


@dataclass(frozen=True, eq=False)
class _Scene:
    """A picture on the page."""

    name: str
    profile: str  # treatment of its colour profile
    picture: Picture  # (H, W, 3) uint8


class Explorer:
    """A LUT and pictures to render with it; it can be used from several threads.

    `lut_argument` is the LUT as the user wrote it, for the command; `max_side` is the longest side of a picture, px.
    """

    def __init__(self, lut_argument: str, lut: Lut, sources: Sequence[PictureFile], max_side: int = MAX_SIDE) -> None:
        self.lut = lut
        self._lut_argument = lut_argument
        self._sources = sources
        self._preparation = Preparation(max_side=max_side)
        self._gamut = Gamut.of(lut)
        self._uploads: OrderedDict[int, _Scene] = OrderedDict()
        self._uploads_lock = threading.Lock()
        self._next_number = len(sources)
        self._read = lru_cache(maxsize=MOST_UPLOADS)(self._read_source)

    def describe(self) -> dict[str, Any]:
        """Return illuminants, gamut and black bodies of the LUT, and the number of pictures, as plain values."""
        from scipy.spatial import ConvexHull

        lut, gamut = self.lut, self._gamut
        lights = [light_of(lut, number) for number in range(len(lut.white))]
        # Illuminants on a line have no triangles; the ends of their edges give the hull. A single illuminant has no
        # edge.
        on_hull = ConvexHull(gamut.rb).vertices.tolist() if len(gamut.triangles) else {0, *gamut.edges.ravel().tolist()}
        return {
            "name": self._lut_argument,
            "camera": lut.provenance.camera,
            "computed": lut.provenance.computed is not None,
            "colours": 8**lut.provenance.bits,
            "samples": int(lut.samples.shape[2]),
            "white_level": lut.provenance.white_level,
            "lights": [
                {"label": light.label, "codes": light.codes, "rb": rb}
                for light, rb in zip(lights, gamut.rb.tolist(), strict=True)
            ],
            "hull": gamut.rb[[*on_hull]].tolist(),
            "black_bodies": self._black_bodies(),
            "first": reference_light(lut),
            "pictures": len(self._sources),
        }

    def add(self, name: str, data: bytes) -> int:
        """Store an uploaded picture and return its number; raises FormatError if it cannot be read.

        If more than `MOST_UPLOADS` are stored, the oldest is removed.
        """
        plain = "".join(character for character in PurePosixPath(name).name if character.isprintable()) or "picture"
        suffix = PurePosixPath(plain).suffix.lower()
        with tempfile.NamedTemporaryFile(prefix="crop-", suffix=suffix if suffix in SUFFIXES else "") as file:
            file.write(data)
            file.flush()
            try:
                read = open_picture(Path(file.name), self._preparation, plain, data, MOST_UPLOADED_PIXELS)
            except FormatError as error:
                raise FormatError(str(error).replace(file.name, plain)) from error
        with self._uploads_lock:
            number, self._next_number = self._next_number, self._next_number + 1
            self._uploads[number] = _Scene(plain, read.profile, read.picture)
            while len(self._uploads) > MOST_UPLOADS:
                self._uploads.popitem(last=False)
        return number

    def show(self, number: int, light: str) -> dict[str, Any]:
        """Return ground truth, mixture and commands of a picture under an illuminant (text as for ``--light``).

        A chromaticity outside the gamut is replaced by the nearest one in the gamut.
        """
        scene, mixture = self._scene(number), self._mixture(light)
        white = mixture.white(self.lut)
        height, width = scene.picture.shape[:2]
        return {
            "number": number,
            "light": mixture.label,
            "parts": [list(pair) for pair in zip(mixture.lights, mixture.weights, strict=True)],
            "rb": rb_of(white).tolist(),
            "truth": chromaticity(white),
            "picture": {"name": scene.name, "width": width, "height": height, "profile": scene.profile},
            "is_here": number < len(self._sources),
            "commands": {
                "codes": self.command(number, mixture, "codes"),
                "colorimetric": self.command(number, mixture, "colorimetric"),
            },
        }

    def counts(self, number: int, light: str, rendering: Rendering) -> npt.NDArray[np.uint16]:
        """Return the raw image (H, W, 3) uint16, linear camera RGB, of a picture under an illuminant."""
        return self._photograph(self._scene(number).picture, self._mixture(light), rendering, 0)

    def pixel(self, number: int, light: str, rendering: Rendering, x: int, y: int) -> dict[str, Any]:
        """Return the codes of one pixel, and mean and standard deviation of its counts over many samples."""
        picture = self._scene(number).picture
        if not (0 <= y < picture.shape[0] and 0 <= x < picture.shape[1]):
            height, width = picture.shape[:2]
            raise InputError(f"the pixel {x}, {y} is outside the picture of {width}x{height} px; select another one")
        field = np.broadcast_to(picture[y, x], (_NOISE_SIDE, _NOISE_SIDE, 3)).copy()
        drawn = self._photograph(field, self._mixture(light), rendering, 1).reshape(-1, 3).astype(np.float64)
        mean, deviation = drawn.mean(axis=0), drawn.std(axis=0, ddof=1)
        return {
            "codes": picture[y, x].tolist(),
            "mean": mean.tolist(),
            "deviation": deviation.tolist(),
            "draws": len(drawn),
        }

    def command(self, number: int, mixture: Mixture, rendering: Rendering) -> str:
        """Return the command that generates the image; paths are relative to the working folder of the server."""
        # For an uploaded picture only the file name is known, because browsers do not send its folder.
        if number < len(self._sources):
            location = self._sources[number].location
            location = masked(location) if is_remote(location) else _relative_path(location)
        else:
            location = self._scene(number).name
        arguments = ["generate", _as_argument(self._lut_argument), _OUTPUT, "--sources", _as_argument(location)]
        arguments += ["--max-side", str(self._preparation.max_side), "--light", mixture.label]
        if rendering != DEFAULT:
            arguments += ["--rendering", rendering]
        return shlex.join(arguments)

    @cached_property
    def _matrix(self) -> ColourMatrix:
        return matrix_for(self.lut)

    def _black_bodies(self) -> list[list[float]]:
        # Temperature (K), r and b of points on the black-body curve, between the lowest and the highest temperature of
        # the black bodies of the LUT; empty if it has fewer than two.
        bodies = {light.cct_k for light in self.lut.illuminations if light.cct_k is not None}
        if len(bodies) < 2:
            return []
        mired = np.linspace(1e6 / min(bodies), 1e6 / max(bodies), _CURVE_POINTS)
        kelvins = np.clip(1e6 / mired, min(bodies), max(bodies)).tolist()
        return [[kelvin, *rb_of(black_body(self.lut, kelvin).white(self.lut)).tolist()] for kelvin in kelvins]

    def _scene(self, number: int) -> _Scene:
        if 0 <= number < len(self._sources):
            return self._read(number)
        with self._uploads_lock:
            scene = self._uploads.get(number)
        if scene is None:
            raise InputError(f"there is no picture {number}, the last {MOST_UPLOADS} uploads are kept; upload it again")
        return scene

    def _read_source(self, number: int) -> _Scene:
        source = self._sources[number]
        read = source.read()
        return _Scene(source.name, read.profile, read.picture)

    def _mixture(self, light: str) -> Mixture:
        return parse_light(light, self.lut, self._gamut, "nearest")

    def _photograph(
        self, picture: Picture, mixture: Mixture, rendering: Rendering, image: int
    ) -> npt.NDArray[np.uint16]:
        # The image is in memory that the next call in this thread overwrites.
        lut = self.lut
        if rendering == "codes":
            picture = replace_unfit_colours(picture, lut.provenance)[0]
        matrix = self._matrix if rendering == "colorimetric" else None
        options = DatasetOptions(rendering=rendering, matrix=matrix)
        return photograph(lut, picture, Lighting((mixture,)), options, 0, image, lut.provenance.white_level).counts


def _as_argument(name: str) -> str:
    # Without ./, such a path would be parsed as an option or as the command `explore`.
    return f"./{name}" if name.startswith("-") or name == "explore" else name


def _relative_path(location: str) -> str:
    path = Path(location)
    return os.fspath(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else location


MOST_BYTES: Final = 64 << 20  # Largest upload in bytes: enough for a 16-bit photograph, too small for a video


class ExploreServer(LocalServer):
    """Serves a LUT and its pictures.

    - ``table.json``: illuminants and gamut (`Explorer.describe`).
    - ``shown.json?picture=N&light=TEXT``: ground truth and commands (`Explorer.show`).
    - ``counts?picture=N&light=TEXT&rendering=NAME``: the raw image; height and width as two uint32, then the counts as
      uint16 in the order R, G, B, row by row, all little-endian.
    - ``pixel.json?…&x=X&y=Y``: noise of a pixel (`Explorer.pixel`).
    - ``picture?name=NAME`` by PUT: upload of a picture; the answer is its number.
    """

    command = "generate explore"
    max_bytes: ClassVar[int] = MOST_BYTES

    def __init__(self, explorer: Explorer, host: str, port: int) -> None:
        self._explorer = explorer
        title = f"Explore {explorer.lut.provenance.camera}"
        scripts = ("plane.js", "picture.js", "explore.js")
        self._page = render(
            "generator.explore", "explore.html", scripts=scripts, styles=("explore.css",), uses_server=True, title=title
        )
        super().__init__(host, port)

    def answer(self, request: Request) -> Response | Refusal:
        """Return the answer; if the request is invalid, status 422 with the error message."""
        try:
            return self._answer(request)
        except CropError as error:
            return Refusal(422, str(error))

    def _answer(self, request: Request) -> Response | Refusal:
        query, explorer = request.query, self._explorer
        if request.body is not None:
            if request.path != "picture":
                return Refusal(404, f"/{request.path} accepts no upload; send pictures to /picture")
            return _json({"picture": explorer.add(query.get("name", "picture"), request.body)})
        match request.path:
            case "":
                policy = f"{self._page.policy}; frame-ancestors 'none'"
                return Response(
                    "text/html; charset=utf-8", self._page.text.encode(), {"Content-Security-Policy": policy}
                )
            case "table.json":
                return _json(explorer.describe())
            case "shown.json":
                return _json(explorer.show(_number(query, "picture"), query.get("light", "")))
            case "counts":
                image = explorer.counts(_number(query, "picture"), query.get("light", ""), _rendering(query))
                size = np.array(image.shape[:2], "<u4").tobytes()
                return Response("application/octet-stream", size + image.astype("<u2", copy=False).tobytes())
            case "pixel.json":
                x, y = _number(query, "x"), _number(query, "y")
                return _json(explorer.pixel(_number(query, "picture"), query.get("light", ""), _rendering(query), x, y))
            case _:
                return Refusal(404, "this path does not exist; use /, /table.json, /shown.json, /counts or /pixel.json")


def _json(value: Any) -> Response:
    return Response("application/json", json.dumps(value, allow_nan=False).encode())


def _number(query: Mapping[str, str], name: str) -> int:
    text = query.get(name, "")
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise InputError(f"{name} is {text[:40]!r}, expected an integer ≥ 0; correct it")
    return int(text)


def _rendering(query: Mapping[str, str]) -> Rendering:
    text = query.get("rendering", "codes")
    for name in get_args(Rendering):
        if text == name:
            return name
    raise InputError(f"the rendering is {text[:40]!r}, expected one of {', '.join(get_args(Rendering))}; correct it")


# Sample pictures: shaded balls, patches with greys, and random colours. They are computed, so that the package needs no
# photographs, and stored in the cache, so that a command can use them.

_WIDTH: Final = 900  # Width of the sample pictures, px; the page shows this size without reduction

_HEIGHT: Final = 600  # Height of the sample pictures, px

# Balls from back to front: centre x, y and radius in px, and linear sRGB of the surface.
_BALLS: Final = (
    ((160, 395, 130), (0.78, 0.05, 0.04)),
    ((395, 330, 175), (0.85, 0.55, 0.06)),
    ((655, 400, 135), (0.06, 0.33, 0.62)),
    ((800, 280, 75), (0.70, 0.70, 0.70)),
    ((285, 520, 60), (0.10, 0.45, 0.12)),
    ((520, 530, 65), (0.45, 0.10, 0.50)),
    ((765, 535, 45), (0.90, 0.90, 0.88)),
)

_TO_LAMP: Final = np.array([-0.5, -0.65, 0.57])  # Direction to the lamp: right, down, towards the viewer

_PATCHES: Final = 6  # Patches in each row; the last row has greys


def sample_folder(cache: Path | None = None) -> Path:
    """Return the folder of the sample pictures in `cache` (default: `cache_folder`); create it if needed."""
    import cv2

    cache = cache or cache_folder()
    if cache is None:
        raise InputError(
            "the sample pictures need a cache folder, but there is no home folder; set XDG_CACHE_HOME, or give "
            "pictures with --sources"
        )
    pictures = {"balls": _balls(), "patches": _patches(), "random": _random()}
    key = sha256_of(b"".join(picture.tobytes() for picture in pictures.values()))[:12]
    folder = cache / f"pictures-{key}"
    for name, picture in pictures.items():
        path = folder / f"{name}.png"
        if not path.is_file():
            write_atomic(path, cv2.imencode(".png", picture[..., ::-1])[1].tobytes())
    return folder


def _balls() -> Picture:
    y, x = np.mgrid[:_HEIGHT, :_WIDTH].astype(np.float64)
    lamp = _TO_LAMP / np.linalg.norm(_TO_LAMP)
    floor = y > 0.55 * _HEIGHT
    falloff = 1.0 - 0.45 * np.hypot((x - 250) / _WIDTH, (y - 150) / _HEIGHT)
    linear = (np.where(floor, 0.30, 0.42) * falloff)[..., None] * np.ones(3)
    for (left, top, radius), _ in _BALLS:
        distance = np.hypot((x - left - 0.55 * radius) / (1.25 * radius), (y - top - 0.85 * radius) / (0.35 * radius))
        linear *= (1 - 0.6 * np.clip(1.3 - distance, 0, 1) * floor)[..., None]
    for (left, top, radius), surface in _BALLS:
        across, down = (x - left) / radius, (y - top) / radius
        towards = np.sqrt(np.maximum(1 - across**2 - down**2, 0.0))
        facing = np.maximum(across * lamp[0] + down * lamp[1] + towards * lamp[2], 0.0)
        mirrored = np.maximum(2 * facing * towards - lamp[2], 0.0)
        shaded = np.array(surface) * (0.12 + 0.95 * facing)[..., None] + 0.5 * mirrored[..., None] ** 40
        cover = np.clip(radius - np.hypot(x - left, y - top) + 0.5, 0, 1)[..., None]
        linear += cover * (shaded - linear)
    return srgb_codes(np.clip(linear, 0, 1))


def _patches() -> Picture:
    hues = np.arange(_PATCHES) / _PATCHES
    wheel = 0.5 + 0.5 * np.cos(2 * np.pi * (hues[:, None] - np.array([0.0, 1 / 3, 2 / 3])))
    rows = [0.25 + contrast * (wheel - 0.5) for contrast in (0.4, 0.25, 0.1)]
    greys = np.repeat(np.linspace(0, 1, _PATCHES)[:, None] ** 2.2, 3, axis=1)
    patches = srgb_codes(np.clip(np.stack([*rows, greys]), 0, 1))
    side = _WIDTH // _PATCHES
    return _enlarged(patches, side)


def _random() -> Picture:
    return _enlarged(RandomScene(0, _WIDTH // 10, _HEIGHT // 10).read().picture, 10)


def _enlarged(small: npt.NDArray[np.uint8], times: int) -> Picture:
    return np.ascontiguousarray(small.repeat(times, axis=0).repeat(times, axis=1))
