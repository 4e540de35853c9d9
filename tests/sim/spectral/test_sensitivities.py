"""Files of spectral sensitivities: those that come with the suite, any grid, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from foundation.errors import FormatError, InputError
from sim.spectral import WAVELENGTHS_NM, known_sensitivities, parse_sensitivities, read_sensitivities, sensitivities


def document(step: float = 10, low: float = 390, high: float = 720, **changes: Any) -> dict[str, Any]:
    grid = np.arange(low, high + 1, step)
    peaks = np.array([600.0, 540.0, 460.0])
    curves = np.exp(-0.5 * ((grid[:, None] - peaks) / 28) ** 2)
    table = {f"{at:g}": row for at, row in zip(grid, curves.tolist(), strict=True)}
    spectra = {"units": "relative", "index": {"main": ["R", "G", "B"]}, "data": {"main": table}}
    return {"header": {"manufacturer": "Maker", "model": "M1"}, "spectral_data": spectra | changes}


def parsed(content: Any) -> Any:
    return parse_sensitivities(json.dumps(content).encode(), "m1", "m1.json")


def test_those_that_come_with_the_suite_are_known_by_name() -> None:
    assert len(known_sensitivities()) == 5
    for name in known_sensitivities():
        found = read_sensitivities(name)
        assert found.camera == name.replace("_", " ")
        # The files' own numbers at their own wavelengths: nothing is resampled there.
        assert np.array_equal(sensitivities(name), found.curves)


def test_another_grid_is_resampled_by_straight_lines_and_is_blind_beyond() -> None:
    found = parsed(document())
    assert found.camera == "Maker M1"
    at = found.at(WAVELENGTHS_NM)[[0, 15, 16, 80]]
    assert at[0].tolist() == at[3].tolist() == [0, 0, 0]
    middle = (found.curves[found.wavelengths_nm == 450] + found.curves[found.wavelengths_nm == 460])[0] / 2
    assert at[1] == pytest.approx(middle)
    assert at[2, 2] == 1


def altered(place: str, value: Any) -> dict[str, Any]:
    content = document()
    table = content["spectral_data"]["data"]["main"]
    if value is None:
        for at in place.split():
            del table[at]
    else:
        table[place] = value
    return content


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "expected rawtoaces"),
        ({"spectral_data": {}}, r"spectral_data\.index: Field required"),
        (document(units="quantum efficiency"), "units is 'quantum efficiency', 'relative' expected"),
        (document(index={"main": ["X", "Y", "Z"]}), r"index\.main is \['X', 'Y', 'Z'\]"),
        (altered("500 510 520", None), "a gap from 490 to 530 nm, 20 nm at most"),
        (altered("500", [0.1, -0.2, 0.1]), "G is -0.2 at 500 nm, 0 or more expected"),
        (altered("500", [0.1, 0.2]), r"at 500 nm stand \[0.1, 0.2\]; three numbers expected"),
        (altered("blue", [0.1, 0.2, 0.3]), "'blue' is no wavelength"),
        (altered("500.0", [0.1, 0.2, 0.3]), "500 nm stands there twice"),
        (document(low=420), "its wavelengths are 420 to 720, 400 to 700 nm at least"),
        (document(low=0.39, high=0.72, step=0.01), "convert them to nanometres"),
        (altered("390", [0, 0, 0.3]), "B still has 30% of its peak at its last wavelength, 390 nm"),
        (altered("720", [0.051, 0, 0]), "R still has 5% of its peak at its last wavelength, 720 nm"),
    ],
)
def test_what_cannot_be_a_cameras_is_refused(content: Any, message: str) -> None:
    assert parsed(altered("720", [0.05, 0, 0])).curves[-1, 0] == 0.05, "so much may be left at the end"
    with pytest.raises(FormatError, match=message) as refused:
        parsed(content)
    assert str(refused.value).startswith("m1.json")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (json.dumps(document()).replace('"500"', '"490"'), "'490' stands there twice"),
        ("[" * 100_000, "is no JSON"),
    ],
)
def test_what_json_would_pass_over_or_fall_over_is_refused(text: str, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        parse_sensitivities(text.encode(), "m1", "m1.json")


def test_no_such_camera_names_those_that_are_known() -> None:
    with pytest.raises(InputError, match=r"no camera 'Canon_EOS_1'.*Canon_EOS_5DS"):
        read_sensitivities("Canon_EOS_1")


def test_what_is_no_json_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "picture.json"
    path.write_bytes(b"\xff\xd8\xff\xe0")
    with pytest.raises(FormatError, match="is no JSON"):
        read_sensitivities(str(path))
