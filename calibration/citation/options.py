"""Options by which commands that make tables are told what a table says of itself."""

from __future__ import annotations

from typing import Annotated

import typer

Note = Annotated[str | None, typer.Option("--note", help="What readers of the table should know.", show_default=False)]

Licence = Annotated[
    str | None,
    typer.Option(
        "--licence", "--license", metavar="SPDX", help="Licence of the table, as CC-BY-4.0.", show_default=False
    ),
]
