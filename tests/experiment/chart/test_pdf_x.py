"""Preflight of the PDFs for print shops, and their profiles.

No maintained library checks PDF/X (veraPDF checks PDF/A and PDF/UA). So a small reader follows the cross-reference
table, not the order of the writer. The result is compared with PDF/X-4 (ISO 15930-7:2010) and the clauses of ISO
32000-1.
"""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image, ImageCms

from experiment.chart.layout import design_chart
from experiment.chart.pdf_x import srgb_display_profile, srgb_output_profile
from experiment.chart.printing import save_pdf
from experiment.chart.proof import save_proof

NAMESPACES = {
    "rdf": "http://www.w3.org/1999/02/22-rdf-syntax-ns#",
    "dc": "http://purl.org/dc/elements/1.1/",
    "xmp": "http://ns.adobe.com/xap/1.0/",
    "xmpMM": "http://ns.adobe.com/xap/1.0/mm/",
    "pdf": "http://ns.adobe.com/pdf/1.3/",
    "pdfxid": "http://www.npes.org/pdfx/ns/id/",
}

# Keys that PDF/X forbids or this page does not need: encryption, actions, files, fonts, transfer functions, halftones,
# OPI, PostScript, LZW, transparency.
FORBIDDEN = (
    *(b"/Encrypt", b"/JavaScript", b"/JS", b"/AA", b"/OpenAction", b"/Annots", b"/EmbeddedFile", b"/Font"),
    *(b"/TR", b"/HTP", b"/OPI", b"/PS", b"/LZWDecode", b"/SMask", b"/Group", b"/ExtGState", b"/Alternates"),
)


class Pdf:
    """The objects of a file without compressed cross-references."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        start = int(re.findall(rb"startxref\n(\d+)\n%%EOF", data)[-1])
        head = re.match(rb"xref\n0 (\d+)\n", data[start:])
        assert head is not None
        self.objects: dict[int, bytes] = {}
        lines = data[start + head.end() :][: 20 * int(head[1])]
        for number in range(1, int(head[1])):
            offset, kind = int(lines[20 * number :][:10]), lines[20 * number + 17 :][:1]
            assert kind == b"n"
            object_start = re.match(rb"%d 0 obj\n" % number, data[offset:])
            assert object_start is not None, f"object {number} is not at its offset"
            self.objects[number] = data[offset + object_start.end() : data.index(b"\nendobj", offset)]
        self.trailer = data[data.index(b"trailer", start) :]

    def of(self, text: bytes, key: str) -> bytes:
        """Return the object to which a key of another object refers."""
        reference = re.search(rb"/%s \[?(\d+) 0 R" % key.encode(), text)
        assert reference is not None, f"{key} is missing"
        return self.objects[int(reference[1])]

    @staticmethod
    def stream(text: bytes) -> bytes:
        """Return the contents of a stream after checking its length."""
        length = re.search(rb"/Length (\d+)", text)
        assert length is not None
        body = text[text.index(b"stream\n") + 7 : text.rindex(b"\nendstream")]
        assert len(body) == int(length[1])
        return zlib.decompress(body) if b"/FlateDecode" in text else body


def box_of(page: bytes, name: str) -> list[float]:
    match = re.search(rb"/%s \[([-\d. ]+)\]" % name.encode(), page)
    assert match is not None, f"{name} is missing"
    return [float(value) for value in match[1].split()]


@pytest.fixture(scope="module", params=["chart", "proof"])
def pdf(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pdf") / f"{request.param}.pdf"
    (save_pdf if request.param == "chart" else save_proof)(design_chart(2), path)
    return path


def test_preflight(pdf: Path) -> None:
    data = pdf.read_bytes()
    # ISO 32000-1, 7.5.2: version, and a comment of at least four bytes above 127; PDF/X-4 is based on PDF 1.6.
    assert data.startswith(b"%PDF-1.6\n%")
    assert all(byte > 127 for byte in data[10:14])
    document = Pdf(data)
    # 14.4: two file identifiers, present in PDF/X; no encryption.
    assert re.search(rb"/ID \[<[0-9a-f]{32}> ?<[0-9a-f]{32}>\]", document.trailer)
    structure = b"".join(text.split(b"stream\n")[0] for text in document.objects.values()) + document.trailer
    for key in FORBIDDEN:
        assert not re.search(re.escape(key) + rb"\b", structure), key
    catalog = document.of(document.trailer, "Root")
    page = document.of(document.of(catalog, "Pages"), "Kids")
    # 14.11.2: trim within bleed within media; PDF/X wants a TrimBox or an ArtBox, not both.
    media, bleed, trim = (box_of(page, name) for name in ("MediaBox", "BleedBox", "TrimBox"))
    assert b"/ArtBox" not in page
    assert media[0] <= bleed[0] <= trim[0] < trim[2] <= bleed[2] <= media[2]
    assert media[1] <= bleed[1] <= trim[1] < trim[3] <= bleed[3] <= media[3]
    # 14.11.5: one output intent of PDF/X, whose profile is of an output device (class prtr) and of RGB.
    intent = document.of(catalog, "OutputIntents")
    assert re.search(rb"/S /GTS_PDFX\b", intent)
    assert re.search(rb"/OutputConditionIdentifier \(.+?\)", intent)
    assert re.search(rb"/Info \(.+?\)", intent)
    profile = document.stream(document.of(intent, "DestOutputProfile"))
    assert profile == srgb_output_profile()
    # The colours of the page are of the same kind as the intent: only DeviceRGB (rg; /RGB of the inline image).
    content = document.stream(document.of(page, "Contents"))
    operators = set(re.findall(rb"(?<![\w/])([a-zA-Z*]+)(?=\n|$)", re.sub(rb"BI.*?EI", b"", content, flags=re.DOTALL)))
    assert operators <= {b"rg", b"re", b"f", b"q", b"Q", b"cm"}
    # 8.4.5, 7.8.3: no resource is used, so none is named and there is no unused font.
    assert re.search(rb"/Resources << >>", page)
    # 14.3.3 and 14.11.6: title, and trapping, which must not be unknown.
    information = document.of(document.trailer, "Info")
    assert re.search(rb"/Trapped /(True|False)\b", information)
    assert b"/GTS_PDFXVersion (PDF/X-4)" in information
    # 14.3.2: XMP, readable without PDF support, with version, dates and identifiers; it agrees with the information
    # dictionary.
    metadata = document.of(catalog, "Metadata")
    assert b"/Filter" not in metadata
    xmp = ElementTree.fromstring(document.stream(metadata).decode("utf-8").split("?>", 1)[1].rsplit("<?", 1)[0])
    for name in ("xmp:CreateDate", "xmp:ModifyDate", "xmp:MetadataDate", "xmpMM:DocumentID", "xmpMM:VersionID"):
        assert xmp.findtext(f".//{name}", namespaces=NAMESPACES), name
    assert xmp.findtext(".//xmpMM:RenditionClass", namespaces=NAMESPACES) == "default"
    assert xmp.findtext(".//pdf:Trapped", namespaces=NAMESPACES) == "False"
    assert xmp.findtext(".//pdfxid:GTS_PDFXVersion", namespaces=NAMESPACES) == "PDF/X-4"
    title = xmp.findtext(".//dc:title//rdf:li", namespaces=NAMESPACES)
    assert title is not None
    assert f"/Title ({title})".encode() in information


def test_poppler_reads_the_boxes_and_no_fonts(pdf: Path) -> None:
    if shutil.which("pdfinfo") is None or shutil.which("pdffonts") is None:
        pytest.skip("poppler is not installed")
    information = subprocess.run(["pdfinfo", "-box", pdf], capture_output=True, text=True, check=True)
    assert information.stderr == ""
    boxes = dict(re.findall(r"^(\w+Box): +(.+)$", information.stdout, re.MULTILINE))
    assert boxes["TrimBox"] == boxes["MediaBox"]
    assert "PDF version:     1.6" in information.stdout
    fonts = subprocess.run(["pdffonts", pdf], capture_output=True, text=True, check=True).stdout
    assert len(fonts.splitlines()) == 2


@pytest.mark.slow
@pytest.mark.parametrize("make", [srgb_output_profile, srgb_display_profile])
def test_little_cms_reads_the_profile_as_srgb(make: Callable[[], bytes]) -> None:
    # Most of Pillow's colour management has no types.
    cms: Any = ImageCms
    profile = cms.ImageCmsProfile(io.BytesIO(make()))
    reference, lab = cms.createProfile("sRGB"), cms.createProfile("LAB")
    codes = np.random.default_rng(1).integers(0, 256, (64, 64, 3)).astype(np.uint8)
    picture, intent = Image.fromarray(codes), cms.Intent.RELATIVE_COLORIMETRIC

    def convert(source: Any, target: Any, mode: str) -> npt.NDArray[np.int64]:
        converted = cms.applyTransform(picture, cms.buildTransform(source, target, "RGB", mode, intent))
        return np.asarray(converted).astype(np.int64)

    # Hue channels of an 8-bit LAB picture are signed and wrap at 128.
    difference = convert(profile, lab, "LAB") - convert(reference, lab, "LAB")
    assert np.abs((difference + 128) % 256 - 128).max() <= 1
    assert np.abs(convert(reference, profile, "RGB") - codes).max() <= 1
