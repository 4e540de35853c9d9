"""What is known of a deviation, in plain numbers, whichever figure shows it: what the table of causes decides by.

What was not measured is NaN, and decides nothing. Shares are 0 … 1 unless said.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cache

NAN = float("nan")


@dataclass(frozen=True)
class Evidence:
    """What is known of a deviation.

    - `frames`: frames of the print that were compared.
    - `showing`: share of them that show it.
    - `even_showing`: share of the white frames, but the one compared with, that show it; 0 where there is no other.
    - `white_residual`: share of the white frames whose references are off there by half as much or more.
    - `some_whites`: 1 where the references of some white frames are off there and those of others not; else 0.
    - `spot`: share of the cells there that are not of their codes' colours in the mean of the white frames.
    - `in_first`: 1 where all frames differ at one place from the frame that they are compared with, so that it is
      there; else 0.
    - `share`: share of the print that deviates.
    - `deviation`: how far the place is off, relative, with its sign: below 0 it is darker; the channel that deviates
      most.
    - `tint`: how differently the channels are off, over `deviation`'s size: 0 where all are off alike.
    - `added`: light that cells have there besides their own, whatever their colour, of paper white.
    - `kept`: share of their own light that they have.
    - `rim`: mean residual of the outermost references, relative, with its sign.
    - `rim_frames`: share of the white frames in which it is below −0.5 %.
    - `radial`: share of the residuals' variance that distance from the middle explains.
    - `hot`: share of the cells concerned that hold a photosite which is hot in every dark frame.
    - `scatter`: spread of all cells of the frame about their codes' colours, relative.
    - `softer`: light of neighbouring cells added by the frame's blur, in the worst sample.
    - `moved_px`: how far the chart lies from where it was registered, half-size px.
    - `anew`: share of the frames in which the chart had to be registered again.
    - `agreement`: correlation of the cells with the chart where it was registered.
    - `exposure`: exposure of the frame by its file over the other frames'.
    - `brightness`: light of the frame over what its code gives.
    - `off_codes_deg`: angle between a light's white and what its codes give, degrees.
    - `named_right`: 1 where a light's white is what its codes give, 0 where it is what another light's give.
    - `cameras`: cameras or lenses among the frames, by their files.
    - `room`: light while the projector shows black, of white.
    - `room_change`: change of it between dark frames, of white.
    - `stray`: light of a primary under a code of 0 that no dark frame shows, of that primary, the worst light.
    - `stray_primaries`: light of the primaries' frames together beyond white's, alike in each, of white.
    - `other_iso`: frames of another ISO speed than most, by their files.
    - `misplaced`: share of the unfit cells whose place is not known well enough.
    - `uneven`: share of the unfit cells whose rim and middle differ.
    - `waves_px`: how far tags lie from where a flat sheet would have them, RMS, half-size px of cells of 10 px.
    - `beyond_cell`: share of the light of a window's worst sample that the lens brings from beyond its cell.
    - `veil`: light of the whole frame that the lens spreads over each place, of paper white.
    """

    frames: float = NAN
    showing: float = NAN
    even_showing: float = NAN
    white_residual: float = NAN
    some_whites: float = NAN
    spot: float = NAN
    in_first: float = NAN
    share: float = NAN
    deviation: float = NAN
    tint: float = NAN
    added: float = NAN
    kept: float = NAN
    rim: float = NAN
    rim_frames: float = NAN
    radial: float = NAN
    hot: float = NAN
    scatter: float = NAN
    softer: float = NAN
    moved_px: float = NAN
    anew: float = NAN
    agreement: float = NAN
    exposure: float = NAN
    brightness: float = NAN
    off_codes_deg: float = NAN
    named_right: float = NAN
    cameras: float = NAN
    room: float = NAN
    room_change: float = NAN
    stray: float = NAN
    stray_primaries: float = NAN
    other_iso: float = NAN
    misplaced: float = NAN
    uneven: float = NAN
    waves_px: float = NAN
    beyond_cell: float = NAN
    veil: float = NAN

    def known(self) -> dict[str, float]:
        """Return what was measured, by name."""
        return {name: value for name in evidence_names() if (value := getattr(self, name)) == value}


@cache
def evidence_names() -> tuple[str, ...]:
    """Return the names of what evidence may hold, in its order."""
    return tuple(field.name for field in fields(Evidence))
