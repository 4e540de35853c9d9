"""`generate explore`: the server of a page on a table, what the page may ask, and pictures for those who name none.

Images are made as `generate` makes them (`generator.dataset.shards.photograph`): the first image of a dataset of this
picture alone, under this light alone, with seed 0. So the command that is shown makes the bytes that are shown. The
server (see `foundation.local_server`) writes no file that stays.

Pictures to begin with are shaded balls, patches with greys, and random colours. They are computed, so that nobody's
photographs have to go with the package, and kept as files, so that a command can name them.
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
from generator.stores import is_remote

if TYPE_CHECKING:
    from calibration.table.lut import Lut


MAX_SIDE: Final = 1000  # Longest side of a picture on the page, px: what a window shows, and made in milliseconds

MOST_DROPPED: Final = 8  # Pictures sent by pages that are kept, the newest; and decoded pictures that are at hand

# Pixels of a picture that a page sends: those of the largest cameras, 200 MB while it is decoded.
MOST_DROPPED_PIXELS: Final = 1 << 26

# Side of the field of equal pixels whose spread is a pixel's noise: 256 draws tell a deviation to a twentieth.
_DRAWS: Final = 16

_STEPS: Final = 33  # Points of the curve of the black bodies

_PLACE: Final = "dataset"  # Where the command that is shown makes its dataset


@dataclass(frozen=True, eq=False)
class _Scene:
    """A picture: its name, how its profile was treated, and its codes (H, W, 3) uint8."""

    name: str
    profile: str
    picture: Picture


class Explorer:
    """A table, and pictures to hold under its lights; may be asked from several threads.

    `given`: the table as the user named it, for the command. `max_side`: longest side of a picture, px.
    """

    def __init__(self, given: str, lut: Lut, sources: Sequence[PictureFile], max_side: int = MAX_SIDE) -> None:
        self.lut = lut
        self._given = given
        self._sources = sources
        self._preparation = Preparation(max_side=max_side)
        self._gamut = Gamut.of(lut)
        self._dropped: OrderedDict[int, _Scene] = OrderedDict()
        self._adding = threading.Lock()
        self._added = len(sources)
        self._read = lru_cache(maxsize=MOST_DROPPED)(self._read_source)

    def describe(self) -> dict[str, Any]:
        """Return the table as plain values: lights with their chromaticities, gamut, black bodies; and the pictures."""
        from scipy.spatial import ConvexHull

        lut, gamut = self.lut, self._gamut
        lights = [light_of(lut, number) for number in range(len(lut.white))]
        # Lights on a line have two ends, and neighbours between them; one light has no neighbour.
        around = ConvexHull(gamut.rb).vertices.tolist() if len(gamut.triangles) else {0, *gamut.edges.ravel().tolist()}
        return {
            "name": self._given,
            "camera": lut.provenance.camera,
            "computed": lut.provenance.computed is not None,
            "colours": 8**lut.provenance.bits,
            "samples": int(lut.samples.shape[2]),
            "white_level": lut.provenance.white_level,
            "lights": [
                {"label": light.label, "codes": light.codes, "rb": rb}
                for light, rb in zip(lights, gamut.rb.tolist(), strict=True)
            ],
            "hull": gamut.rb[[*around]].tolist(),
            "black_bodies": self._black_bodies(),
            "first": reference_light(lut),
            "pictures": len(self._sources),
        }

    def add(self, name: str, data: bytes) -> int:
        """Keep a picture that a page sent and return its number; a FormatError says why it cannot be read.

        `name`: of its file. The oldest of more than `MOST_DROPPED` is forgotten.
        """
        plain = "".join(character for character in PurePosixPath(name).name if character.isprintable()) or "picture"
        suffix = PurePosixPath(plain).suffix.lower()
        with tempfile.NamedTemporaryFile(prefix="crop-", suffix=suffix if suffix in SUFFIXES else "") as file:
            file.write(data)
            file.flush()
            try:
                read = open_picture(Path(file.name), self._preparation, plain, data, MOST_DROPPED_PIXELS)
            except FormatError as error:
                raise FormatError(str(error).replace(file.name, plain)) from error
        with self._adding:
            number, self._added = self._added, self._added + 1
            self._dropped[number] = _Scene(plain, read.profile, read.picture)
            while len(self._dropped) > MOST_DROPPED:
                self._dropped.popitem(last=False)
        return number

    def show(self, number: int, light: str) -> dict[str, Any]:
        """Return what is known of a picture under a light, as `generate --light` takes it, without its pixels.

        A chromaticity that the table cannot make becomes the nearest that it can.
        """
        scene, mixture = self._scene(number), self._mixture(light)
        white = mixture.white(self.lut)
        height, width = scene.picture.shape[:2]
        return {
            "number": number,
            "light": mixture.label,
            "parts": [list(part) for part in zip(mixture.lights, mixture.weights, strict=True)],
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
        """Return the raw image (H, W, 3) uint16, linear camera RGB, of a picture under a light."""
        return self._photograph(self._scene(number).picture, self._mixture(light), rendering, 0)

    def pixel(self, number: int, light: str, rendering: Rendering, x: int, y: int) -> dict[str, Any]:
        """Return the codes of one pixel of a picture, and mean and standard deviation of what is drawn for them."""
        picture = self._scene(number).picture
        if not (0 <= y < picture.shape[0] and 0 <= x < picture.shape[1]):
            raise InputError(f"there is no pixel {x}, {y} in a picture of {picture.shape[1]}x{picture.shape[0]} px")
        field = np.broadcast_to(picture[y, x], (_DRAWS, _DRAWS, 3)).copy()
        drawn = self._photograph(field, self._mixture(light), rendering, 1).reshape(-1, 3).astype(np.float64)
        mean, deviation = drawn.mean(axis=0), drawn.std(axis=0, ddof=1)
        return {
            "codes": picture[y, x].tolist(),
            "mean": mean.tolist(),
            "deviation": deviation.tolist(),
            "draws": len(drawn),
        }

    def command(self, number: int, mixture: Mixture, rendering: Rendering) -> str:
        """Return the command that makes a dataset of the image, to be run where this program was started.

        For a picture that a page sent it names the file alone: a browser does not tell where it lies.
        """
        if number < len(self._sources):
            location = self._sources[number].location
            place = masked(location) if is_remote(location) else _seen_from_here(location)
        else:
            place = self._scene(number).name
        words = ["generate", _as_place(self._given), _PLACE, "--sources", _as_place(place)]
        words += ["--max-side", str(self._preparation.max_side), "--light", mixture.label]
        if rendering != DEFAULT:
            words += ["--rendering", rendering]
        return shlex.join(words)

    @cached_property
    def _matrix(self) -> ColourMatrix:
        return matrix_for(self.lut)

    def _black_bodies(self) -> list[list[float]]:
        """Return the curve of the black bodies between those of the table: kelvin, r and b; none of fewer than two."""
        bodies = {light.cct_k for light in self.lut.illuminations if light.cct_k is not None}
        if len(bodies) < 2:
            return []
        mired = np.linspace(1e6 / min(bodies), 1e6 / max(bodies), _STEPS)
        kelvins = np.clip(1e6 / mired, min(bodies), max(bodies)).tolist()
        return [[kelvin, *rb_of(black_body(self.lut, kelvin).white(self.lut)).tolist()] for kelvin in kelvins]

    def _scene(self, number: int) -> _Scene:
        if 0 <= number < len(self._sources):
            return self._read(number)
        with self._adding:
            scene = self._dropped.get(number)
        if scene is None:
            raise InputError(f"there is no picture {number}; the last {MOST_DROPPED} that pages sent are kept: send it")
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
        """Return the image (H, W, 3) uint16, in memory that the calling thread's next call overwrites."""
        lut = self.lut
        if rendering == "codes":
            picture = replace_unfit_colours(picture, lut.provenance)[0]
        matrix = self._matrix if rendering == "colorimetric" else None
        options = DatasetOptions(rendering=rendering, matrix=matrix)
        return photograph(lut, picture, Lighting((mixture,)), options, 0, image, lut.provenance.white_level).counts


def _as_place(name: str) -> str:
    """Return a path that is taken for no option, nor for the command that shows the page."""
    return f"./{name}" if name.startswith("-") or name == "explore" else name


def _seen_from_here(location: str) -> str:
    path = Path(location)
    return os.fspath(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else location


MOST_BYTES: Final = 64 << 20  # Bytes of a file that a page sends: photographs of 16 bits, and not a film


class ExploreServer(LocalServer):
    """Serves a table and its pictures.

    - ``table.json``: the table, lights, gamut.
    - ``shown.json?picture=N&light=TEXT``: a picture under a light without its pixels, and the commands.
    - ``counts?picture=N&light=TEXT&rendering=NAME``: its image; height and width as two uint32, then the counts as
      uint16, R, G, B, row by row, all little-endian.
    - ``pixel.json?…&x=X&y=Y``: the noise of a pixel.
    - ``picture?name=NAME`` by PUT: a picture's file; answered with its number.
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
        """Return the answer; of what cannot be used, the sentence that a command would end with."""
        try:
            return self._answer(request)
        except CropError as error:
            return Refusal(422, str(error))

    def _answer(self, request: Request) -> Response | Refusal:
        asked, explorer = request.query, self._explorer
        if request.body is not None:
            if request.path != "picture":
                return Refusal(404, "pictures are taken at /picture")
            return _json({"picture": explorer.add(asked.get("name", "picture"), request.body)})
        match request.path:
            case "":
                policy = f"{self._page.policy}; frame-ancestors 'none'"
                return Response(
                    "text/html; charset=utf-8", self._page.text.encode(), {"Content-Security-Policy": policy}
                )
            case "table.json":
                return _json(explorer.describe())
            case "shown.json":
                return _json(explorer.show(_number(asked, "picture"), asked.get("light", "")))
            case "counts":
                image = explorer.counts(_number(asked, "picture"), asked.get("light", ""), _rendering(asked))
                size = np.array(image.shape[:2], "<u4").tobytes()
                return Response("application/octet-stream", size + image.astype("<u2", copy=False).tobytes())
            case "pixel.json":
                x, y = _number(asked, "x"), _number(asked, "y")
                return _json(explorer.pixel(_number(asked, "picture"), asked.get("light", ""), _rendering(asked), x, y))
            case _:
                return Refusal(404, "here are /, /table.json, /shown.json, /counts and /pixel.json")


def _json(value: Any) -> Response:
    return Response("application/json", json.dumps(value, allow_nan=False).encode())


def _number(asked: Mapping[str, str], name: str) -> int:
    text = asked.get(name, "")
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise InputError(f"{name}={text[:40]!r} is no number from 0")
    return int(text)


def _rendering(asked: Mapping[str, str]) -> Rendering:
    text = asked.get("rendering", "codes")
    for known in get_args(Rendering):
        if text == known:
            return known
    raise InputError(f"{text[:40]!r} is no rendering; expected one of {', '.join(get_args(Rendering))}")


_WIDTH: Final = 900  # Width of the pictures, px: as much as a page shows without making them smaller

_HEIGHT: Final = 600  # Height, px

# Balls: centre and radius, px, and linear sRGB of the surface, back to front.
_BALLS: Final = (
    ((160, 395, 130), (0.78, 0.05, 0.04)),
    ((395, 330, 175), (0.85, 0.55, 0.06)),
    ((655, 400, 135), (0.06, 0.33, 0.62)),
    ((800, 280, 75), (0.70, 0.70, 0.70)),
    ((285, 520, 60), (0.10, 0.45, 0.12)),
    ((520, 530, 65), (0.45, 0.10, 0.50)),
    ((765, 535, 45), (0.90, 0.90, 0.88)),
)

_FROM: Final = np.array([-0.5, -0.65, 0.57])  # Direction to the lamp: right, down, towards the viewer

_PATCHES: Final = 6  # Patches in a row: hues, and below them greys


def sample_folder(cache: Path | None = None) -> Path:
    """Return the folder of the sample pictures, made if it is not there.

    `cache`: where it is kept; None for `foundation.folders.cache_folder`.
    """
    import cv2

    cache = cache or cache_folder()
    if cache is None:
        raise InputError(
            "the sample pictures need a place to be kept, and there is no home folder; set XDG_CACHE_HOME, or name "
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
    lamp = _FROM / np.linalg.norm(_FROM)
    floor = y > 0.55 * _HEIGHT
    fall = 1.0 - 0.45 * np.hypot((x - 250) / _WIDTH, (y - 150) / _HEIGHT)
    linear = (np.where(floor, 0.30, 0.42) * fall)[..., None] * np.ones(3)
    for (left, top, radius), _ in _BALLS:
        away = np.hypot((x - left - 0.55 * radius) / (1.25 * radius), (y - top - 0.85 * radius) / (0.35 * radius))
        linear *= (1 - 0.6 * np.clip(1.3 - away, 0, 1) * floor)[..., None]
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
    rows = [0.25 + part * (wheel - 0.5) for part in (0.4, 0.25, 0.1)]
    greys = np.repeat(np.linspace(0, 1, _PATCHES)[:, None] ** 2.2, 3, axis=1)
    patches = srgb_codes(np.clip(np.stack([*rows, greys]), 0, 1))
    side = _WIDTH // _PATCHES
    return _enlarged(patches, side)


def _random() -> Picture:
    return _enlarged(RandomScene(0, _WIDTH // 10, _HEIGHT // 10).read().picture, 10)


def _enlarged(small: npt.NDArray[np.uint8], times: int) -> Picture:
    return np.ascontiguousarray(small.repeat(times, axis=0).repeat(times, axis=1))
