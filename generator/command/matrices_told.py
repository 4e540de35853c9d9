"""What the command says of the colour matrix that it takes."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from generator.rendering.matrices import ColourMatrix


def matrix_sentence(matrix: ColourMatrix, camera: str, *, chosen: bool) -> str:
    """Return which colour matrix is taken, where it comes from, and what to mind if the table gave it.

    Parameters
    ----------
    matrix
        The matrix.
    camera
        The table's camera.
    chosen
        Whether the user asked for that matrix.
    """
    from generator.rendering.table_matrix import TABLE

    told = f"colour matrix: {matrix.name} ({matrix.source})"
    if matrix.name != TABLE:
        return told
    why = "" if chosen else f"that of {camera} is not known, so this one was fitted; "
    return (
        f"{told}; {why}if the print's colours were not managed, its faults are in the matrix as well: --matrix NAME "
        "or FILE takes that of a camera"
    )
