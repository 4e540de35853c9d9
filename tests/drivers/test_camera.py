"""What a camera is called."""

from __future__ import annotations

import pytest

from drivers.camera import CameraIdentity


@pytest.mark.parametrize(
    ("maker", "model", "name"),
    [
        ("Canon Inc.", "Canon EOS 550D", "Canon EOS 550D"),
        ("NIKON CORPORATION", "Nikon D750", "Nikon D750"),
        ("Sony Corporation", "ILCE-7M3", "Sony Corporation ILCE-7M3"),
        ("", "Camera", "Camera"),
        ("Acme", "", "Acme"),
    ],
)
def test_a_maker_is_named_once(maker: str, model: str, name: str) -> None:
    assert CameraIdentity(maker, model, "1").name == name
