"""Draw the figures of docs/architecture.md from import contracts, imports and the table of states.

`python docs/figures.py` writes docs/images/rooms.svg and docs/images/step.svg. `tests/house/test_figures.py` compares
the files with the output.
"""

from __future__ import annotations

import ast
import sys
import tomllib
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import grimp

from croplab import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"

INK, GREY, LINE, PAPER, BOX, WALL = "#1f2933", "#52606d", "#7b8794", "#ffffff", "#eef2f6", "#b42318"
FONT = "font-family='Helvetica, Arial, sans-serif'"
ROW, BOX_HEIGHT, GAP = 44, 26, 14
BAND_WIDTH, DATA_LEFT, WIDTH = 740, 790, 1010

# Data that each package makes, in the direction of the data flow upwards; `foundation` has no data of its own.
DATA = {
    "evaluation": ("errors of methods, tables",),
    "generator": ("dataset/: raw images, ground truth",),
    "calibration": ("lut/: samples of every colour, ground truth",),
    "acquisition": ("session/: raw frames, journal", "chart/, illuminations.csv"),
    "sim": ("a room, a print, a sensor",),
    "drivers": ("camera, projector, display: bytes on cables, raw files",),
}

# The package that replaces hardware; it is drawn next to the data flow.
SIMULATED = "sim"


@dataclass(frozen=True)
class Plan:
    """Structure of the packages as in `pyproject.toml` and the source.

    Attributes
    ----------
    packages
        packages from the highest layer to the lowest
    forbidden
        for each package, the modules that a contract forbids
    excepted
        for each package, its modules that are exempt
    layers
        for each package, its rooms from the highest row to the lowest, if a contract defines them
    commands
        for each package, its console commands
    imports
        for each room, the rooms that it imports; a room is a sub-package or a top-level module of a package
    """

    packages: tuple[str, ...]
    forbidden: Mapping[str, Set[str]]
    excepted: Mapping[str, Set[str]]
    layers: Mapping[str, Sequence[Set[str]]]
    commands: Mapping[str, Sequence[str]]
    imports: Mapping[str, Set[str]]

    def rooms(self, package: str) -> list[str]:
        """Return the rooms of a package in alphabetical order."""
        return sorted(room for room in self.imports if room.startswith(f"{package}."))


def read_plan() -> Plan:
    """Read the structure from `pyproject.toml` and the source."""
    project: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts: list[dict[str, Any]] = project["tool"]["importlinter"]["contracts"]
    roots: list[str] = project["tool"]["importlinter"]["root_packages"]
    tower = next(rule["layers"] for rule in contracts if rule["type"] == "layers" and set(rule["layers"]) == set(roots))
    layers = {
        container: [{f"{container}.{room.strip()}" for room in layer.split("|")} for layer in rule["layers"]]
        for rule in contracts
        if rule["type"] == "layers"
        for container in rule.get("containers", ())
    }
    forbidden: dict[str, set[str]] = {package: set() for package in roots}
    excepted: dict[str, set[str]] = {package: set() for package in roots}
    for rule in (rule for rule in contracts if rule["type"] == "forbidden"):
        for package in set(rule["source_modules"]) & set(roots):
            forbidden[package] |= set(rule["forbidden_modules"])
        for ignored in rule.get("ignore_imports", ()):
            module = ignored.split(" -> ")[0].removesuffix(".**")
            excepted[module.split(".")[0]].add(module)
    commands: dict[str, list[str]] = {package: [] for package in roots}
    for command, location in COMMANDS.items():
        commands[location.split(".")[0]].append(command)
    graph = grimp.build_graph(*roots, cache_dir=None)
    imports: dict[str, set[str]] = {}
    for module in graph.modules:
        room = room_of(module)
        imported = {room_of(name) for name in graph.find_modules_directly_imported_by(module)}
        imports[room] = imports.get(room, set()) | imported - {room}
    return Plan(tuple(tower), forbidden, excepted, layers, commands, imports)


def room_of(module: str) -> str:
    """Return the room of a module: the first two parts of its name."""
    return ".".join(module.split(".")[:2])


def reach(imports: Mapping[str, Set[str]], room: str) -> set[str]:
    """Return the rooms that a room imports directly or indirectly."""
    reached, queue = set[str](), [room]
    while queue:
        for imported in imports.get(queue.pop(), ()):
            if imported not in reached:
                reached.add(imported)
                queue.append(imported)
    return reached


def rows_of(plan: Plan, package: str) -> dict[str, int]:
    """Return the row of each room, 0 at the bottom: from its contract or from the imports."""
    if package not in plan.layers:
        return heights(plan.rooms(package), plan.imports)
    rows = {room: row for row, layer in enumerate(reversed(plan.layers[package])) for room in layer}
    unmatched = set(plan.rooms(package)) ^ set(rows)
    if unmatched:
        raise ValueError(f"layers and rooms of {package} differ: {', '.join(sorted(unmatched))}")
    return rows


def heights(rooms: Sequence[str], imports: Mapping[str, Set[str]]) -> dict[str, int]:
    """Return the row of each room, 0 at the bottom: above all its imports; rooms in an import cycle share a row."""
    inside = {room: set(imports[room]) & set(rooms) for room in rooms}
    below = {room: {other for other in reach(inside, room) if room not in reach(inside, other)} for room in rooms}
    rows: dict[str, int] = {}
    for room in sorted(rooms, key=lambda room: (len(below[room]), room)):
        rows[room] = max((rows[other] + 1 for other in below[room]), default=0)
    return {room: max(rows[other] for other in rooms if other == room or cyclic(inside, other, room)) for room in rooms}


def cyclic(imports: Mapping[str, Set[str]], first: str, second: str) -> bool:
    """Return whether two rooms import each other, directly or indirectly."""
    return second in reach(imports, first) and first in reach(imports, second)


def shown_imports(rooms: Sequence[str], imports: Mapping[str, Set[str]]) -> list[tuple[str, str]]:
    """Return the imports among rooms, without those implied by others."""
    inside = {room: set(imports[room]) & set(rooms) for room in rooms}
    return [
        (room, target)
        for room in rooms
        for target in sorted(inside[room])
        if cyclic(inside, room, target)
        or not any(
            target in reach(inside, via) and not cyclic(inside, target, via) and not cyclic(inside, room, via)
            for via in inside[room] - {target}
        )
    ]


def text(
    x: float, y: float, words: str, size: int = 12, fill: str = INK, anchor: str = "start", bold: bool = False
) -> str:
    """Return one line of text."""
    weight = " font-weight='bold'" if bold else ""
    position = f"x='{x:.0f}' y='{y:.0f}' text-anchor='{anchor}'"
    return f"<text {position} font-size='{size}' fill='{fill}'{weight}>{escape(words)}</text>"


def is_package(room: str) -> bool:
    """Return whether a room is a sub-package; a folder that holds only compiled files is not."""
    return (ROOT / room.replace(".", "/") / "__init__.py").exists()


def box(x: float, y: float, width: float, words: str, fill: str = BOX, height: float = BOX_HEIGHT) -> str:
    """Return a labelled box; `x` and `y` are its top-left corner."""
    position = f"x='{x:.0f}' y='{y:.0f}' width='{width:.0f}' height='{height:.0f}'"
    frame = f"<rect {position} rx='4' fill='{fill}' stroke='{LINE}'/>"
    return frame + text(x + width / 2, y + height / 2 + 4, words, anchor="middle")


def arrow(points: Iterable[tuple[float, float]], dashed: bool = False, colour: str = LINE, head: bool = True) -> str:
    """Return an arrow along points, or a line without a head."""
    path = " ".join(f"{x:.0f},{y:.0f}" for x, y in points)
    dash = " stroke-dasharray='5 4'" if dashed else ""
    end = f" marker-end='url(#{'wall' if colour == WALL else 'head'})'" if head else ""
    return f"<polyline points='{path}' fill='none' stroke='{colour}'{dash}{end}/>"


def wrapped(words: str, width: int) -> list[str]:
    """Break words into lines of at most `width` characters."""
    lines = [""]
    for word in words.split():
        if len(lines[-1]) + len(word) >= width and lines[-1]:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return lines


def picture(width: float, height: float, title: str, parts: Sequence[str]) -> str:
    """Return a complete SVG file."""
    head = "<marker id='{}' viewBox='0 0 8 8' refX='7' refY='4' markerWidth='7' markerHeight='7' orient='auto'>"
    head += "<path d='M0,0 L8,4 L0,8 z' fill='{}'/></marker>"
    size = f"width='{width:.0f}' height='{height:.0f}' viewBox='0 0 {width:.0f} {height:.0f}'"
    return "\n".join(
        (
            f"<svg xmlns='http://www.w3.org/2000/svg' {size} role='img' {FONT}>",
            f"<title>{escape(title)}</title>",
            f"<defs>{head.format('head', LINE)}{head.format('wall', WALL)}</defs>",
            f"<rect width='100%' height='100%' fill='{PAPER}'/>",
            *parts,
            "</svg>\n",
        )
    )


def opening(package: str) -> str:
    """Return the first sentence of a package's docstring."""
    docstring = ast.get_docstring(ast.parse((ROOT / package / "__init__.py").read_text(encoding="utf-8"))) or ""
    return docstring.splitlines()[0]


def draw_rooms(plan: Plan) -> str:
    """Draw a band for each package with its rooms, imports and data."""
    parts: list[str] = []
    bands: dict[str, tuple[float, float]] = {}
    top = 20.0
    for package in plan.packages:
        rooms = plan.rooms(package)
        rows = rows_of(plan, package)
        notes = notes_of(plan, package)
        head = 44 + 15 * len(notes)
        height = head + ROW * (max(rows.values()) + 1) + 6
        parts.append(
            f"<rect x='10' y='{top:.0f}' width='{BAND_WIDTH}' height='{height:.0f}' rx='6' fill='none' stroke='{INK}'/>"
        )
        parts.append(text(22, top + 21, package, 15, bold=True))
        parts.append(text(22, top + 38, opening(package), 12, GREY))
        for number, (note, colour) in enumerate(notes):
            parts.append(text(22, top + 54 + 15 * number, note, 11, colour))
        parts += draw_band(package, rooms, rows, plan.imports, top + head)
        bands[package] = (top, top + height)
        top += height + GAP
    parts += draw_data(plan, bands)
    return picture(WIDTH, top, "The packages of CroP, their rooms, imports and data flow", parts)


def notes_of(plan: Plan, package: str) -> list[tuple[str, str]]:
    """Return the lines below a package name: its imports from other packages, and forbidden modules."""
    imported: dict[str, set[str]] = {}
    for room in [package, *plan.rooms(package)]:
        for imported_room in plan.imports.get(room, ()):
            other, _, name = imported_room.partition(".")
            if other != package:
                imported.setdefault(other, set()).add(name)
    import_names = [
        other if other == plan.packages[-1] else f"{other} ({', '.join(sorted(filter(None, imported[other])))})"
        for other in plan.packages
        if other in imported
    ]
    lines = wrapped("imports " + ", ".join(import_names), 122) if import_names else []
    forbidden = grouped(plan.forbidden[package])
    exceptions = sorted(plan.excepted[package])
    exemption = f"; {', '.join(exceptions)} may" if exceptions else ""
    forbidden_lines = wrapped(f"must not import {', '.join(forbidden)}{exemption}", 122) if forbidden else []
    return [(line, GREY) for line in lines] + [(line, WALL) for line in forbidden_lines]


def grouped(modules: Set[str]) -> list[str]:
    """Return modules in alphabetical order, several of one package as one: ``drivers (canon, ptp)``."""
    homes: dict[str, list[str]] = {}
    for module in sorted(modules):
        homes.setdefault(module.rpartition(".")[0] or module, []).append(module.rpartition(".")[2])
    return [
        home if names == [home] else f"{home} ({', '.join(names)})" if len(names) > 1 else f"{home}.{names[0]}"
        for home, names in homes.items()
    ]


def draw_band(
    package: str, rooms: Sequence[str], rows: Mapping[str, int], imports: Mapping[str, Set[str]], top: float
) -> list[str]:
    """Draw the rooms of a package in rows, highest first, with the imports among them."""
    places: dict[str, tuple[float, float, float]] = {}
    highest = max(rows.values())
    inside = {room: set(imports[room]) & set(rooms) for room in rooms}
    group = {room: min(target for target in rooms if target == room or cyclic(inside, target, room)) for room in rooms}
    for row in range(highest, -1, -1):
        row_rooms = sorted((room for room in rooms if rows[room] == row), key=lambda room: (group[room], room))
        widths = [7 * len(room.partition(".")[2]) + 18 for room in row_rooms]
        # Odd rows are shifted, so that imports past a row are visible next to its boxes.
        space = (BAND_WIDTH - 60 - sum(widths)) / (len(row_rooms) + 1)
        x = 10 + space + (25 if row % 2 else 0)
        for room, width in zip(row_rooms, widths, strict=True):
            places[room] = (x, top + ROW * (highest - row), width)
            x += width + space
    parts: list[str] = []
    for room, target in shown_imports(rooms, imports):
        (x, y, width), (to_x, to_y, to_width) = places[room], places[target]
        if y == to_y:
            ends = ((x + width, y + 13), (to_x, y + 13)) if x < to_x else ((x, y + 13), (to_x + to_width, y + 13))
        else:
            ends = ((x + width / 2, y + BOX_HEIGHT), (to_x + to_width / 2, to_y))
        parts.append(arrow(ends, colour=WALL if cyclic(inside, room, target) else LINE))
    parts += [
        box(x, y, width, room.partition(".")[2], BOX if is_package(room) else PAPER)
        for room, (x, y, width) in places.items()
    ]
    return parts


def draw_data(plan: Plan, bands: Mapping[str, tuple[float, float]]) -> list[str]:
    """Draw the data of each package next to its band (top, bottom), with the data flow between them."""
    parts: list[str] = []
    previous: tuple[float, str] | None = None
    simulated: float | None = None
    for package in (package for package in plan.packages if package in DATA):
        left = DATA_LEFT + (40 if package == SIMULATED else 0)
        centre, arrow_x = (left + WIDTH - 10) / 2, DATA_LEFT + 20
        lines = [line for words in DATA[package] for line in wrapped(words, 30 if left == DATA_LEFT else 24)]
        middle, half = sum(bands[package]) / 2, 8 * len(lines) + 6
        frame = f"x='{left}' y='{middle - half:.0f}' width='{WIDTH - left - 10}' height='{2 * half}'"
        parts.append(f"<rect {frame} rx='12' fill='{PAPER}' stroke='{INK}'/>")
        parts += [text(centre, middle - half + 19 + 16 * n, line, anchor="middle") for n, line in enumerate(lines)]
        if package == SIMULATED:
            simulated = middle + half
            continue
        if previous is not None:
            bottom, user = previous
            parts.append(arrow(((arrow_x, middle - half), (arrow_x, bottom))))
            parts.append(text(arrow_x + 8, bottom + 18, " ".join(plan.commands[user]), 12, GREY, bold=True))
        if simulated is not None:
            parts.append(arrow(((centre + 20, simulated), (centre + 20, middle - half)), dashed=True))
            parts.append(text(centre + 12, simulated + 18, "simulated devices", 11, GREY, anchor="end"))
            simulated = None
        previous = middle + half, package
    return parts


def draw_step() -> str:
    """Draw the states of a session step."""
    sys.path.insert(0, str(ROOT))
    from docs.states import AHEAD, ENDS, TRANSITIONS, UNDER_WAY, StepState

    box_width, left, right, lane_x = 112, 340, 680, 830
    path = [*AHEAD, *UNDER_WAY, StepState.ACCEPTED]
    end_rows = {StepState.FAILED: 2.6, StepState.INTERRUPTED: 5.4, StepState.REFUSED: 6.7, StepState.VOIDED: 8.0}
    places = {state: (left, 30.0 + 66 * row) for row, state in enumerate(path)}
    places |= {state: (right, 30 + 66 * row) for state, row in end_rows.items()}
    if set(places) != set(StepState) or set(ENDS) != {StepState.ACCEPTED, *end_rows}:
        raise ValueError("a state of docs/states.py has no position in the drawing; add it")
    interruptions = [line for line in TRANSITIONS if line.after is StepState.INTERRUPTED]
    if {line.before for line in interruptions} != set(UNDER_WAY):
        raise ValueError("some states under way cannot be interrupted; draw one arrow for each state")
    parts: list[str] = []
    bracket, top, bottom = left + box_width + 14, places[UNDER_WAY[0]][1], places[UNDER_WAY[-1]][1] + BOX_HEIGHT
    parts.append(
        arrow(((bracket - 8, top), (bracket, top), (bracket, bottom), (bracket - 8, bottom)), True, head=False)
    )
    x, y = places[StepState.INTERRUPTED]
    parts.append(arrow(((bracket, y + 13), (x, y + 13)), dashed=True))
    parts.append(text(bracket + 12, y + 7, interruptions[0].cause, 11, GREY))
    for line in (line for line in TRANSITIONS if line not in interruptions):
        (x, y), (to_x, to_y) = places[line.before], places[line.after]
        if x == to_x and to_y > y:
            parts.append(arrow(((x + 40, y + BOX_HEIGHT), (x + 40, to_y))))
            parts.append(text(x + 30, (y + BOX_HEIGHT + to_y) / 2 + 4, line.cause, 11, GREY, anchor="end"))
        elif x == to_x:
            # The longest way back is drawn outermost.
            far = 20 + 12 * (path.index(StepState.ACCEPTED) - path.index(line.before)) // 2
            parts.append(arrow(((x, y + 13), (far, y + 13), (far, to_y + 13), (x, to_y + 13)), dashed=True))
            parts.append(text(far + 10, y + 7, line.cause, 11, GREY))
        elif to_x > x:
            parts.append(arrow(((x + box_width, y + 13), (to_x, to_y + 13))))
            share, aside_px = 0.25, -6 if to_y >= y else 16
            along = (x + box_width + share * (to_x - x - box_width) + 6, y + 13 + share * (to_y - y) + aside_px)
            parts.append(text(*along, line.cause, 11, GREY))
        else:
            high, end = to_y - 8, to_x + box_width - 20
            points = ((x + box_width, y + 13), (lane_x, y + 13), (lane_x, high), (end, high), (end, to_y))
            parts.append(arrow(points, dashed=True))
            lines = wrapped(line.cause, 24)
            parts += [text(x, y + BOX_HEIGHT + 14 + 14 * n, words, 11, GREY) for n, words in enumerate(lines)]
    fills = {StepState.ACCEPTED: "#d7f0dd", StepState.REFUSED: "#fbe3c8", StepState.FAILED: "#f8d4d0"}
    parts += [box(x, y, box_width, state.value, fills.get(state, BOX)) for state, (x, y) in places.items()]
    return picture(850, 30 + 66 * len(path), "States of a session step", parts)


def figures() -> dict[Path, str]:
    """Return the files of the figures with their content."""
    return {IMAGES / "rooms.svg": draw_rooms(read_plan()), IMAGES / "step.svg": draw_step()}


if __name__ == "__main__":
    for file, content in figures().items():
        file.write_text(content, encoding="utf-8")
        print(file.relative_to(ROOT))
