"""A PDF of one page of filled rectangles as print shops take it: PDF/X-4 (ISO 15930-7:2010), written by hand.

What the standard asks of such a page, with the clauses of ISO 32000-1 (PDF 1.7) that define it:

- Version 1.6, a binary comment behind the head, no encryption, a file identifier (7.5.2, 14.4).
- MediaBox and TrimBox, the latter not beyond the former (14.11.2); the sheet is trimmed to its own size.
- Device colours only of the kind that the output intent has (14.11.5): DeviceRGB, with an RGB output intent whose
  profile is embedded. The page itself holds plain codes, and nothing changes them where colours are not managed.
- XMP metadata with the version of PDF/X, dates, identifiers and whether it is trapped (14.3.2, 14.11.6).
- Nothing that needs a font, a reader's action or another file; no transparency, no transfer function.

Libraries that write PDF put fonts, dates or their own dictionaries into it, and none that is kept writes PDF/X.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from xml.sax.saxutils import escape

from experiment.chart.rgb_profiles import srgb_output_profile
from foundation.files import whole_file

DATE = "2000-01-01T00:00:00+00:00"
"""The date that the metadata must have: one for all, so that the same chart gives the same bytes."""

CONDITION = "RGB codes, unmanaged"
"""What the output intent calls the printing condition: none that is registered, for no printer is characterised."""

CONDITION_INFO = (
    "The codes name inks: print them without colour management. A workflow that manages colours all the same takes "
    "them as sRGB."
)
"""The output intent in words."""

Box = tuple[float, float, float, float]
Code = tuple[int, int, int]


def filled(boxes: Iterable[Box], code: Code) -> bytes:
    """Return the operators that fill rectangles with one code in DeviceRGB (ISO 32000-1, 8.5.2, 8.6.8)."""
    colour = " ".join(_number(channel / 255) for channel in code)
    paths = "".join(" ".join(_number(value) for value in box) + " re\n" for box in boxes)
    return f"{colour} rg\n{paths}f\n".encode("ascii")


def row_of_pixels(codes: Sequence[Code], box: Box) -> bytes:
    """Return the operators that draw one row of pixels as an image inside the page (ISO 32000-1, 8.9.7)."""
    left, bottom, width, height = (_number(value) for value in box)
    pixels = bytes(channel for code in codes for channel in code).hex()
    head = f"q\n{width} 0 0 {height} {left} {bottom} cm\nBI /W {len(codes)} /H 1 /CS /RGB /BPC 8 /F /AHx ID\n"
    return f"{head}{pixels}>\nEI\nQ\n".encode("ascii")


def save_page(path: Path, size_pt: tuple[float, float], content: bytes, title: str, subject: str) -> None:
    """Write a page as PDF/X-4; the same content gives the same bytes."""
    packed, profile = zlib.compress(content, 6), zlib.compress(srgb_output_profile(), 9)
    name = hashlib.sha256(content + title.encode() + subject.encode()).hexdigest()
    metadata = _metadata(title, subject, name).encode()
    width, height = (_number(side) for side in size_pt)
    box = f"[0 0 {width} {height}]"
    objects = (
        b"<< /Type /Catalog /Pages 2 0 R /Metadata 5 0 R /OutputIntents [6 0 R] >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /TrimBox {box} /BleedBox {box} /Resources << >> "
        "/Contents 4 0 R >>".encode("ascii"),
        _stream("/Filter /FlateDecode", packed),
        # Not compressed, so that programs that do not know PDF find it (ISO 16684-1, 7.3).
        _stream("/Type /Metadata /Subtype /XML", metadata),
        f"<< /Type /OutputIntent /S /GTS_PDFX /OutputConditionIdentifier {_string(CONDITION)} "
        f"/Info {_string(CONDITION_INFO)} /DestOutputProfile 7 0 R >>".encode("ascii"),
        _stream("/N 3 /Filter /FlateDecode", profile),
        f"<< /Title {_string(title)} /Subject {_string(subject)} /Author (CroP) /Creator (CroP) /Producer (CroP) "
        "/CreationDate (D:20000101000000Z) /ModDate (D:20000101000000Z) /GTS_PDFXVersion (PDF/X-4) "
        "/Trapped /False >>".encode("ascii"),
    )
    text = bytearray(b"%PDF-1.6\n%\xe2\xe3\xcf\xd3\n")
    offsets: list[int] = []
    for number, body in enumerate(objects, 1):
        offsets.append(len(text))
        text += f"{number} 0 obj\n".encode("ascii") + body + b"\nendobj\n"
    start = len(text)
    table = "".join(f"{offset:010d} 00000 n \n" for offset in offsets)
    text += f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{table}".encode("ascii")
    text += (
        f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R /Info {len(objects)} 0 R "
        f"/ID [<{name[:32]}> <{name[:32]}>] >>\nstartxref\n{start}\n%%EOF\n"
    ).encode("ascii")
    with whole_file(path) as stream:
        stream.write(bytes(text))


def _number(value: float) -> str:
    """Return a number as PDF has it, to a hundred-thousandth: 35 nm on paper, a 300th of an 8-bit code."""
    return f"{value:.5f}".rstrip("0").rstrip(".")


def _string(text: str) -> str:
    """Return a literal string; what is no ASCII becomes a question mark (ISO 32000-1, 7.3.4.2)."""
    plain = text.encode("ascii", "replace").decode()
    return "(" + plain.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)") + ")"


def _stream(entries: str, data: bytes) -> bytes:
    return f"<< {entries} /Length {len(data)} >>\nstream\n".encode("ascii") + data + b"\nendstream"


def _metadata(title: str, subject: str, name: str) -> str:
    """Return the XMP packet (ISO 16684-1), with what PDF/X-4 asks for; `name` is 64 hexadecimal digits."""
    identifier = f"uuid:{name[:8]}-{name[8:12]}-{name[12:16]}-{name[16:20]}-{name[20:32]}"
    return f"""<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:dc="http://purl.org/dc/elements/1.1/" xmlns:xmp="http://ns.adobe.com/xap/1.0/"
 xmlns:xmpMM="http://ns.adobe.com/xap/1.0/mm/" xmlns:pdf="http://ns.adobe.com/pdf/1.3/"
 xmlns:pdfxid="http://www.npes.org/pdfx/ns/id/">
<dc:format>application/pdf</dc:format>
<dc:title><rdf:Alt><rdf:li xml:lang="x-default">{escape(title)}</rdf:li></rdf:Alt></dc:title>
<dc:description><rdf:Alt><rdf:li xml:lang="x-default">{escape(subject)}</rdf:li></rdf:Alt></dc:description>
<dc:creator><rdf:Seq><rdf:li>CroP</rdf:li></rdf:Seq></dc:creator>
<xmp:CreateDate>{DATE}</xmp:CreateDate><xmp:ModifyDate>{DATE}</xmp:ModifyDate>
<xmp:MetadataDate>{DATE}</xmp:MetadataDate><xmp:CreatorTool>CroP</xmp:CreatorTool>
<xmpMM:DocumentID>{identifier}</xmpMM:DocumentID><xmpMM:VersionID>1</xmpMM:VersionID>
<xmpMM:RenditionClass>default</xmpMM:RenditionClass>
<pdf:Producer>CroP</pdf:Producer><pdf:Trapped>False</pdf:Trapped>
<pdfxid:GTS_PDFXVersion>PDF/X-4</pdfxid:GTS_PDFXVersion>
</rdf:Description>
</rdf:RDF>
</x:xmpmeta>
<?xpacket end="r"?>
"""
