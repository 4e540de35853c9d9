"""LAB.toml: every mistake is reported with the key, the value and the remedy."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest

from acquisition.run.devices import require_whole_turns
from experiment.config import LabSettings, load_lab, parse_lab
from foundation.errors import ConfigurationError, FormatError
from foundation.secret_texts import target_label
from sim.world.world import Room

MINIMAL = 'rig = "simulated"\nchart = "c/chart.json"\nilluminations = "lights.csv"\n'


def test_paths_are_relative_to_the_file(tmp_path: Path) -> None:
    lab = tmp_path / "LAB.toml"
    lab.write_text(MINIMAL)
    settings = load_lab(lab)
    assert settings.chart == tmp_path.resolve() / "c/chart.json"
    assert settings.illuminations == tmp_path.resolve() / "lights.csv"


def test_sensitivities_are_relative_to_the_file(tmp_path: Path) -> None:
    lab = tmp_path / "LAB.toml"
    text = '[simulated]\nbody = "mine.json"\ncamera = { sensitivities = "other.JSON", iso = 100 }\n'
    lab.write_text(MINIMAL + text)
    simulated = load_lab(lab).simulated
    assert simulated.body == str(tmp_path.resolve() / "mine.json")
    assert simulated.camera == {"sensitivities": str(tmp_path.resolve() / "other.JSON"), "iso": 100}
    for name in ("EOS 6D Mark II", "Canon_EOS-1Ds_Mark_III"):
        lab.write_text(MINIMAL + f'[simulated]\nbody = "{name}"\n')
        assert load_lab(lab).simulated.body == name
    (tmp_path / "curves").touch()
    lab.write_text(MINIMAL + '[simulated]\nbody = "curves"\n')
    assert load_lab(lab).simulated.body == str(tmp_path.resolve() / "curves")


def test_defaults_match_the_documentation() -> None:
    text = (Path(__file__).parents[2] / "docs/lab.md").read_text(encoding="utf-8").split("```")[1].removeprefix("toml")
    top, *sections = text.split("\n[")
    assert len(sections) == 12
    for section in sections:
        name = section.partition("]")[0]
        if name not in ("simulated.room", "simulated.camera"):
            assert parse_lab(f"{top}\n[{section}", "LAB.toml") == parse_lab(top, "LAB.toml"), name
            # Keys that are not in the list have no value.
            documented = set(re.findall(r"^(?:# )?(\w+) =", section, re.MULTILINE)) | set(re.findall(r"\w+", section))
            defaults: dict[str, Any] = attrgetter(name)(parse_lab(top, "LAB.toml")).model_dump()
            assert {key for key, value in defaults.items() if value not in (None, {}, ())} <= documented, name
    room: dict[str, Any] = parse_lab(text.split("[simulated.camera]")[0], "LAB.toml").simulated.room
    assert Room(**room) == Room()
    # The port of PTP/IP, as IANA has it.
    assert parse_lab(top, "LAB.toml").lab.camera.port == 15740


@pytest.mark.parametrize(
    ("section", "key", "lowest", "highest", "outside"),
    [
        ("camera", "iso", 1, 10**6, (0,)),
        ("camera", "shutter_s", 1e-4, 1e4, (0.0,)),
        ("camera", "aperture", 0.01, 1e4, (0.0,)),
        ("sequence", "settle_s", 0.0, 1e4, (-0.1,)),
        ("sequence", "reference_every", 1, 10**6, (0,)),
        ("sequence", "attempts", 1, 20, (0, 21)),
        ("sequence", "patience_s", 0.0, math.inf, (-0.1,)),
        ("sequence", "seed", 0, 10**9, (-1,)),
        ("sequence", "refused_gb", 1e-3, math.inf, (0.0,)),
        ("judge", "moved_px", 0.0, 1e4, (-0.1,)),
        ("simulated", "seed", 0, 10**9, (-1,)),
        ("lab.camera", "port", 1, 65535, (0, 65536)),
        ("lab.camera", "event_port", 1, 65535, (0, 65536)),
        ("lab.projector", "port", 1, 65535, (0, 65536)),
        ("lab.projector", "baud", 300, 10**6, (299,)),
        ("lab.projector", "refresh_hz", 0.01, 1e4, (0.0,)),
        ("lab.projector", "colour_wheel_hz", 0.0, 1e4, (-0.1,)),
    ],
)
def test_numbers_are_accepted_up_to_their_limits(
    section: str, key: str, lowest: float, highest: float, outside: tuple[float, ...]
) -> None:
    for value in (lowest, highest):
        settings = parse_lab(f"{MINIMAL}[{section}]\n{key} = {value}\n", "LAB.toml")
        assert attrgetter(f"{section}.{key}")(settings) == value
    for value in outside:
        with pytest.raises(ConfigurationError, match=rf"{section}\.{key} = {value}"):
            parse_lab(f"{MINIMAL}[{section}]\n{key} = {value}\n", "LAB.toml")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (MINIMAL + "[camera]\naperture = 0\n", "camera.aperture = 0: expected an f-number above 0"),
        (MINIMAL + "[camera]\nshuter_s = 1\n", "unknown key 'camera.shuter_s'; did you mean 'shutter_s'?"),
        (MINIMAL + "[sequence]\npatience_s = nan\n", "sequence.patience_s = nan"),
        (MINIMAL + "[sequence]\norder = 'random'\n", "sequence.order = 'random'"),
        (MINIMAL.replace('chart = "c/chart.json"\n', ""), "chart is missing"),
        (MINIMAL.replace("simulated", "labor"), "expected one of 'lab', 'simulated'"),
        (MINIMAL + "[citation]\nauthors = 'Ban, N.'\n", 'in square brackets: ["Ban, N."]'),
        (MINIMAL + "[lab.projector]\nhost = '/dev/ttyUSB0'\n", "a serial port, expected an address"),
        (MINIMAL + "[lab.camera]\nhost = 'http://1.2.3.4/'\n", "without http://"),
        (MINIMAL + "[lab.camera]\nhost = '1.2.3.4:80'\n", 'host = "1.2.3.4" and port = 80'),
        (MINIMAL + '[camera]\niso = "ISO"', "camera.iso = 'ISO': expected a whole number"),
        (MINIMAL + "[camera]\nshutter_s = 0", "expected a number above 0"),
        (MINIMAL + '[sequence]\npatience_s = "for ever"', 'expected a number of seconds, or "forever"'),
        (MINIMAL + "[lab.projector]\npassword = 1234", 'password = …: expected a text, in quotation marks: "…"'),
        (MINIMAL.replace('"c/chart.json"', "3"), 'chart = 3: expected a text, in quotation marks: "3"'),
        (MINIMAL + "[lab.camera]\nserial = 1234", 'serial = 1234: expected a text, in quotation marks: "1234"'),
        (
            MINIMAL + "[lab.light]\ndisplay = 1.5",
            'display = 1.5: expected a text, in quotation marks: "1.5", or a',
        ),
        ("rig = ", "is not TOML"),
    ],
)
def test_names_a_mistake(text: str, expected: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        parse_lab(text, "LAB.toml")
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_reports_all_mistakes_together() -> None:
    with pytest.raises(ConfigurationError) as caught:
        parse_lab('rig = "labor"\n[camera]\niso = "a"\nshuter_s = 1\n[lab.projector]\npassword = 7\n', "LAB.toml")
    head, *mistakes = str(caught.value).splitlines()
    assert "6 mistakes" in head
    for key in ("rig", "chart", "illuminations", "camera.iso", "camera.shuter_s", "lab.projector.password = …"):
        assert sum(key in mistake for mistake in mistakes) == 1
    assert caught.value.__cause__ is None


def test_hides_a_wrong_line_with_a_secret() -> None:
    for line in ("password = s3cret", "password = 12,5s3cret"):
        with pytest.raises(ConfigurationError) as caught:
            parse_lab(MINIMAL + f"[lab.projector]\n{line}\n", "LAB.toml")
        assert "s3cret" not in str(caught.value)


@pytest.mark.parametrize(("encoding", "message"), [("latin-1", "line 2 has the byte 0xe9"), ("utf-16", "in UTF-16")])
def test_names_another_encoding_with_a_remedy(tmp_path: Path, encoding: str, message: str) -> None:
    lab = tmp_path / "LAB.toml"
    lab.write_bytes(f"\n# papier glacé\n{MINIMAL}".encode(encoding))
    with pytest.raises(FormatError, match=message) as caught:
        load_lab(lab)
    assert "UTF-8" in caught.value.remedy


@pytest.mark.parametrize("text", ["inf", '"Forever"'])
def test_patience_can_be_unlimited(text: str) -> None:
    settings = parse_lab(MINIMAL + f"[sequence]\npatience_s = {text}\n", "LAB.toml")
    assert settings.sequence.patience_s == math.inf
    assert parse_lab(settings.to_toml(), "session.toml").sequence.patience_s == math.inf


@pytest.mark.parametrize(
    ("target", "label"),
    [
        ("", ""),
        ("https://ntfy.example:8443/s3cret?auth=s3cret#s3cret", "https://ntfy.example:8443/…"),
        ("HTTPS://s3cret:s3cret@ntfy.example", "https://ntfy.example/…"),
        ("http://[::1]:80/s3cret", "http://[::1]:80/…"),
        ("curl -H 'Authorization: s3cret' https://x", "curl …"),
        ("/opt/lab/notify", "/opt/lab/notify"),
        ("'/opt/my lab/notify' s3cret", "/opt/my lab/notify …"),
    ],
)
def test_session_contains_no_secret(target: str, label: str) -> None:
    settings = LabSettings.model_validate(
        {
            "rig": "lab",
            "chart": "c",
            "illuminations": "i",
            "sequence": {"notify": target},
            "notify": {"alive": target},
            "lab": {"projector": {"control": "pjlink", "host": "h", "password": "s3cret"}},
        }
    )
    assert target_label(target) == label
    assert "s3cret" not in settings.to_toml()
    assert "s3cret" not in repr(settings)
    assert parse_lab(settings.to_toml(), "session.toml").sequence.notify == label


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ('notify = "curl \'s3cret"', "sequence.notify = …: No closing quotation"),
        ('notify = "https:///s3cret"', "the URL has no host"),
        ('notify = "https://s3cret:99999/"', "sequence.notify = …: Port out of range"),
        ('notify = "https://x/s3cret word"', "the URL has spaces"),
        ('notify = ["s3cret"]', "sequence.notify = …: expected a text"),
    ],
)
def test_names_a_mistake_without_the_secret(line: str, expected: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        parse_lab(MINIMAL + f"[sequence]\n{line}\n", "LAB.toml")
    assert expected in str(caught.value)
    assert "s3cret" not in str(caught.value)
    assert caught.value.__cause__ is None


def test_refuses_folder_with_a_remedy(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError) as told:
        load_lab(tmp_path)
    assert told.value.remedy == f"give {tmp_path / 'LAB.toml'}"


def test_names_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"nowhere\.toml"):
        load_lab(tmp_path / "nowhere.toml")


@pytest.mark.parametrize("name", ["simulated.toml", "lab.toml"])
def test_reads_the_templates(name: str) -> None:
    settings = load_lab(Path(__file__).parents[2] / "acquisition" / "data" / name)
    require_whole_turns(settings.camera, settings.lab.projector)


REAL = (
    MINIMAL.replace("simulated", "lab")
    + """
[lab.projector]
control = "pjlink"
host = "h"
"""
)


@pytest.fixture
def lab_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Return a function that writes a LAB.toml next to files with secrets."""
    monkeypatch.setenv("PJLINK", "s3cret-env")
    monkeypatch.delenv("NOWHERE", raising=False)
    (tmp_path / "word.txt").write_bytes(b"\xef\xbb\xbf s3cret-file \r\nsecond line\n")
    (tmp_path / "empty.txt").write_text("\ns3cret")
    (tmp_path / "binary").write_bytes(b"\xff\xfes3cret")
    os.mkfifo(tmp_path / "pipe")

    def make(line: str, text: str = REAL) -> Path:
        path = tmp_path / "LAB.toml"
        path.write_text(text + line + "\n")
        return path

    return make


@pytest.mark.parametrize(
    ("line", "secret"),
    [
        ('password = "s3cret-key"', "s3cret-key"),
        ('password = { env = "PJLINK" }', "s3cret-env"),
        ('password = { file = "word.txt" }', "s3cret-file"),
    ],
)
def test_reads_a_secret_from_its_source(lab_with: Callable[..., Path], line: str, secret: str) -> None:
    settings = load_lab(lab_with(line))
    assert settings.lab.projector.password == secret
    assert "s3cret" not in settings.to_toml()
    assert "s3cret" not in repr(settings)
    notify = REAL + "[sequence]\n" + line.replace("password", "notify")
    assert load_lab(lab_with("", notify)).sequence.notify == secret


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ('{ env = "NOWHERE" }', "NOWHERE"),
        ('{ file = "gone.txt" }', "gone.txt: No such file"),
        ('{ file = "empty.txt" }', "empty.txt is empty"),
        ('{ file = "binary" }', "binary: it is not text"),
        ('{ file = "pipe" }', "pipe is not a file; give a file"),
        ('{ env = "PJLINK", file = "word.txt" }', "expected only the text itself"),
        ("{ env = 3 }", "expected only the text itself"),
        ("{}", "expected only the text itself"),
    ],
)
def test_names_a_missing_secret(lab_with: Callable[..., Path], source: str, expected: str) -> None:
    with pytest.raises(ConfigurationError, match=rf"lab\.projector\.password: .*{expected}") as caught:
        load_lab(lab_with(f"password = {source}"))
    assert "s3cret" not in str(caught.value)


def test_names_all_missing_secrets_together(lab_with: Callable[..., Path]) -> None:
    sequence = '[sequence]\nnotify = { file = "gone.txt" }\n[notify]\nalive = { env = "PJLINK" }'
    with pytest.raises(ConfigurationError, match="2 mistakes") as caught:
        load_lab(lab_with(f'password = {{ env = "NOWHERE" }}\n{sequence}'))
    _, *mistakes = str(caught.value).splitlines()
    assert [mistake.split(":")[0].strip() for mistake in mistakes] == ["sequence.notify", "lab.projector.password"]
    assert "s3cret" not in str(caught.value)


def test_simulated_rig_needs_no_password(lab_with: Callable[..., Path]) -> None:
    settings = load_lab(lab_with('password = { env = "NOWHERE" }', REAL.replace('"lab"', '"simulated"')))
    assert settings.lab.projector.password is None


@pytest.mark.parametrize("line", ['[lab]\nprojector = "s3cret"', '[[lab.projector]]\npassword = "s3cret"'])
def test_hides_a_table_with_a_secret(line: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        parse_lab(MINIMAL + line, "LAB.toml")
    assert "s3cret" not in str(caught.value)
    assert caught.value.__cause__ is None


def test_accepts_a_byte_order_mark(tmp_path: Path) -> None:
    """Notepad starts a file with the byte order mark of UTF-8."""
    text = 'rig = "simulated"\nchart = "chart.json"\nilluminations = "lights.csv"\n[simulated]\nbody = "Test"\n'
    settings: list[LabSettings] = []
    for mark in (b"", b"\xef\xbb\xbf"):
        (tmp_path / "LAB.toml").write_bytes(mark + text.encode())
        settings.append(load_lab(tmp_path / "LAB.toml"))
    assert settings[0] == settings[1]
