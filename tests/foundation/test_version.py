"""What files record of the software that wrote them."""

from __future__ import annotations

from importlib.metadata import version

from foundation.version import software


def test_it_is_the_installed_distribution_s() -> None:
    assert software() == f"croplab {version('croplab')}"
