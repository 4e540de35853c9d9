"""Other people's initiators on the simulated camera and projector: clients that share nothing with ours.

ptpy lists and fetches what is on the card. libpict (C) reads the events of an EOS and a frame; atotto/ptpip (Go) opens
both connections and a session; tmshort/pjlink-go (Go) asks a projector and lights it. The last three are in no package
index: their tests run where clones of them lie in the folder that CROP_FOREIGN names (libpict, ptpip, pjlink-go), and a
compiler is there; tried with libpict a2babff7a, ptpip 13101e37b and pjlink-go bc14387d4.

vcam (petabyt/vcam, C) holds what an EOS 1300D answered when first asked for events, and what its author's own
reader made of it; ours is held against that (tried with 47260ba). As a responder it takes no frame and tells no change:
it is no peer beyond being refused.

ptpy 0.3.2 asks for construct 2.8.8, with which its PTP/IP does not work; with 2.8.12 it does. So it is in no extra:
continuous integration installs both (`.ci/run`). Its Canon extension divides record sizes by `/`, as Python 2 did, and
reads no events on Python 3; so it is used as any still camera's initiator.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.camera import ExposureSettings
from drivers.canon import EosState, decode_events, plan, shutter_speeds
from drivers.projector import Power
from drivers.ptp.codes import Property
from foundation.clock import SimulatedClock
from foundation.errors import DeviceRefused
from sim.buses.ptp import serve_ptpip
from sim.camera.bodies import TEST_BODY
from sim.camera.eos import SimulatedEos
from sim.projectors.pjlink import serve_pjlink
from sim.projectors.projector import SimulatedProjector
from tests.contracts.camera import SeededFilm

pytestmark = pytest.mark.slow

SCRIPT = """
import collections, collections.abc, hashlib, sys
collections.Sequence = collections.abc.Sequence  # construct 2.8 looks for it there
import ptpy
camera = ptpy.PTPy(device=("127.0.0.1", int(sys.argv[1])), transport=ptpy.IP, raw=True)
with camera.session():
    info = camera.get_device_info()
    print(info.Manufacturer, info.Model, "GetPartialObject" in info.OperationsSupported)
    (card,) = camera.get_storage_ids()
    for handle in camera.get_object_handles(card, all_storage_ids=False):
        entry = camera.get_object_info(handle)
        if entry.ObjectFormat != "Association":
            data = camera.get_object(handle).Data
            part = camera.get_partial_object(handle, 1000, 500).Data
            print(entry.Filename, hashlib.sha256(data).hexdigest(), part == data[1000:1500])
"""


@pytest.mark.skipif(importlib.util.find_spec("ptpy") is None, reason="ptpy is not installed, see .ci/run")
def test_ptpy_fetches_the_frames_on_the_card(tmp_path: Path) -> None:
    film, clock = SeededFilm(70_000), SimulatedClock()
    eos = SimulatedEos(TEST_BODY, film, clock, auto_power_off_s=0)
    for _ in range(2):
        eos._full_press()
        clock.sleep(5)
        assert not eos.busy
    with serve_ptpip(eos, 0) as server:
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT, str(server.address[1])],
            cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    head, *frames = done.stdout.splitlines()
    assert head == "Canon Inc. CroP Test True"
    assert frames == [
        f"IMG_{number:04d}{film.suffix.upper()} {hashlib.sha256(data).hexdigest()} True"
        for number, data in enumerate(film.frames, 1)
    ]


def source_of(name: str, compiler: str) -> Path:
    """Return the folder of somebody's source; skip where it, or what compiles it, is not there."""
    source = Path(os.environ.get("CROP_FOREIGN", "")) / name
    if "CROP_FOREIGN" not in os.environ or not source.is_dir():
        pytest.skip(f"no clone of {name} in the folder that CROP_FOREIGN names")
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    return source


def go_program(folder: Path, source: Path, module: str, part: str, text: str) -> Path:
    """Return a program of `text` that uses part of somebody's module, compiled without a network."""
    shutil.copytree(source / part, folder / "module" / part, ignore=shutil.ignore_patterns("*_test.go", ".git", "cmd"))
    (folder / "module" / "go.mod").write_text(f"module {module}\n\ngo 1.21\n")
    (folder / "go.mod").write_text(
        f"module try\n\ngo 1.21\n\nrequire {module} v0.0.0\n\nreplace {module} => ./module\n"
    )
    (folder / "main.go").write_text(text)
    offline = os.environ | {"GOFLAGS": "-mod=mod", "GOPROXY": "off", "GOCACHE": str(folder / "cache")}
    run(["go", "build", "-o", "try", "."], folder, offline)
    return folder / "try"


def run(words: list[str], folder: Path, environment: dict[str, str] | None = None) -> list[str]:
    """Return the lines that a program says, which must end well."""
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    return done.stdout.splitlines()


PTPIP = """
package main

import (
	"fmt"
	"os"

	"github.com/atotto/ptpip"
	"github.com/atotto/ptpip/ptp"
)

func must(err error) {
	if err != nil {
		fmt.Println(err)
		os.Exit(1)
	}
}

func main() {
	config, err := ptpip.NewConfig("0123456789abcdef", "CroP, tried from outside")
	must(err)
	camera, err := ptpip.DialConfig(os.Args[1], config)
	must(err)
	must(camera.OperationSimple(ptp.OC_OpenSession, 0, []uint32{1}))
	must(camera.OperationSimple(ptp.OC_CloseSession, 1, []uint32{}))
	fmt.Println("opened and closed")
}
"""

PJLINK = """
package main

import (
	"fmt"
	"os"

	"github.com/tmshort/pjlink-go/pkg/pjlink"
)

func main() {
	projector := pjlink.NewProjector("127.0.0.1", os.Args[1], os.Args[2])
	before, err := projector.GetPowerStatus()
	if err != nil {
		fmt.Println(err)
		os.Exit(1)
	}
	fmt.Println("power", before.Response)
	fmt.Println("lit", projector.PowerOn())
	after, err := projector.GetPowerStatus()
	fmt.Println("power", after.Response, err)
}
"""

LIBPICT = """
#include <stdio.h>
#include <stdlib.h>
#include <libpict.h>

/* Of its USB, which is left out. */
void ptpusb_free_device_list_entry(void *entry) {}
void ptp_comm_deinit(struct PtpRuntime *r) {}

static void must(int code, const char *what) {
	if (code) { printf("%s: %d\\n", what, code); exit(1); }
}

int main(int argc, char **argv) {
	struct PtpRuntime *r = ptp_new(PTP_IP);
	struct PtpDeviceInfo info;
	struct PtpArray *cards, *handles;
	int port = atoi(argv[1]), i;
	FILE *out = fopen(argv[2], "wb");
	must(ptpip_connect(r, "127.0.0.1", port, 0), "connect");
	must(ptpip_init_command_request(r, "lab"), "init");
	must(ptpip_connect_events(r, "127.0.0.1", port), "connect events");
	must(ptpip_init_events(r), "init events");
	must(ptp_open_session(r), "open");
	must(ptp_get_device_info(r, &info), "info");
	r->di = &info;
	printf("%s %s %d\\n", info.manufacturer, info.model, ptp_device_type(r) == PTP_DEV_EOS);
	must(ptp_get_storage_ids(r, &cards), "cards");
	must(ptp_get_object_handles(r, cards->data[0], PTP_OF_JPEG * 0, 0, &handles), "handles");
	for (i = 0; i < (int)handles->length; i++) {
		struct PtpObjectInfo object;
		must(ptp_get_object_info(r, handles->data[i], &object), "object");
		printf("%s\\n", object.filename);
		if (object.obj_format != PTP_OF_Association) must(ptp_download_object(r, handles->data[i], out, 4096), "fetch");
	}
	fclose(out);
	must(ptp_close_session(r), "close");
	return 0;
}
"""


def test_the_recording_of_a_1300d_is_read_as_another_reader_reads_it() -> None:
    source = source_of("vcam", sys.executable)
    state = EosState()
    state.take(decode_events((source / "bin/eos/eos_events.bin").read_bytes()))
    theirs = {
        int(code, 16): tuple(int(value, 16) for value in re.findall(r"0x[0-9A-F]+", values))
        for values, code in re.findall(
            r"uint32_t avail_list_\w+\[\] = \{(.*?)\};\s+vcam_set_prop_avail\(cam, (0x\w+)",
            (source / "src/canon/props.c").read_text(),
        )
    }
    for code in (Property.EOS_SHUTTER_SPEED, Property.EOS_ISO_SPEED, Property.EOS_DRIVE_MODE):
        assert len(theirs[code]) > 4
        assert state.lists[code] == theirs[code]
    assert len(shutter_speeds(state)) == len(theirs[Property.EOS_SHUTTER_SPEED]) - 1  # of which the first is bulb
    assert (min(shutter_speeds(state)), max(shutter_speeds(state))) == (1 / 4000, 30)
    # It stood on a self-timer, without a lens: both are said before a frame is taken.
    with pytest.raises(DeviceRefused) as refused:
        plan(state, ExposureSettings(400, 5.6, 1 / 30))
    assert "timer" in str(refused.value)
    assert 'aperture = "none"' in str(refused.value)


@pytest.fixture
def card() -> Iterator[tuple[SeededFilm, int]]:
    """Serve a camera with one frame on its card; return its film, and the port."""
    film, clock = SeededFilm(70_000), SimulatedClock()
    eos = SimulatedEos(TEST_BODY, film, clock, auto_power_off_s=0)
    eos._full_press()
    clock.sleep(5)
    with serve_ptpip(eos, 0) as server:
        yield film, server.address[1]


def test_ptpip_in_go_opens_a_session(tmp_path: Path, card: tuple[SeededFilm, int]) -> None:
    source = source_of("ptpip", "go")
    program = go_program(tmp_path, source, "github.com/atotto/ptpip", ".", PTPIP)
    assert run([str(program), f"127.0.0.1:{card[1]}"], tmp_path) == ["opened and closed"]


def test_libpict_fetches_the_frame_on_the_card(tmp_path: Path, card: tuple[SeededFilm, int]) -> None:
    source = source_of("libpict", "gcc") / "src"
    film, port = card
    parts = [
        *("operations", "packet", "enums", "data", "enum_dump", "lib", "canon", "liveview", "ml", "conv", "generic"),
        *("ip", "no_usb", "log", "bind", "canon_adv"),
    ]
    (tmp_path / "main.c").write_text(LIBPICT)
    # It sends over TCP what goes in packets of USB, and panics where they are those of PTP/IP.
    (tmp_path / "transport.c").write_text(
        f'#include <libpict.h>\n#define PTP_IP_USB PTP_IP\n#include "{source}/transport.c"\n'
    )
    files = [str(source / f"{part}.c") for part in parts if (source / f"{part}.c").is_file()]
    run(["gcc", "-w", "-O1", "-o", "try", "-I", str(source), "main.c", "transport.c", *files, "-lpthread"], tmp_path)
    said = run([str(tmp_path / "try"), str(port), str(tmp_path / "frame")], tmp_path)
    assert f"Canon Inc. {TEST_BODY.model} 1" in said
    assert f"IMG_0001{film.suffix.upper()}" in said
    assert (tmp_path / "frame").read_bytes() == film.frames[0]


@pytest.mark.parametrize("password", ["", "JBMIAProjectorLink"])
def test_pjlink_in_go_lights_a_projector(tmp_path: Path, password: str) -> None:
    source = source_of("pjlink-go", "go")
    program = go_program(tmp_path, source, "github.com/tmshort/pjlink-go", "pkg", PJLINK)
    clock = SimulatedClock()
    projector = SimulatedProjector(clock)
    with serve_pjlink(projector, password=password or None) as server:
        said = run([str(program), str(server.address[1]), password], tmp_path)
    assert said == ["power [0]", "lit <nil>", "power [3] <nil>"]
    assert projector.power() is Power.WARMING
