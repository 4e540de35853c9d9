"""The options of commands that print a table of methods' errors: which angular error, which statistics."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

PrintedError = Annotated[
    Literal["reproduction", "recovery"],
    typer.Option(help="Angular error that is printed, and drawn in the report; files have both."),
]

PrintedStatistics = Annotated[
    Literal["paper", "all"],
    typer.Option(help="Print the paper's six statistics, or also 95th percentile, maximum and share below 3°."),
]
