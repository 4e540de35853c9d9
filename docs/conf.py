"""Build the site: prose from docs/, the API reference from docstrings, command pages from `--help`."""

import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.domains.python import PyXRefRole
from typer.main import get_command

from croplab import COMMANDS
from docs import gallery

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))

project = "CroP"
version = release = PROJECT["project"]["version"]
project_copyright = "the authors of CroP"

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3

html_theme = "furo"
html_title = f"CroP {version}"
html_copy_source = False
# Browsers do not let a page from the disk read other pages, so a search can show titles only.
html_show_search_summary = False
html_static_path = ["static"]
html_css_files = ["site.css"]
html_theme_options = {"navigation_with_keys": True}

default_role = "name"
napoleon_google_docstring = False
napoleon_use_ivar = True
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
# Docstrings also name internal modules, which have no page.
suppress_warnings = ["ref.python"]


class NameRole(PyXRefRole):
    """Text in single backticks: a link if it is a dotted name or a class name, else plain code.

    Parameters are in backticks too. They must not become links to attributes of the same name.
    """

    def run(self) -> tuple[list[nodes.Node], list[nodes.system_message]]:
        """Return the link or the code."""
        if not re.fullmatch(r"[A-Z]\w*[a-z]\w*|\w+(\.\w+)+", self.text):
            return [nodes.literal(self.rawtext, self.text)], []
        self.name = "py:obj"
        return super().run()


def print_help(words: list[str]) -> str:
    """Run a command with --help and return its output."""
    code = f"import sys; from {COMMANDS[words[0]]} import main; sys.argv = {[*words, '--help']!r}; sys.exit(main())"
    settings = os.environ | {"COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1", "PYTHONPATH": str(ROOT)}
    run = subprocess.run([sys.executable, "-c", code], env=settings, capture_output=True, text=True, check=True)
    return "\n".join(line.rstrip() for line in run.stdout.strip("\n").splitlines())


def command_words(name: str, command: Any) -> Iterator[list[str]]:
    """Yield the words of a command and of each of its subcommands, at any depth."""
    yield [name]
    for subcommand_name, subcommand in getattr(command, "commands", {}).items():
        yield from ([name, *words] for words in command_words(subcommand_name, subcommand))


def write_commands(app: Sphinx) -> None:
    """Write one page for each command with the help of all its subcommands."""
    folder = Path(app.srcdir) / "reference" / "commands"
    folder.mkdir(parents=True, exist_ok=True)
    for command, module in COMMANDS.items():
        print(f"help of {command}", flush=True)
        calls = list(command_words(command, get_command(import_module(module).app)))
        with ThreadPoolExecutor() as pool:
            helps = list(pool.map(print_help, calls))
        sections = [
            f"{'#' * len(words)} {' '.join(words)}\n\n```text\n{text}\n```\n"
            for words, text in zip(calls, helps, strict=True)
        ]
        (folder / f"{command}.md").write_text("\n".join(sections), encoding="utf-8")


def make_gallery(_: Sphinx) -> None:
    """Run the commands of the gallery page."""
    print("pictures of the gallery", flush=True)
    gallery.make()


def setup(app: Sphinx) -> None:
    """Register the role and the generated pages."""
    app.add_role("name", NameRole())
    app.connect("builder-inited", write_commands)
    app.connect("builder-inited", make_gallery)
