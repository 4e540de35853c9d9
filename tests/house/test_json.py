"""`--json` prints one object as described in docs/reference/json.md, and nothing else."""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.main import get_command

from croplab import COMMANDS
from foundation.console import JsonOutput, json_output, json_value, with_json
from foundation.errors import QualityError
from tests.json_of import json_of

# Commands that write or serve something and have no figures.
WITHOUT_FIGURES = {
    "acquire init",
    "acquire rebuild",
    "acquire monitor",
    "acquire report",
    "generate explore",
    "sim projector",
    "sim camera",
}

REFERENCE = Path(__file__).parents[2] / "docs/reference/json.md"


def leaves(words: tuple[str, ...], command: Any) -> Iterator[tuple[str, Any]]:
    """Yield every command that does something itself, with its words."""
    subcommands = getattr(command, "commands", {})
    if not subcommands or any(parameter.param_type_name == "argument" for parameter in command.params):
        yield " ".join(words), command
    for name, subcommand in subcommands.items():
        yield from leaves((*words, name), subcommand)


LEAVES = dict(leaf for name, room in COMMANDS.items() for leaf in leaves((name,), get_command(import_module(room).app)))


def reference_sections() -> dict[str, str]:
    """Return the section of the reference for each command."""
    parts = re.split(r"^## (.*)$", REFERENCE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {title.strip("`"): text for title, text in zip(parts[1::2], parts[2::2], strict=True)}


@pytest.mark.parametrize("name", LEAVES)
def test_commands_with_figures_have_json_and_reference(name: str) -> None:
    has_json = any("--json" in option.opts for option in LEAVES[name].params)
    assert has_json == (name not in WITHOUT_FIGURES)
    assert (name in reference_sections()) == has_json


def test_reference_has_no_other_commands() -> None:
    assert set(reference_sections()) == set(LEAVES) - WITHOUT_FIGURES


class TestOutput:
    def test_sends_text_to_stderr(self, capsys: pytest.CaptureFixture[str]) -> None:
        with json_output("generate", is_requested=True) as output:
            print("for a reader")
            output.add(
                images=3, share=math.nan, most=math.inf, place=Path("a"), levels=np.arange(2), mean=np.float32(0.5)
            )
            output.append("notes", "é")
        printed = capsys.readouterr()
        assert json.loads(printed.out) == {
            **{"command": "generate", "images": 3, "share": None, "most": None, "place": "a", "levels": [0, 1]},
            **{"mean": 0.5, "notes": ["é"]},
        }
        assert printed.err == "for a reader\n"

    def test_changes_nothing_without_option(self, capsys: pytest.CaptureFixture[str]) -> None:
        with json_output("generate", is_requested=False) as output:
            print("for a reader")
            output.add(images=3)
        assert capsys.readouterr().out == "for a reader\n"

    def test_prints_figures_of_refused_data(self, capsys: pytest.CaptureFixture[str]) -> None:
        with pytest.raises(QualityError):
            _refuse(faults=["a"])
        assert json.loads(capsys.readouterr().out) == {"command": "build-lut", "faults": ["a"]}
        with pytest.raises(QualityError):
            _refuse()
        assert capsys.readouterr().out == ""

    def test_requires_parameter_for_output(self) -> None:
        with pytest.raises(ValueError, match="JsonOutput"):
            with_json("x")(lambda: None)

    def test_restores_standard_output(self) -> None:
        before = sys.stdout
        with json_output("x", is_requested=True):
            pass
        assert sys.stdout is before

    def test_converts_values_to_json(self) -> None:
        assert json_value(JsonOutput) == str(JsonOutput)
        assert json_value({1: {2.5}}) == {"1": [2.5]}


def _refuse(**figures: Any) -> None:
    with json_output("build-lut", is_requested=True) as output:
        output.add(**figures)
        raise QualityError("bad")


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a small computed LUT `lut`, pictures, and a data set `set` of 12 images."""
    folder = tmp_path_factory.mktemp("json")
    (folder / "pictures").mkdir()
    for number in range(6):
        coarse = np.random.default_rng(number).integers(0, 256, (4, 5, 3)).astype(np.uint8)
        cv2.imwrite(str(folder / f"pictures/{number}.png"), cv2.resize(coarse, (60, 48), interpolation=cv2.INTER_CUBIC))
    (folder / "table.toml").write_text("[chart]\nbits = 2\n")
    table = ["table", str(folder / "lut"), "--settings", str(folder / "table.toml"), "--lights", "D65,A,FL2,7500K"]
    assert main_of("sim")(table) == 0
    options = ["--sources", str(folder / "pictures"), "--random", "2"]
    assert main_of("generate")([str(folder / "lut"), str(folder / "set"), *options]) == 0
    return folder


def main_of(command: str) -> Any:
    return import_module(COMMANDS[command]).main


CALLS: dict[str, tuple[str, dict[str, Any]]] = {
    "acquire chart": ("OUT/chart --bits 1 --no-tiff", {"colours": 8}),
    "acquire illuminations": ("OUT/lights.csv --grid 2 --blackbodies 5000", {"lights": 7}),
    "build-lut info": ("MADE/lut", {"lights": 4, "colours": 64, "samples": 25}),
    "build-lut verify": ("MADE/lut", {"faults": []}),
    "build-lut match": ("MADE/lut MADE/lut", {"match": True}),
    "build-lut publish": ("MADE/lut OUT/published", {"lights": 4}),
    "sim table": ("OUT/lut --settings MADE/table.toml --lights D65", {"lights": 1, "colours": 64}),
    "generate": ("MADE/lut OUT/set --sources MADE/pictures", {"images": 6, "made": True, "skipped": []}),
    "generate again": ("MADE/lut MADE/set --sources MADE/pictures --random 2", {"images": 12, "made": False}),
    "generate --verify": ("MADE/set", {"faults": [], "images": 12}),
    "evaluate run": ("MADE/set --method gray-world", {"data_set": "set", "images": 12}),
    "evaluate cv": ("constant-light MADE/set --folds 2", {"folds": 2, "images": 12}),
    "evaluate train": ("constant-light MADE/set --out OUT/model.npz", {"images": 12, "unused": 0}),
    "evaluate tune": ("shades-of-gray MADE/set", {"images": 12, "family": "shades-of-gray"}),
    "evaluate paper bits": ("MADE/set --sigma 1", {}),
    "evaluate paper reduction": ("MADE/pictures/0.png", {}),
    "evaluate paper chromaticities": ("MADE/lut", {}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CALLS)
def test_prints_one_object_with_documented_keys(
    name: str, prepared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = name.removesuffix(" again").split()
    text, expected = CALLS[name]
    arguments = [word.replace("MADE", str(prepared)).replace("OUT", str(tmp_path)) for word in text.split()]
    output = json_of(main_of(words[0]), [*words[1:], *arguments], capsys)
    command = " ".join(word for word in words if not word.startswith("--"))
    assert output["command"] == command
    assert {key: output[key] for key in expected} == expected
    section = reference_sections()[command]
    assert {key for key in output if key != "command" and f"`{key}`" not in section} == set()


@pytest.mark.slow
def test_prints_comparison(prepared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    evaluate = main_of("evaluate")
    data, results = str(prepared / "set"), tmp_path / "results"
    assert evaluate(["run", data, "--method", "gray-world,white-patch", "--out", str(results)]) == 0
    compared = json_of(evaluate, ["compare", results], capsys)
    assert len(compared["verdicts"]) == 1
    assert [len(table["rows"]) > 0 for table in compared["tables"]] == [True] * 3
    rows = compared["tables"][0]["rows"]
    assert set(rows[0]) == set(compared["tables"][0]["columns"])
    section = reference_sections()["evaluate compare"]
    assert {key for key in compared if key != "command" and f"`{key}`" not in section} == set()


@pytest.mark.slow
def test_prints_faults(prepared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--random-scenes", "2:20x20"]
    output = json_of(main_of("generate"), [prepared / "lut", tmp_path / "set", *options, "--shard-images", "1"], capsys)
    assert output["splits"] == {}
    (tmp_path / "set/images/000001.png").write_bytes(b"")
    (fault,) = json_of(main_of("generate"), ["--verify", tmp_path / "set"], capsys, code=4)["faults"]
    assert "000001.png" in fault
