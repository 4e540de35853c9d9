"""Published spectra against colour-science, whose tables they are."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sim.spectral import daylight, published_spectra

# They import colour-science, which takes more than a second.
pytestmark = pytest.mark.slow


def test_every_light_is_the_published_one() -> None:
    import colour

    families: tuple[Any, ...] = (colour.SDS_ILLUMINANTS, colour.SDS_LIGHT_SOURCES)
    theirs: dict[str, Any] = {str(name): light for family in families for name, light in family.items()}
    found = published_spectra()
    assert set(found) == set(theirs)
    for name, light in found.items():
        assert light.wavelengths_nm == pytest.approx(theirs[name].wavelengths, abs=1e-9), name
        assert np.array_equal(light.power, theirs[name].values), name


@pytest.mark.parametrize("cct_k", [4000, 5003, 6504, 7000, 7001, 12_000, 25_000])
def test_daylight_is_the_cie_s(cct_k: float) -> None:
    import colour

    theirs = colour.sd_CIE_illuminant_D_series(colour.temperature.CCT_to_xy_CIE_D(cct_k))
    assert daylight(cct_k).power == pytest.approx(theirs.values, abs=1e-9)
    assert np.array_equal(daylight(cct_k).wavelengths_nm, theirs.wavelengths)
