# SPDX-License-Identifier: MIT
"""Draws `docs/house.svg`: the rooms of the package and which one imports which.

python docs/house.py; the manual calls it too.
"""

from __future__ import annotations

import ast
from pathlib import Path

import networkx as nx

DOCS = Path(__file__).resolve().parent
PACKAGE = DOCS.parent / "sononerf"
WIDTH, HEIGHT, ROW, COLUMN = 118, 40, 76, 134  # pixels


def imports() -> nx.DiGraph:
    """Return the rooms with their numbers of lines and files, and an arrow for each import."""
    graph = nx.DiGraph()
    for path in sorted(PACKAGE.rglob("*.py")):
        room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if room == "__init__" or "templates" in path.parts:
            continue
        text = path.read_text(encoding="utf-8")
        known = graph.nodes[room] if room in graph else {}
        lines, files = known.get("lines", 0) + text.count("\n"), known.get("files", 0) + 1
        graph.add_node(room, lines=lines, files=files)
        for node in ast.walk(ast.parse(text)):
            modules = []
            if isinstance(node, ast.ImportFrom):
                modules = [node.module]
                if node.module == "sononerf":
                    modules = [f"sononerf.{alias.name}" for alias in node.names]
            for module in modules:
                first, _, rest = module.partition(".")
                target = rest.partition(".")[0]
                if first == "sononerf" and target not in (room, "", "__version__"):
                    graph.add_edge(room, target)
    return graph


def drawing() -> str:
    """Return the house as SVG: an arrow that another path replaces is left out."""
    graph = imports()
    few = nx.transitive_reduction(graph)
    rows = [sorted(row) for row in nx.topological_generations(graph)]
    place = {}
    widest = max(len(row) for row in rows)
    for level, row in enumerate(rows):
        for column, room in enumerate(row):
            x = 10 + COLUMN * (column + (widest - len(row)) / 2)
            place[room] = (x, 10 + ROW * level)
    size = 20 + COLUMN * widest, 20 + ROW * len(rows)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size[0]} {size[1]}" '
        f'width="{size[0]}" height="{size[1]}" font-family="sans-serif" font-size="13">',
        '<rect width="100%" height="100%" fill="white"/>',
    ]
    for start, end in sorted(few.edges):
        (x, y), (u, v) = place[start], place[end]
        parts.append(
            f'<line x1="{x + WIDTH / 2}" y1="{y + HEIGHT}" x2="{u + WIDTH / 2}" y2="{v}" '
            'stroke="#8aa" stroke-width="1.2"/>'
        )
    for room, (x, y) in sorted(place.items()):
        data = graph.nodes[room]
        files = "1 file" if data["files"] == 1 else f"{data['files']} files"
        middle = x + WIDTH / 2
        parts += [
            f'<rect x="{x}" y="{y}" width="{WIDTH}" height="{HEIGHT}" rx="5" fill="#eef4f6" '
            'stroke="#357"/>',
            f'<text x="{middle}" y="{y + 17}" text-anchor="middle">{room}</text>',
            f'<text x="{middle}" y="{y + 33}" text-anchor="middle" font-size="10" fill="#555">'
            f"{data['lines']:,} lines, {files}</text>",
        ]
    return "\n".join([*parts, "</svg>", ""])


def write() -> None:
    """Write the drawing where it has changed."""
    file = DOCS / "house.svg"
    if not file.is_file() or file.read_text(encoding="utf-8") != drawing():
        file.write_text(drawing(), encoding="utf-8")


if __name__ == "__main__":
    write()
