"""Numbers of colour, of robust weights and of figures, and texts for readers, as they were before."""

from __future__ import annotations

import io
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from foundation import errors
from foundation.colorimetry import (
    angles_deg,
    decode_srgb,
    encode_srgb,
    linear_srgb,
    observer_cie_1931,
    planck,
    srgb_codes,
    xyz_of,
)
from foundation.console import JsonOutput, plain
from foundation.local_server import is_loopback, qr_text, reachable_addresses
from foundation.pages import figure, fold, note, paragraph, row, table, verdict
from foundation.plots import draw_squares, legend_label, series_style, standalone
from foundation.robust import biweight, huber_weights, sigma_of
from foundation.secret_texts import masked, printable
from tests.pinned import Pinned
from tests.pinned.drawn import drawn


def test_numbers_of_colour(pinned: Pinned) -> None:
    """To more digits than others, since the two parts of sRGB's curve differ by little where they meet."""
    light = np.array([-0.1, 0, 0.001, 0.0031307, 0.0031308, 0.0031309, 0.04, 0.18, 0.5, 1, 1.5])
    codes = np.array([0, 0.01, 0.0404, 0.04045, 0.0405, 0.25, 0.5, 1, 1.2])
    wavelengths = np.array([300.0, 380, 400.5, 555, 700, 900])
    rng = np.random.default_rng(19)
    one, other = rng.uniform(0, 1, (2, 6, 3))
    found = {
        "encoded": encode_srgb(light),
        "decoded": decode_srgb(codes),
        "codes": srgb_codes(light),
        "angles": [angles_deg(one, other), angles_deg(one, one), angles_deg(one, -one), angles_deg(one[0], other)],
        "planck": [planck(wavelengths, kelvin) * 1e6 for kelvin in (2000.0, 5600.0, 12000.0)],
        "xyz": [xyz_of(wavelengths, power) for power in (np.ones(6), planck(wavelengths, 6500.0))],
        "linear": linear_srgb(one),
        "observer": observer_cie_1931(),
        "weights": [huber_weights(light, 0.02), biweight(light, 0.1), biweight(light, 0.1, 2.0), sigma_of(light)],
    }
    pinned("numbers of colour", found, same=1e-8, nothing=1e-12)


def test_texts_for_readers(pinned: Pinned) -> None:
    @dataclass(frozen=True)
    class Found:
        place: Path
        number: float

    values = [
        Found(Path("lut"), float("inf")),
        {1: np.float32(0.5), "b": {3}},
        (True, None, 2.0),
        np.arange(3),
        Decimal(1),
    ]
    output, stream = JsonOutput("evaluate x", True), io.StringIO()
    output.write(stream)
    output.append("list", 1)
    output.append("list", "é")
    output.add(other=np.float64("nan"), values=values)
    output.write(stream)
    names = ["one", "two", "three", "four"]
    hosts = ("localhost", "127.9.0.1", "::1", "0.0.0.0", "a.b", "LOCALHOST", "1.2.3.4")
    addresses = ("s3://key:secret@host/a?token=abc&x=1", "https://a.b/c?sig=1", "plain", "u:p@h")
    found: dict[str, Any] = {
        "plain": plain(values),
        "printed": stream.getvalue(),
        "names": [errors.first_of(names, count) for count in (1, 3, 4, 9)] + [errors.first_of([])],
        "nearest": [errors.nearest_names(text, names) for text in ("tow", "ONE", "thre", "x", "fourth")],
        "kinds": [errors.kind_of(one) for one in (1, "a", None, [1], np.zeros((2, 3)), {1: 2}, Path("a"))],
        "masked": [masked(text) for text in addresses],
        "printable": [printable(text) for text in ("a\x1b[0m\n", "\udce9", "é\t", "\x7f\x9b\u202e")],
        "hosts": [[is_loopback(host), host] for host in hosts],
        "reached": [reachable_addresses(host) for host in ("a.b", "1.2.3.4", "::1", "fe80::2")],
        "code": [qr_text(text) for text in ("a", "http://192.168.1.7:8708/0123456789abcdef/")],
    }  # fmt: skip
    pinned("texts for readers", found)


def test_pieces_of_pages_and_figures(pinned: Pinned) -> None:
    svg = b'<?xml version="1.0"?><svg width="120.5pt" height="9pt" viewBox="0 0 1 1"><path d="M0 0"/></svg>'
    rows = (("<a>", "1.5", "0.1 to 2.3"), ("b --option VALUE", "-2", "−4 … 5"))
    pieces = [
        paragraph("a & b"), note("small --flag"), verdict("accept", "good"), verdict("refuse", "bad"),
        table("Errors", ("Name", "Mean", "Interval"), rows, (False, True, True), ("one", "two")),
        table("Empty", ("Name",), (), (False,)), figure(svg, "caption", "words", wide=True), figure(b"\x89PNG1", "png"),
        figure(b"\xff\xd81", "jpeg", ""), row([paragraph("1"), note("2")]), fold("more", [note("in it")]),
        fold("open", [note("a"), note("b")], open_at_first=True),
    ]  # fmt: skip
    sheet = Figure((4, 3))
    axes = sheet.add_subplot()
    places = np.array([[10.0, 20.0], [50.0, 60.0], [90.0, 5.0]])
    for side, inches in ((8.0, 4.0), (0.01, 4.0), (2.0, 9.0)):
        draw_squares(axes, (105.0, 74.0), places, side, np.array([0.1, 0.5, 2.0]), inches, cmap="gray", vmin=0, vmax=2)
    squares = [[one.get_sizes(), one.get_offsets().data] for one in axes.collections]  # pyrefly: ignore[missing-attribute]
    found: dict[str, Any] = {
        "pieces": [str(piece) for piece in pieces],
        "styles": [series_style(number) for number in (0, 6, 7, 13, 27, 28)],
        "labels": [legend_label(name) for name in ("_a", "a_", "")],
        "standalone": standalone(svg),
        "squares": [squares, axes.get_xlim(), axes.get_ylim(), axes.get_aspect(), len(drawn(sheet)) > 3],
    }
    pinned("pieces of pages and figures", found)
