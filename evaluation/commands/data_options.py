"""The options of every command that reads a data set: which layout, which part of it, which levels.

A command has one parameter `reading: DataReading`, and `@with_data_options` puts the options in its place::

    @with_data_options
    def run(dataset: Annotated[str, typer.Argument()], *, reading: DataReading) -> None:
        data = reading.open(dataset)
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

if TYPE_CHECKING:
    from evaluation.datasets.options import DataOptions
    from evaluation.scene import SceneSet

_PANEL = "Reading the data"


@dataclass(frozen=True)
class DataReading:
    """How the data sets that a command is given are read; see `evaluation.datasets.options.DataOptions`.

    - `layout`: A name of `evaluation.datasets.LAYOUTS`; None takes the one that a place looks like.
    - `camera`, `subset`, `truth`: of a data set that has several.
    - `black`, `saturation`: levels that replace those of the layout, in the units of the files.
    - `partial`: whether missing images are left out and counted.
    """

    layout: str | None = None
    camera: str | None = None
    subset: str | None = None
    truth: str | None = None
    black: float | None = None
    saturation: float | None = None
    partial: bool = False

    def open(self, place: str) -> SceneSet:
        """Return the data set at a place; see `evaluation.datasets.opening.open_scenes`."""
        from evaluation.datasets import open_scenes

        return open_scenes(place, self.layout, self.options)

    @property
    def options(self) -> DataOptions:
        """The options without the layout."""
        from evaluation.datasets.options import DataOptions

        return DataOptions(self.camera, self.subset, self.truth, self.black, self.saturation, self.partial)


def _option(metavar: str | None, text: str, *names: str) -> Any:
    return typer.Option(*names, metavar=metavar, help=text, show_default=False, rich_help_panel=_PANEL)


_OPTIONS: dict[str, Any] = {
    "layout": Annotated[
        str | None,
        _option(
            "NAME",
            "Layout of the data set: generated, thumbnails, cube-plus, cube++, simple-cube++, nus8, gehler-shi, "
            "intel-tau, lsmi, ffcc or folder. \\[default: what it looks like]",
            "--layout",
        ),
    ],
    "camera": Annotated[
        str | None,
        _option("NAME", "One camera of nus8, gehler-shi (1D, 5D), intel-tau or lsmi. \\[default: all]", "--camera"),
    ],
    "subset": Annotated[
        str | None,
        _option(
            "NAME",
            "Part of the data set: train or test of simple-cube++; lab_printouts … of intel-tau; train, val, test, "
            "single, mixed or test-mixed … of lsmi. \\[default: all]",
            "--subset",
        ),
    ],
    "truth": Annotated[
        str | None,
        _option(
            "NAME",
            "Ground truth where there are several: mean, left, right, left-white or right-white of cube++; own, left "
            "or right of cube-plus; recommended or shi of gehler-shi. \\[default: the first of these]",
            "--truth",
        ),
    ],
    "black": Annotated[
        float | None,
        _option("LEVEL", "Black level, in the units of the files. \\[default: the layout's]", "--black"),
    ],
    "saturation": Annotated[
        float | None,
        _option(
            "LEVEL",
            "Value from which a pixel is clipped, in the units of the files. \\[default: the layout's]",
            "--saturation",
        ),
    ],
    "partial": Annotated[
        bool, _option(None, "Take what is there of a copy that lacks images, and say how many it lacks.", "--partial")
    ],
}


def with_data_options(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command whose parameter `reading` is replaced by the options of `DataReading`, for typer."""
    signature = inspect.signature(command)
    if "reading" not in signature.parameters:
        raise ValueError(f"{command.__name__} has no parameter 'reading' to put the options in the place of")
    fields = DataReading.__dataclass_fields__
    options = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=fields[name].default, annotation=kind)
        for name, kind in _OPTIONS.items()
    ]
    hints = get_type_hints(command, localns={"SceneSet": Any}, include_extras=True)
    others = [
        parameter.replace(annotation=hints.get(name, Any))
        for name, parameter in signature.parameters.items()
        if name != "reading"
    ]
    first = [parameter for parameter in others if parameter.kind is not inspect.Parameter.KEYWORD_ONLY]
    last = [parameter for parameter in others if parameter.kind is inspect.Parameter.KEYWORD_ONLY]

    @functools.wraps(command)
    def with_options(*arguments: Any, **given: Any) -> None:
        reading = DataReading(**{name: given.pop(name) for name in _OPTIONS if name in given})
        command(*arguments, **given, reading=reading)

    with_options.__signature__ = signature.replace(parameters=[*first, *last, *options])  # type: ignore[attr-defined]
    with_options.__annotations__ = {
        **{parameter.name: parameter.annotation for parameter in (*first, *last, *options)},
        "return": None,
    }
    return with_options
