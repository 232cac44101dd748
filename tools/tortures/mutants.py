# SPDX-License-Identifier: MIT
"""Deliberate faults in the code: the tests must see them."""

from __future__ import annotations

import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tools.tortures.harness import Report

ROOT = Path(__file__).resolve().parents[2]
PARTS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "storage": (
        ("storage.py", "locks.py", "checksums.py"),
        ("test_storage.py", "test_locks.py", "test_checksums.py"),
    ),
    "store": (
        ("echoes/store.py", "echoes/layout.py"),
        ("echoes/test_store.py", "echoes/test_layout.py"),
    ),
    "resume": (
        ("field/checkpoint_io.py", "callbacks/epoch.py"),
        (
            "field/test_checkpoint_io.py",
            "field/test_weights.py",
            "callbacks/test_epoch.py",
            "run/test_fit.py",
        ),
    ),
    "onsets": (("echoes/detection.py",), ("echoes/test_detection.py", "echoes/test_onsets.py")),
    "renderer": (
        ("field/renderer.py", "field/profile.py"),
        ("field/test_renderer.py", "field/test_profile.py"),
    ),
    "metrics": (
        ("evaluation/metrics.py", "head/decibels.py"),
        ("evaluation/test_metrics.py", "evaluation/test_prediction.py", "head/test_decibels.py"),
    ),
    "head": (
        ("head/head.py", "head/spectrogram.py", "head/reception.py"),
        (
            "head/test_head.py",
            "head/test_spectrogram.py",
            "head/test_reception.py",
            "head/test_row_filters.py",
        ),
    ),
}
"""Parts that must not fail: their sources below `sononerf/`, and their tests below `tests/`."""
SECONDS = 600
"""Longest time for the tests of one mutant, s: one that hangs is seen."""
SWAPS: dict[type, type] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.And: ast.Or,
    ast.Or: ast.And,
}  # fmt: skip


class _Mutator(ast.NodeTransformer):
    """Counts the places where a fault can be made, and makes one."""

    def __init__(self, wanted: int = -1) -> None:
        self.wanted, self.places, self.made = wanted, 0, ""

    def _here(self, node: ast.AST, what: str) -> bool:
        self.places += 1
        if self.places - 1 != self.wanted:
            return False
        self.made = f"line {getattr(node, 'lineno', 0)}: {what}"
        return True

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        if node.value is not None:
            node.value = self.visit(node.value)
        return node

    def visit_arguments(self, node: ast.arguments) -> ast.AST:
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.body = [self.visit(part) for part in node.body]
        return node

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        self.generic_visit(node)
        new = SWAPS.get(type(node.ops[0]))
        if new is not None and self._here(node, f"{ast.unparse(node)}: {new.__name__}"):
            node.ops[0] = new()
        return node

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        self.generic_visit(node)
        new = SWAPS.get(type(node.op))
        of_text = any(isinstance(x, (ast.JoinedStr, ast.Constant)) and not isinstance(
            getattr(x, "value", 0), (int, float)) for x in (node.left, node.right))  # fmt: skip
        if new is not None and not of_text:
            if self._here(node, f"{ast.unparse(node)}: {new.__name__}"):
                node.op = new()
        return node

    def visit_BoolOp(self, node: ast.BoolOp) -> ast.AST:
        self.generic_visit(node)
        new = SWAPS[type(node.op)]
        if self._here(node, f"{ast.unparse(node)}: {new.__name__}"):
            node.op = new()
        return node

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.op, (ast.Not, ast.USub)):
            if self._here(node, f"{ast.unparse(node)} without its sign"):
                return node.operand
        return node

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        if type(node.value) in (int, float):
            if self._here(node, f"{node.value} + 1"):
                return ast.copy_location(ast.Constant(node.value + 1), node)
        elif isinstance(node.value, bool) and self._here(node, f"not {node.value}"):
            return ast.copy_location(ast.Constant(not node.value), node)
        return node

    def visit_Expr(self, node: ast.Expr) -> ast.AST:
        if isinstance(node.value, ast.Call):
            if self._here(node, f"without {ast.unparse(node)[:60]}"):
                return ast.copy_location(ast.Pass(), node)
            self.generic_visit(node)
        return node  # docstrings stay

    def visit_Raise(self, node: ast.Raise) -> ast.AST:
        if self._here(node, f"without {ast.unparse(node)[:60]}"):
            return ast.copy_location(ast.Pass(), node)
        return node

    def visit_JoinedStr(self, node: ast.JoinedStr) -> ast.AST:
        return node


def mutated(source: str, number: int) -> tuple[str, str]:
    """Return a source with its N-th possible fault, and what that is."""
    mutator = _Mutator(number)
    tree = ast.fix_missing_locations(mutator.visit(ast.parse(source)))
    return ast.unparse(tree), mutator.made


def places(source: str) -> int:
    """Return in how many places of a source a fault can be made."""
    mutator = _Mutator()
    mutator.visit(ast.parse(source))
    return mutator.places


def mutants(count: int, seed: int, keep: Path) -> Report:
    """Make deliberate faults, one at a time, and run the tests of what has them.

    Args:
        count: Number of mutants, divided evenly among the parts.
        seed: Seed of the choice.
        keep: Not used.
    """
    del keep
    report, rng = Report("mutants", seed), random.Random(seed)
    with tempfile.TemporaryDirectory() as place:
        copy = Path(place) / "copy"
        listed = subprocess.run(
            ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
        )
        for name in listed.stdout.splitlines():
            if (ROOT / name).is_file():
                (copy / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(ROOT / name, copy / name)
        for part, (sources, tests) in PARTS.items():
            every = [
                (source, number)
                for source in sources
                for number in range(places((ROOT / "sononerf" / source).read_text("utf-8")))
            ]
            if _fails(copy, tests):
                report.fault(f"{part}: the tests fail without a fault")
                continue
            for source, number in rng.sample(every, min(len(every), -(-count // len(PARTS)))):
                file = copy / "sononerf" / source
                sound = file.read_text("utf-8")
                text, what = mutated(sound, number)
                file.write_text(text, "utf-8")
                seen = _fails(copy, tests)
                file.write_text(sound, "utf-8")
                report.count(f"{part}: {'seen' if seen else 'survive'}")
                report.count("seen" if seen else "survive")
                if not seen:
                    report.fault(f"{source}, {what}")
    return report


def _fails(copy: Path, tests: tuple[str, ...]) -> bool:
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    try:
        done = subprocess.run(
            [*command, *(f"tests/{name}" for name in tests)],
            cwd=copy,
            env={**os.environ, "PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1"},
            capture_output=True,
            timeout=SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return True
    return done.returncode != 0
