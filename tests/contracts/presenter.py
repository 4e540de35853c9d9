"""Contract tests of every presenter; a suite supplies its presenter with the fixture `bench`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pytest

from drivers.presenter import BLACK, WHITE, Colour, Presenter, ReadsBack
from foundation.errors import DeviceError

RAMPS = tuple(
    colour for code in range(0, 256, 17) for colour in (Colour(code, 0, 0), Colour(0, code, 0), Colour(0, 0, code))
)


@dataclass(frozen=True)
class Bench:
    """A presenter under test; `seen` reads the codes of the shown light independently of the presenter."""

    presenter: Presenter
    seen: Callable[[], Colour]


class PresenterContract:
    """Subclass it as ``TestX`` and supply the fixture `bench`."""

    def test_starts_black(self, bench: Bench) -> None:
        assert bench.seen() == BLACK

    def test_shows_each_channel_at_all_levels(self, bench: Bench) -> None:
        for colour in RAMPS:
            bench.presenter.show(colour)
            assert bench.seen() == colour

    def test_does_not_mix_channels(self, bench: Bench) -> None:
        for colour in (Colour(1, 2, 3), Colour(254, 128, 127), Colour(3, 2, 1), WHITE, BLACK):
            bench.presenter.show(colour)
            assert bench.seen() == colour

    def test_shows_same_colour_twice(self, bench: Bench) -> None:
        for _ in range(2):
            bench.presenter.show(Colour(200, 100, 50))
            assert bench.seen() == Colour(200, 100, 50)

    def test_verifies_shown_colour(self, bench: Bench) -> None:
        if not isinstance(bench.presenter, ReadsBack):
            pytest.skip("the presenter cannot read back")
        for colour in (Colour(1, 2, 3), WHITE, BLACK):
            bench.presenter.show(colour)
            for _ in range(2):
                bench.presenter.verify(colour)
            with pytest.raises(DeviceError):
                bench.presenter.verify(Colour(1, 2, 4))
            assert bench.seen() == colour, "verify must not change the colour"
        bench.presenter.close()
        with pytest.raises(DeviceError):
            bench.presenter.verify(BLACK)

    def test_is_black_after_close(self, bench: Bench) -> None:
        bench.presenter.show(WHITE)
        bench.presenter.close()
        bench.presenter.close()
        assert bench.seen() == BLACK
        with pytest.raises(DeviceError):
            bench.presenter.show(WHITE)
        assert bench.seen() == BLACK
