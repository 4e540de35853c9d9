"""Write one page of filled rectangles as PDF/X-4 (ISO 15930-7:2010), and the ICC profiles that it needs.

PDF/X-4 has these requirements. The numbers are clauses of ISO 32000-1 (PDF 1.7):

- Version 1.6, a binary comment after the header, no encryption, a file identifier (7.5.2, 14.4).
- A MediaBox, and a TrimBox inside it (14.11.2). Here both are the sheet.
- Device colours of the same kind as the output intent (14.11.5): DeviceRGB, with an embedded RGB profile.
- XMP metadata with the version of PDF/X, dates, identifiers and trapping (14.3.2, 14.11.6).
- No fonts, actions or external files; no transparency, no transfer functions.

The codes on the page have no profile (they are untagged), so they are not changed if colour management is off. For
printing with colour management, the output intent of a PDF needs the ICC profile of an output device, and a TIFF needs
the profile of an input device or display. Both profiles declare sRGB (IEC 61966-2-1). Neither describes a printer.

Source of the profiles: ICC.1:2001-04 (version 2.4), header 6.1, required tags 6.3, lut16Type 6.5.8,
textDescriptionType 6.5.17. The primaries of sRGB are adapted to D50 by the Bradford transform, as in the sRGB profiles
of the ICC.

No maintained library writes PDF/X, and PDF libraries add fonts, dates or dictionaries. Here the same chart always gives
the same bytes.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import decode_srgb, encode_srgb
from foundation.files import atomic_file

# Date in the metadata. PDF/X requires a date, and a constant keeps the bytes of a chart equal.
DATE = "2000-01-01T00:00:00+00:00"

# Name of the printing condition in the output intent. Registered names belong to characterised printers.
CONDITION = "RGB codes, unmanaged"

# Description of the printing condition in the output intent.
CONDITION_INFO = (
    "The codes are amounts of ink: print them without colour management. If a workflow manages colours, it takes the "
    "codes as sRGB."
)

# XYZ of full red, green and blue (columns), relative to D50.
_PRIMARIES = np.array(
    [[0.4360747, 0.3850649, 0.1430804], [0.2225045, 0.7168786, 0.0606169], [0.0139322, 0.0971045, 0.7141733]]
)

_WHITE = (0.9642, 1.0, 0.8249)  # D50, white of the profile connection space (ICC.1:2001-04, 6.1.11)

_CURVE = 4096  # Number of entries of a curve: the maximum of lut16Type

_DISPLAY_CURVE = 1024  # Number of entries of a curve in the display profile, as in the sRGB profile of the ICC

_GAMUT_GRID = 17  # Number of points along each side of the gamut table, which only serves for warnings

_FULL = 65535  # 16-bit encoding of the device value 1 (ICC.1:2001-04, 6.5.8)

_ONE_XYZ = 32768  # Encoding of X, Y or Z = 1 as u1Fixed15 (ICC.1:2001-04, 5.3.4.2)

Box = tuple[float, float, float, float]
Code = tuple[int, int, int]

_Array = npt.NDArray[np.float64]


def filled(boxes: Iterable[Box], code: Code) -> bytes:
    """Return the operators that fill rectangles with one code in DeviceRGB (ISO 32000-1, 8.5.2, 8.6.8)."""
    colour = " ".join(_number(channel / 255) for channel in code)
    paths = "".join(" ".join(_number(value) for value in box) + " re\n" for box in boxes)
    return f"{colour} rg\n{paths}f\n".encode("ascii")


def row_of_pixels(codes: Sequence[Code], box: Box) -> bytes:
    """Return the operators that draw one row of pixels as an inline image (ISO 32000-1, 8.9.7)."""
    left, bottom, width, height = (_number(value) for value in box)
    pixels = bytes(channel for code in codes for channel in code).hex()
    head = f"q\n{width} 0 0 {height} {left} {bottom} cm\nBI /W {len(codes)} /H 1 /CS /RGB /BPC 8 /F /AHx ID\n"
    return f"{head}{pixels}>\nEI\nQ\n".encode("ascii")


def save_page(path: Path, size_pt: tuple[float, float], content: bytes, title: str, subject: str) -> None:
    """Write a page as PDF/X-4."""
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
        # Not compressed, so that programs without PDF support can read it (ISO 16684-1, 7.3).
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
    with atomic_file(path) as stream:
        stream.write(bytes(text))


def _number(value: float) -> str:
    # Five decimals are much finer than a printed dot or a step of an 8-bit code.
    return f"{value:.5f}".rstrip("0").rstrip(".")


def _string(text: str) -> str:
    ascii_text = text.encode("ascii", "replace").decode()
    return "(" + ascii_text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)") + ")"


def _stream(entries: str, data: bytes) -> bytes:
    return f"<< {entries} /Length {len(data)} >>\nstream\n".encode("ascii") + data + b"\nendstream"


def _metadata(title: str, subject: str, name: str) -> str:
    """Return the XMP packet (ISO 16684-1) that PDF/X-4 requires; `name` is 64 hexadecimal digits."""
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


def srgb_output_profile() -> bytes:
    """Return an ICC profile of an output device whose RGB codes are sRGB.

    The class is ``prtr``, which output intents need (ISO 32000-1, 14.11.5), with the tags of a table-based output
    profile. All rendering intents are the same: relative to the white of the medium.
    """
    corners = np.stack(np.meshgrid([0.0, 1.0], [0.0, 1.0], [0.0, 1.0], indexing="ij"), axis=-1).reshape(-1, 3)
    # XYZ is a linear function of linear RGB, so a table with two points on each axis is exact.
    xyz, rgb = np.rint(_ONE_XYZ * (corners @ _PRIMARIES.T)).astype(np.uint16), (_FULL * corners).astype(np.uint16)
    to_pcs = _lut16(np.eye(3), _curves(decode_srgb(np.linspace(0, 1, _CURVE))), xyz, _LINEAR)
    # The matrix is applied to encoded XYZ divided by 65535. The quotient 1 is X = 65535 / 32768.
    from_xyz = np.linalg.inv(_PRIMARIES) * _FULL / _ONE_XYZ
    from_pcs = _lut16(from_xyz, _LINEAR, rgb, _curves(encode_srgb(np.linspace(0, 1, _CURVE))))
    tags = {
        "desc": _description("CroP RGB codes taken as sRGB (no printer is characterised)"),
        "cprt": _text("No copyright, use freely"),
        "wtpt": _xyz(_WHITE),
        **dict.fromkeys(("A2B0", "A2B1", "A2B2"), to_pcs),
        **dict.fromkeys(("B2A0", "B2A1", "B2A2"), from_pcs),
        "gamt": _gamut(),
    }
    return _profile(b"prtr", tags)


def srgb_display_profile() -> bytes:
    """Return an ICC profile of a display whose RGB codes are sRGB (class ``mntr``, three primaries and a curve)."""
    curve = np.rint(_FULL * decode_srgb(np.linspace(0, 1, _DISPLAY_CURVE))).astype(">u2").tobytes()
    curve = b"curv" + bytes(4) + struct.pack(">I", _DISPLAY_CURVE) + curve
    tags = {
        "desc": _description("sRGB IEC61966-2.1 (CroP)"),
        "cprt": _text("No copyright, use freely"),
        "wtpt": _xyz(_WHITE),
        **{f"{name}XYZ": _xyz(tuple(column)) for name, column in zip("rgb", _PRIMARIES.T.tolist(), strict=True)},
        **dict.fromkeys(("rTRC", "gTRC", "bTRC"), curve),
    }
    return _profile(b"mntr", tags)


def _curves(curve: _Array) -> npt.NDArray[np.uint16]:
    return np.tile(np.rint(_FULL * np.clip(curve, 0, 1)).astype(np.uint16), (3, 1))


_LINEAR = _curves(np.array([0.0, 1.0]))  # The identity as a curve


def _gamut() -> bytes:
    # The table is 0 inside the gamut and 65535 outside.
    side = np.linspace(0, _FULL / _ONE_XYZ, _GAMUT_GRID)
    xyz = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    rgb = xyz @ np.linalg.inv(_PRIMARIES).T
    outside = np.asarray(((rgb < 0) | (rgb > 1)).any(axis=1, keepdims=True), dtype=np.uint16)
    return _lut16(np.eye(3), _LINEAR, np.uint16(_FULL) * outside, _LINEAR[:1])


def _lut16(
    matrix: _Array, inputs: npt.NDArray[np.uint16], table: npt.NDArray[np.uint16], outputs: npt.NDArray[np.uint16]
) -> bytes:
    """Return a lut16Type: matrix, input curves, table (points, channels), output curves."""
    grid = round(len(table) ** (1 / 3))
    head = struct.pack(">4s4x3Bx", b"mft2", 3, table.shape[1], grid)
    matrix_bytes = np.rint(matrix * 65536).astype(">i4").tobytes()
    sizes = struct.pack(">2H", inputs.shape[1], outputs.shape[1])
    return head + matrix_bytes + sizes + b"".join(values.astype(">u2").tobytes() for values in (inputs, table, outputs))


def _xyz(values: tuple[float, ...]) -> bytes:
    return b"XYZ " + bytes(4) + np.rint(np.array(values) * 65536).astype(">i4").tobytes()


def _text(text: str) -> bytes:
    return b"text" + bytes(4) + text.encode("ascii") + b"\0"


def _description(text: str) -> bytes:
    # textDescriptionType: the ASCII text, followed by empty Unicode and ScriptCode texts.
    data = text.encode("ascii") + b"\0"
    return b"desc" + bytes(4) + struct.pack(">I", len(data)) + data + bytes(8) + bytes(3) + bytes(67)


def _profile(kind: bytes, tags: Mapping[str, bytes]) -> bytes:
    """Return an RGB profile with the connection space XYZ. If several tags have equal data, these are stored once."""
    offset = 128 + 4 + 12 * len(tags)
    entries, body = b"", b""
    offsets: dict[bytes, int] = {}
    for name, data in tags.items():
        if data not in offsets:
            offsets[data] = offset + len(body)
            body += data + bytes(-len(data) % 4)
        entries += struct.pack(">4s2I", name.encode("ascii"), offsets[data], len(data))
    size = offset + len(body)
    white = np.rint(np.array(_WHITE) * 65536).astype(">i4").tobytes()
    head = struct.pack(">I4sI4s4s4s", size, bytes(4), 0x02400000, kind, b"RGB ", b"XYZ ")
    head += struct.pack(">6H", 2000, 1, 1, 0, 0, 0) + b"acsp" + bytes(24) + struct.pack(">I", 1) + white
    return head.ljust(128, b"\0") + struct.pack(">I", len(tags)) + entries + body
