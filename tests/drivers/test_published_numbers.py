"""Ports, speeds, identifiers and codes match the published numbers; simulator and driver share them.

Sources, unless the module names them: IANA's list of ports; PJLink 2.10; X.Org, X.h and dpms.h; Khronos, gl.xml; TIFF
6.0 and DNG 1.7.1; USB 2.0, chapter 9; ISO 15740 and CIPA DC-005.
"""

from __future__ import annotations

import pytest

from drivers import pjlink, tiff
from drivers.display import fullscreen, x11
from drivers.links import link, network, usb
from drivers.ptp import ip, protocol
from drivers.ptp import usb as ptp_usb
from drivers.raw import rawfile


@pytest.mark.parametrize(
    ("ours", "published"),
    [
        ((pjlink.PORT, ip.PORT), (4352, 15740)),
        ((pjlink.MAX_LINE, pjlink.MAX_PASSWORD, pjlink.IDLE_LIMIT_S, pjlink.COLLECT_S), (136, 32, 30, 30)),
        ((usb.STILL_IMAGE_CLASS, usb._CLASS_OUT, usb._CLASS_IN, usb._BULK), ((6, 1, 1), 0x21, 0xA1, 2)),
        ((usb._INTERRUPT,), (3,)),
        ((x11.INPUT_ONLY, x11.VIEWABLE, x11._ANY_TYPE, x11._Z_PIXMAP), (2, 2, 0, 2)),
        ((x11._ALL_PLANES, x11._DPMS_ON), (0xFFFFFFFF, 0)),
        ((fullscreen.FRONT, fullscreen.BACK, fullscreen.COLOUR_BIT), (0x0404, 0x0405, 0x4000)),
        ((fullscreen.DITHER, fullscreen.SCISSOR, fullscreen.BGRA), (0x0BD0, 0x0C11, 0x80E1)),
        ((network.LOOPBACK, network.ANY_HOST, network.BROADCAST), ("127.0.0.1", "0.0.0.0", "255.255.255.255")),
        ((network.MAX_DATAGRAM, link.MAX_MESSAGE), (65535, 512)),
        ((ip.VERSION, ip.HEADER_LENGTH, ip.GUID_LENGTH, ip.UNKNOWN_TOTAL), (0x10000, 8, 16, 2**64 - 1)),
        ((ip._NO_DATA_OR_IN, ip._DATA_OUT), (1, 2)),
        ((*ip._PACKETS, *ip.FailReason), (*range(1, 15), 1, 2, 3)),
        ((ptp_usb.HEADER_LENGTH, ptp_usb.UNKNOWN_LENGTH, ptp_usb.HIGH_SPEED_PACKET), (12, 0xFFFFFFFF, 512)),
        ((*ptp_usb.ControlRequest, ptp_usb._CANCELLATION), (0x64, 0x65, 0x66, 0x67, 0x4001)),
        ((protocol.MAX_PARAMETERS, protocol.LAST_TRANSACTION, protocol._ARRAY), (5, 0xFFFFFFFE, 0x4000)),
        ((tiff.RGB, tiff.CFA, tiff.LARGEST_FILE), (2, 32803, 2**32 - 1)),
        ((rawfile._UNCOMPRESSED, rawfile._OLD_JPEG, rawfile._JPEG), (1, 6, 7)),
        ((rawfile._SONY, rawfile._LOSSY_JPEG, rawfile._LINEAR_RAW), (32767, 34892, 34892)),
        (tuple(rawfile._UNSUPPORTED), (8, 32946, 9, 52546)),
    ],
    ids=str,
)
def test_constants_match_published_numbers(ours: tuple[object, ...], published: tuple[object, ...]) -> None:
    assert ours == published
