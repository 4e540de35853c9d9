"""How `make docs` builds the site: prose from docs/, the reference from docstrings and from the commands' help.

Name, version, packages and commands are read from pyproject.toml. The docstrings are read from the source, nothing is
imported for them; only the pages of the commands run the commands, with --help.
"""

import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
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
PACKAGES = PROJECT["tool"]["importlinter"]["root_packages"]

project = "CroP"
version = release = PROJECT["project"]["version"]
project_copyright = "the authors of CroP"

extensions = ["myst_parser", "sphinx.ext.napoleon", "autoapi.extension"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3

html_theme = "furo"
html_title = f"CroP {version}"
html_copy_source = False
# A search shows titles alone: a page that is opened from a disk may not read the others for their first lines.
html_show_search_summary = False
html_static_path = ["static"]
html_css_files = ["site.css"]
html_theme_options = {"navigation_with_keys": True}

# The contents of every page stand beside it already; in the tree of all pages its objects cost minutes.
toc_object_entries = False
default_role = "name"
napoleon_google_docstring = False
napoleon_use_ivar = True
autodoc_typehints = "description"
autoapi_dirs = [str(ROOT / package) for package in PACKAGES]
autoapi_root = "reference/api"
autoapi_add_toctree_entry = False
autoapi_member_order = "bysource"
autoapi_options = ["members", "undoc-members", "show-inheritance", "show-module-summary"]
# Names that one statement assigns together, as I8, I16 = ..., are not found by autoapi; they are shown without a link.
suppress_warnings = ["ref.python", "autoapi.python_import_resolution"]


class NameRole(PyXRefRole):
    """What docstrings put in single backticks: a link where it is a dotted or a class name, else plain code.

    A parameter's name stands in backticks too and must not become a link to some attribute of the same name.
    """

    def run(self) -> tuple[list[nodes.Node], list[nodes.system_message]]:
        """Return the link or the code."""
        if not re.fullmatch(r"[A-Z]\w*[a-z]\w*|\w+(\.\w+)+", self.text):
            return [nodes.literal(self.rawtext, self.text)], []
        self.name = "py:obj"
        return super().run()


def help_of(module: str, words: list[str]) -> str:
    """Return what a command prints when asked for help."""
    code = f"import sys; from {module} import main; sys.argv = {words!r}; sys.exit(main())"
    settings = os.environ | {"COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], env=settings, capture_output=True, text=True, check=True)
    return "\n".join(line.rstrip() for line in done.stdout.strip("\n").splitlines())


def words_of(name: str, command: Any) -> Iterator[list[str]]:
    """Yield the words that call a command and each one below it, at any depth."""
    yield [name]
    for below, found in getattr(command, "commands", {}).items():
        yield from ([name, *words] for words in words_of(below, found))


def write_commands(app: Sphinx) -> None:
    """Write the pages of the commands: the help of each and of all below it."""
    folder = Path(app.srcdir) / "reference" / "commands"
    folder.mkdir(parents=True, exist_ok=True)
    for command, module in COMMANDS.items():
        parts: list[str] = []
        for words in words_of(command, get_command(import_module(module).app)):
            text = help_of(module, [*words, "--help"])
            parts += [f"{'#' * len(words)} {' '.join(words)}\n", f"```text\n{text}\n```\n"]
        (folder / f"{command}.md").write_text("\n".join(parts), encoding="utf-8")


def make_gallery(_: Sphinx) -> None:
    """Make the pictures and reports of the gallery by the commands of its page."""
    gallery.make()


def keep_modules_out_of_the_tree(_: Sphinx, page: str, source: list[str]) -> None:
    """Let the tree of all pages name packages and rooms only; a room's page lists its modules.

    With each of the modules in it, the tree is too long to read and costs most of the time of a build.
    """
    if not page.startswith(f"{autoapi_root}/"):
        return
    place = ROOT.joinpath(*page.removeprefix(f"{autoapi_root}/").split("/")[:-1])
    if not place.is_dir():
        source[0] = ":orphan:\n\n" + source[0]
    rooms: list[str] = []
    modules: list[str] = []
    for name in re.findall(rf"^   /{autoapi_root}/(.*)/index$", source[0], re.MULTILINE):
        (rooms if (ROOT / name).is_dir() else modules).append(name)
    named = "".join(f"   /{autoapi_root}/{name}/index\n" for name in rooms)
    listed = "".join(f"* :doc:`/{autoapi_root}/{name}/index`\n" for name in modules)
    tree = f".. toctree::\n   :maxdepth: 1\n\n{named}\n" if rooms else ""
    both = r"^\.\. toctree::\n   :maxdepth: 1\n+(   /.*\n+)+"
    source[0] = re.sub(both, f"{tree}{listed}\n", source[0], flags=re.MULTILINE)


def setup(app: Sphinx) -> None:
    """Register the role and the pages."""
    app.add_role("name", NameRole())
    app.connect("builder-inited", write_commands)
    app.connect("builder-inited", make_gallery)
    app.connect("source-read", keep_modules_out_of_the_tree)
