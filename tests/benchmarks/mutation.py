"""Which changes of the code the tests notice: mutants of gates, warnings and checks, and a sample of others.

    python tests/benchmarks/mutation.py [--only urdfcal/io/checks] [--sample 10] [--list]

Two populations:

- gates: every mutant of conditions, comparisons, boolean operators and returns in the functions that ``GATES`` names;
  at least 90 % of them must fail a test.
- others: 300 mutants drawn with ``--seed`` from the rest of ``OTHERS``: operators, constants, conditions, comparisons,
  returns, dropped statements; at least 75 %.

A condition is replaced by True and by False, a comparison by its opposite, `and` by `or`, a returned value by an empty
one of its type. `<` becomes `<=` only where whole numbers are compared: which side of a measured threshold equality
falls on is no behaviour. A float constant of a module is multiplied by ten, as tests need not notice less of a tuned
one. Texts, annotations, decorators and what is raised are left alone.

The tests run once with coverage contexts, in a copy of the repository; each mutant then runs the tests that reach its
statement (for a module's constant: the functions that use it), in another copy, until the first one fails. The tests of
the same module come first, then those of the same folder, the quick ones first, up to ``--budget`` seconds. A mutant
that exceeds its time is killed. Measured data outside the repository are not there, so that what only they test
survives. The order is random: a run that ``--time-limit`` cuts short is a fair sample.

The run with coverage is kept in the temporary folder for as long as package and tests stay the same.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import fnmatch
import hashlib
import importlib.util
import json
import os
import re
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "urdfcal"
# Files beside this one are named as packages are (coverage.py): they must not be found in their place.
sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != Path(__file__).resolve().parent]

_DECIDES = r"check|doubt|fail|warn|refus|gate|outlier|strange|judge|allow|prefer|screen|verdict|far\b|_far|valid"
GATES: tuple[tuple[str, str], ...] = (
    ("io/checks/*", r""),
    ("io/*", r"_check|^check"),
    ("session/*", r"__post_init__|_check|^check"),
    ("cameras/*", r"__post_init__|_check"),
    ("detection/association*", r""),
    ("detection/predict*", r""),
    ("detection/detect*", r"detect_in|write_detected|_far|_agree|_associat"),
    ("detection/spots/*", r"gate|reject|reason|still|accept|judge|_check"),
    ("estimation/assessment*", r""),
    ("estimation/*", _DECIDES),
    ("result/verif*", r""),
    ("result/*", _DECIDES),
    ("output/findings*", r""),
    ("pipeline*", r"_doubts|_strange|_check|^calibrate$|_as_points"),
)
"""Files of the package, and what the qualified names of their functions contain, in which every decision is tested."""

OTHERS = ("estimation/*", "result/*")
"""Files of the package from which the others are drawn."""

EQUIVALENT: frozenset[tuple[str, str, str]] = frozenset(
    {
        # Choices of fewer than two cameras have no point, and so are infinitely far off.
        ("detection/association.py", "_combinations", "len(by_camera) > 2 -> (True)"),
        ("detection/association.py", "_combinations", "len(by_camera) > 2 -> (len(by_camera) >= 2)"),
        ("detection/association.py", "_combinations", "len(choice) > 1 -> (True)"),
        ("detection/association.py", "_combinations", "len(choice) > 1 -> (len(choice) >= 1)"),
        # A median of nothing is nan, which compares as the value that stands for it.
        ("detection/association.py", "agree", "single -> (True)"),
        ("io/checks/content.py", "_score", "found -> (True)"),
        # Of no lights nothing stands still, whichever way it is said.
        ("detection/spots/detector.py", "_stands_still", "not len(spots.fits) -> (False)"),
        ("detection/spots/detector.py", "_stands_still", "np.zeros(0, dtype=bool) -> (~(np.zeros(0, dtype=bool)))"),
    }
)
"""(file in the package, function, "old -> new") of mutants that behave as the original: listed, and not counted."""

REQUIRED = {"gates": 0.90, "others": 0.75}
SAMPLE = 300
DECISIONS = frozenset({"condition", "comparison", "boolean", "return"})

# Imported before the fork, so that each mutant waits only for urdfcal itself.
_PRELOADED = (
    "numpy", "scipy.optimize", "scipy.interpolate", "scipy.spatial", "pinocchio", "cv2", "yaml", "pydantic", "jinja2",
    "click", "click.testing", "rich.console", "rich.table", "rich.progress", "threadpoolctl", "yourdfpy",
    "rosbags.highlevel", "hypothesis.strategies", "rerun",
)  # fmt: skip
_MEMORY = 8 * 2**30  # a loop that no longer ends must not take the machine's
_START = 20.0  # s: imports of urdfcal and collection, on a loaded machine
_SLACK = 5.0  # times the measured duration before a mutant counts as stuck


@dataclass(frozen=True)
class Mutant:
    """One change of one file.

    Attributes:
        path: of the file in the package.
        function: qualified name of what holds the change; empty at the level of the module.
        line: of the change.
        kind: of the change.
        old: source that is replaced.
        new: what it becomes.
        span: first and last byte of the old source.
        lines: of the statement, or of the functions' bodies by which the change is reached.
        names: that a statement of the module or a class binds: their users reach it.
    """

    path: str
    function: str
    line: int
    kind: str
    old: str
    new: str
    span: tuple[int, int]
    lines: range
    names: frozenset[str]

    @property
    def key(self) -> tuple[str, str, str]:
        return self.path, self.function, f"{self.old} -> {self.new}"

    @property
    def gate(self) -> bool:
        """Whether every decision of its function must be tested."""
        return self.kind in DECISIONS and any(
            fnmatch.fnmatch(self.path, files) and re.search(names, self.function) for files, names in GATES
        )

    @property
    def other(self) -> bool:
        return any(fnmatch.fnmatch(self.path, files) for files in OTHERS)

    def __str__(self) -> str:
        where = f"{PACKAGE}/{self.path}:{self.line}"
        return f"{where}  {self.function or '(module)'}  {self.kind}: {_short(self.old)}  ->  {_short(self.new)}"


def _short(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= 90 else f"{text[:60]} ... {text[-25:]}"


# --- Mutants ----------------------------------------------------------------------------------------------------------

_OPPOSITE: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_BOUNDARY: dict[type[ast.cmpop], type[ast.cmpop]] = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
}  # fmt: skip
_WHOLE = ("len", "count_nonzero", "size", "ndim", "count", "shape")
_NO_BEHAVIOUR = ("strict", "frozen", "eq", "repr", "compare", "copy")  # keywords
_EMPTY = (  # by the start of the annotation
    ("list", "[]"), ("tuple", "()"), ("dict", "{}"), ("Mapping", "{}"), ("set", "set()"), ("frozenset", "frozenset()"),
    ("str", '""'), ("float", "0.0"), ("int", "0"), ("Iterator", "iter(())"), ("Iterable", "()"), ("Sequence", "()"),
    ("bool", "not ({})"), ("Bools", "~({})"), ("Floats", "0.0 * ({})"), ("Ints", "0 * ({})"), ("", "None"),
)  # fmt: skip


class Mutator:
    """Finds the mutants of one file."""

    def __init__(self, path: str, source: str) -> None:
        self.path, self.source = path, source.encode()
        self.found: list[Mutant] = []
        starts = [0]
        for line in self.source.splitlines(keepends=True):
            starts.append(starts[-1] + len(line))
        self._starts = starts
        self._block(ast.parse(source).body, (), None, None)

    def _block(
        self, body: Sequence[ast.stmt], scope: tuple[str, ...], reached: range | None, returns: str | None
    ) -> None:
        for statement in body:
            self._statement(statement, scope, reached, returns)

    def _statement(self, node: ast.stmt, scope: tuple[str, ...], reached: range | None, returns: str | None) -> None:
        """``reached``: the lines by which a class is reached; None in a function, whose lines have contexts."""
        if isinstance(node, (ast.Import, ast.ImportFrom, ast.Global, ast.Nonlocal, ast.Pass)):
            return
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            return  # a docstring
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            return
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            body = range(node.body[0].lineno, (node.end_lineno or 0) + 1)
            at = _At((*scope, node.name), body, frozenset(), returns)
            for default in (*node.args.defaults, *node.args.kw_defaults):
                if default is not None:
                    self._expression(default, at)
            annotation = "" if node.returns is None else ast.unparse(node.returns)
            self._block(node.body, (*scope, node.name), None, annotation)
            return
        if isinstance(node, ast.ClassDef):
            self._block(node.body, (*scope, node.name), range(node.lineno, (node.end_lineno or 0) + 1), None)
            return
        header = range(node.lineno, self._header_end(node) + 1)
        at = _At(scope, header if returns is not None else reached or range(0), _bound(node), returns)
        self._drop(node, at)
        self._decide(node, at)
        for child in _expressions(node):
            self._expression(child, at)
        for name in ("body", "orelse", "finalbody"):
            self._block(getattr(node, name, []), scope, reached, returns)
        for handler in getattr(node, "handlers", []):
            self._block(handler.body, scope, reached, returns)

    def _header_end(self, node: ast.stmt) -> int:
        body = getattr(node, "body", None)
        end: int = max(body[0].lineno - 1, node.lineno) if body else node.end_lineno or node.lineno
        return end

    def _drop(self, node: ast.stmt, at: _At) -> None:
        plain = isinstance(node, (ast.AugAssign, ast.Continue, ast.Break, ast.Raise))
        stored = isinstance(node, ast.Assign) and isinstance(node.targets[0], (ast.Subscript, ast.Attribute))
        called = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
        if at.returns is not None and (plain or stored or called):
            self._add(node, "statement", "pass", at)
        if isinstance(node, ast.Expr) and isinstance(node.value, (ast.Yield, ast.YieldFrom)):
            self._add(node, "return", "yield from ()", at)

    def _decide(self, node: ast.stmt, at: _At) -> None:
        if isinstance(node, (ast.If, ast.While)):
            self._condition(node.test, at, loop=isinstance(node, ast.While))
        if isinstance(node, ast.Return) and node.value is not None and at.returns:
            old = ast.unparse(node.value)
            new = next(value for start, value in _EMPTY if (at.returns or "").strip("'\"").startswith(start))
            new = {"True": "False", "False": "True"}.get(old, new.format(old))
            if new != old and "None" not in (new, old):
                self._add(node.value, "return", new, at)
            elif new != old and old != "None":
                self._add(node.value, "return", "None", at)

    def _condition(self, test: ast.expr, at: _At, *, loop: bool = False) -> None:
        if isinstance(test, ast.Constant):
            return
        self._add(test, "condition", "False", at)
        if not loop:
            self._add(test, "condition", "True", at)
        self._boundary(test, at)

    def _expression(self, node: ast.AST, at: _At, *, whole: bool = False) -> None:
        """``whole``: it is all of a test, and has been mutated as a condition."""
        if isinstance(node, ast.JoinedStr):
            return  # a text; its parts have no exact places before Python 3.12
        tests = [node.test] if isinstance(node, ast.IfExp) else node.ifs if isinstance(node, ast.comprehension) else []
        for test in tests:
            self._condition(test, at)
        if isinstance(node, ast.Compare) and not whole:
            opposite = _OPPOSITE[type(node.ops[0])]
            new = _compared(node, opposite) if len(node.ops) == 1 else f"not ({ast.unparse(node)})"
            self._add(node, "comparison", new, at)
            self._boundary(node, at)
        if isinstance(node, ast.BoolOp):
            swapped = ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
            self._add(node, "boolean", ast.unparse(swapped), at)
        if isinstance(node, ast.UnaryOp):
            self._unary(node, at, whole=whole)
        if isinstance(node, ast.BinOp):
            self._binary(node, at)
        if isinstance(node, ast.Constant):
            self._constant(node, at)
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.keyword):
                if child.arg not in _NO_BEHAVIOUR:
                    self._expression(child.value, at)
            elif not isinstance(child, (ast.expr_context, ast.arguments, ast.operator, ast.unaryop, ast.cmpop)):
                self._expression(child, at, whole=child in tests)

    def _boundary(self, node: ast.expr, at: _At) -> None:
        if not isinstance(node, ast.Compare) or len(node.ops) != 1 or type(node.ops[0]) not in _BOUNDARY:
            return
        if any(_is_whole(side) for side in (node.left, *node.comparators)):
            self._add(node, "comparison", _compared(node, _BOUNDARY[type(node.ops[0])]), at)

    def _unary(self, node: ast.UnaryOp, at: _At, *, whole: bool) -> None:
        if isinstance(node.op, (ast.Not, ast.Invert)) and not whole:
            self._add(node, "boolean", ast.unparse(node.operand), at)
        elif isinstance(node.op, ast.USub) and not isinstance(node.operand, ast.Constant):
            self._add(node, "operator", ast.unparse(node.operand), at)

    def _binary(self, node: ast.BinOp, at: _At) -> None:
        if isinstance(node.op, (ast.BitAnd, ast.BitOr)) and at.returns is not None:
            new = ast.BinOp(node.left, ast.BitOr() if isinstance(node.op, ast.BitAnd) else ast.BitAnd(), node.right)
            self._add(node, "boolean", ast.unparse(new), at)
        texts = (ast.JoinedStr, ast.List, ast.Tuple, ast.ListComp)
        text = any(
            isinstance(side, texts) or (isinstance(side, ast.Constant) and isinstance(side.value, str))
            for side in (node.left, node.right)
        )
        if type(node.op) in _ARITHMETIC and not text:
            new = ast.BinOp(node.left, _ARITHMETIC[type(node.op)](), node.right)
            self._add(node, "operator", ast.unparse(new), at)

    def _constant(self, node: ast.Constant, at: _At) -> None:
        value = node.value
        if isinstance(value, bool):
            self._add(node, "constant", str(not value), at)
        elif isinstance(value, int):
            self._add(node, "constant", str(value + 1), at)
        elif isinstance(value, float):
            factor = 10.0 if at.returns is None else 2.0
            self._add(node, "constant", repr(factor * value) if value else "1.0", at)

    def _add(self, node: ast.expr | ast.stmt, kind: str, new: str, at: _At) -> None:
        start = self._starts[node.lineno - 1] + node.col_offset
        end = self._starts[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0)
        old = self.source[start:end].decode()
        if not isinstance(node, ast.stmt) and kind not in ("constant",):
            new = f"({new})"
        self.found.append(
            Mutant(
                self.path, ".".join(at.scope), node.lineno, kind, old, new, (start, end), at.lines,
                at.names if at.returns is None else frozenset(),
            )
        )  # fmt: skip


@dataclass(frozen=True)
class _At:
    """Where an expression stands: ``returns`` is its function's annotation, None outside of functions."""

    scope: tuple[str, ...]
    lines: range
    names: frozenset[str]
    returns: str | None


def _expressions(node: ast.stmt) -> Iterator[ast.AST]:
    """What a statement evaluates itself, without annotations and what it raises."""
    if isinstance(node, ast.Raise):
        return
    for name, value in ast.iter_fields(node):
        if name in ("body", "orelse", "finalbody", "handlers", "annotation", "decorator_list", "target", "targets"):
            continue
        for item in value if isinstance(value, list) else [value]:
            if name == "test":
                yield from _parts_of_test(item)
            elif isinstance(item, ast.AST):
                yield item


def _parts_of_test(test: ast.expr) -> Iterator[ast.AST]:
    """A whole test is mutated as a condition; a comparison that is all of it not again as one."""
    if isinstance(test, ast.Compare):
        yield from (test.left, *test.comparators)
    elif isinstance(test, ast.UnaryOp) and isinstance(test.op, ast.Not):
        yield test.operand
    else:
        yield test


def _bound(node: ast.stmt) -> frozenset[str]:
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return frozenset(n.id for t in targets if t is not None for n in ast.walk(t) if isinstance(n, ast.Name))


def _compared(node: ast.Compare, operator: type[ast.cmpop]) -> str:
    return ast.unparse(ast.Compare(node.left, [operator()], node.comparators))


def _is_whole(node: ast.expr) -> bool:
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int)
    called = node.func if isinstance(node, ast.Call) else node
    name = called.attr if isinstance(called, ast.Attribute) else called.id if isinstance(called, ast.Name) else ""
    return name in _WHOLE


def all_mutants(only: Sequence[str]) -> list[Mutant]:
    found: list[Mutant] = []
    for file in sorted((ROOT / PACKAGE).rglob("*.py")):
        path = file.relative_to(ROOT / PACKAGE).as_posix()
        if only and not any(f"{PACKAGE}/{path}".startswith(_in_package(one)) for one in only):
            continue
        if any(fnmatch.fnmatch(path, files) for files in (*OTHERS, *(files for files, _ in GATES))):
            found += Mutator(path, file.read_text(encoding="utf-8")).found
    return found


def _in_package(path: str) -> str:
    named = (Path.cwd() / path).resolve()
    return named.relative_to(ROOT).as_posix() if named.is_relative_to(ROOT) else path


# --- Which tests reach what -------------------------------------------------------------------------------------------


class Baseline:
    """The tests run once with coverage contexts, in a copy of the repository that is kept."""

    def __init__(self, processes: int, tests: Sequence[str]) -> None:
        digest = hashlib.sha256(repr((tests, sys.version)).encode())
        for file in sorted((*(ROOT / PACKAGE).rglob("*.py"), *(ROOT / "tests").rglob("*.py"))):
            if "benchmarks" not in file.parts:
                digest.update(file.read_bytes())
        self.tree = Path(tempfile.gettempdir()) / f"urdfcal-mutation-{digest.hexdigest()[:16]}"
        if not (self.tree / "done").exists():
            shutil.rmtree(self.tree, ignore_errors=True)
            _copy(ROOT, self.tree)
            started = time.monotonic()
            print(f"running the tests with coverage in {self.tree} ...", flush=True)
            command = [sys.executable, "-m", "pytest", "-q", "-n", str(processes), "-p", "no:cacheprovider"]
            command += ["--cov=urdfcal", "--cov-context=test", "--cov-report=", "--junitxml=junit.xml", *tests]
            ended = subprocess.run(command, cwd=self.tree, env=_environment(self.tree), capture_output=True, text=True)
            if ended.returncode not in (0, 1):
                raise SystemExit(f"the tests do not run:\n{ended.stdout[-3000:]}\n{ended.stderr[-3000:]}")
            print(f"{ended.stdout.strip().splitlines()[-1]}  ({time.monotonic() - started:.0f} s)")
            compiling = ["-m", "compileall", "-q", "--invalidation-mode", "unchecked-hash", PACKAGE]
            subprocess.run([sys.executable, *compiling], cwd=self.tree, check=True)
            (self.tree / "done").touch()
        self.durations = self._read_durations()
        self._contexts = self._read_contexts()

    def _read_durations(self) -> dict[str, float]:
        """Seconds of every test that passed."""
        passed = {}
        for case in ElementTree.parse(self.tree / "junit.xml").iter("testcase"):  # noqa: S314  # our own
            if not len(case) or {child.tag for child in case} <= {"system-out", "system-err", "properties"}:
                module, parts = "", case.attrib["classname"].split(".")  # a test's class follows its module
                while not (self.tree / f"{module}.py").is_file():
                    module = f"{module}/{parts.pop(0)}".removeprefix("/")
                passed["::".join([f"{module}.py", *parts, case.attrib["name"]])] = float(case.attrib["time"])
        return passed

    def _read_contexts(self) -> dict[str, dict[int, list[str]]]:
        from coverage import CoverageData  # type: ignore[attr-defined]  # coverage.py beside this file is another

        data = CoverageData(basename=str(self.tree / ".coverage"))
        data.read()
        files = ((file, file.rpartition(f"/{PACKAGE}/")[2]) for file in data.measured_files())
        return {path: data.contexts_by_lineno(file) for file, path in files}

    @cached_property
    def _users(self) -> dict[str, list[tuple[str, range]]]:
        """The bodies of the functions that use a name; of what is bound from it at a module's level, too."""
        users: defaultdict[str, list[tuple[str, range]]] = defaultdict(list)
        derived: defaultdict[str, set[str]] = defaultdict(set)
        for file in (ROOT / PACKAGE).rglob("*.py"):
            path, tree = file.relative_to(ROOT / PACKAGE).as_posix(), ast.parse(file.read_text(encoding="utf-8"))
            for node in ast.walk(tree):
                if isinstance(node, ast.FunctionDef):
                    body = range(node.body[0].lineno, (node.end_lineno or 0) + 1)
                    for name in _loaded(node):
                        users[name].append((path, body))
            for statement in tree.body:
                for name in _loaded(statement) if _bound(statement) else ():
                    derived[name] |= _bound(statement)
        for _ in range(3):
            for name, others in derived.items():
                users[name] += [user for other in others for user in users[other] if user not in users[name]]
        return users

    def tests(self, mutant: Mutant, budget: float) -> tuple[list[str], int]:
        """The tests to run, the likeliest and quickest first, and how many there are beyond the budget."""
        places = [(mutant.path, mutant.lines)]
        for name in mutant.names:
            private = name.startswith("_")
            places += [user for user in self._users[name] if not private or user[0] == mutant.path]
        reaching = {
            context.rpartition("|")[0]
            for path, lines in places
            for line, contexts in self._contexts.get(path, {}).items()
            if line in lines
            for context in contexts
        }
        own = Path(mutant.path)

        def rank(test: str) -> tuple[int, float]:
            file = Path(test.partition("::")[0])
            stem = file.stem.removeprefix("test_")
            near = 0 if stem == own.stem else 1 if file.parent == Path("tests") / own.parent else 2
            return near, self.durations[test]

        ordered = sorted((test for test in reaching if test in self.durations), key=rank)
        spent = np.cumsum([self.durations[test] for test in ordered])
        count = max(1, int(np.searchsorted(spent, budget))) if ordered else 0
        return ordered[:count], len(ordered) - count


def _loaded(node: ast.AST) -> set[str]:
    return {n.id for n in ast.walk(node) if isinstance(n, ast.Name)} | {
        n.attr for n in ast.walk(node) if isinstance(n, ast.Attribute)
    }


def _copy(source: Path, target: Path) -> None:
    target.mkdir()
    for name in (PACKAGE, "tests", "robots"):
        ignored = shutil.ignore_patterns("__pycache__") if source == ROOT else None
        shutil.copytree(source / name, target / name, ignore=ignored)
    for name in ("README.md", "pyproject.toml"):
        shutil.copy2(source / name, target / name)


def _environment(tree: Path) -> dict[str, str]:
    one = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}
    return {**os.environ, **one, "PYTHONPATH": str(tree), "PYTHONHASHSEED": "0"}


# --- Running mutants --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """What became of a mutant: killed by a failure or by its time, survived, or reached by no test."""

    mutant: Mutant
    word: str
    detail: str
    seconds: float

    @property
    def killed(self) -> bool:
        return self.word in ("killed", "timeout")


class Worker:
    """A copy of the repository, and a process that forks for each mutant."""

    def __init__(self, baseline: Baseline, number: int) -> None:
        self.baseline = baseline
        self.tree = Path(tempfile.mkdtemp(prefix=f"urdfcal-mutant-{number}-"))
        self.tree.rmdir()
        _copy(baseline.tree, self.tree)
        command = [sys.executable, __file__, "--serve", str(self.tree)]
        environment = {**_environment(self.tree), "PYTHONDONTWRITEBYTECODE": "1"}
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, cwd=self.tree
        )

    def close(self) -> None:
        if self._process.stdin is not None:
            self._process.stdin.close()
        self._process.wait()
        shutil.rmtree(self.tree, ignore_errors=True)

    def check(self) -> None:
        """Without a mutant, tests must pass here.

        Raises:
            SystemExit: they do not.
        """
        quick = sorted(self.baseline.durations, key=lambda test: self.baseline.durations[test])[:100:10]
        answer = self._ask(quick, 300.0)
        if answer["code"] != 0:
            raise SystemExit(f"without any mutant tests fail in {self.tree}: {answer}")

    def run(self, mutant: Mutant, budget: float) -> Outcome:
        tests, more = self.baseline.tests(mutant, budget)
        if not tests:
            return Outcome(mutant, "unreached", "no test reaches it", 0.0)
        file = self.tree / PACKAGE / mutant.path
        compiled = Path(importlib.util.cache_from_source(str(file)))
        source, code = file.read_bytes(), compiled.read_bytes()
        first, last = mutant.span
        started = time.monotonic()
        try:
            file.write_bytes(source[:first] + mutant.new.encode() + source[last:])
            compiled.unlink()
            expected = sum(self.baseline.durations[test] for test in tests)
            answer = self._ask(tests, _START + _SLACK * expected)
        finally:
            file.write_bytes(source)
            compiled.write_bytes(code)
        seconds = time.monotonic() - started
        if answer["code"] is None:
            return Outcome(mutant, "timeout", "", seconds)
        if answer["code"] == 5:
            raise SystemExit(f"no test was collected for {mutant}: {tests[:3]}")
        if answer["code"]:
            return Outcome(mutant, "killed", answer["failed"] or f"pytest ended with {answer['code']}", seconds)
        return Outcome(mutant, "survived", f"{len(tests)} tests" + (f", {more} not run" if more else ""), seconds)

    def _ask(self, tests: Sequence[str], timeout: float) -> dict[str, Any]:
        if self._process.stdin is None or self._process.stdout is None:
            raise RuntimeError("the worker has no pipes")
        self._process.stdin.write(json.dumps({"tests": tests, "timeout": timeout}) + "\n")
        self._process.stdin.flush()
        answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        return answer


def serve(tree: Path) -> None:
    """Fork a pytest for every line on standard input; answer with its exit code and the test that failed."""
    for name in _PRELOADED:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    importlib.import_module("pytest")
    answers = os.fdopen(os.dup(1), "w")
    log = os.open(tree / "log", os.O_WRONLY | os.O_CREAT)
    os.dup2(log, 1)
    for line in sys.stdin:
        request = json.loads(line)
        reading, writing = os.pipe()
        child = os.fork()
        if not child:
            os.close(reading)
            _run_tests(tree, request["tests"], log, writing)
        os.close(writing)
        failed, code = "", None
        deadline = time.monotonic() + request["timeout"]
        while (left := deadline - time.monotonic()) > 0.0:
            ready = select.select([reading], [], [], left)[0]
            text = os.read(reading, 65536).decode() if ready else ""
            failed += text
            if ready and not text:
                break
        else:
            code = -1
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL if code else 0)
        status = os.waitpid(child, 0)[1]
        ended = os.waitstatus_to_exitcode(status)
        with contextlib.suppress(ProcessLookupError):  # what its tests left running
            os.killpg(child, signal.SIGKILL)
        os.close(reading)
        answers.write(json.dumps({"code": None if code else ended, "failed": failed.strip()}) + "\n")
        answers.flush()


def _run_tests(tree: Path, tests: list[str], log: int, writing: int) -> None:
    import pytest

    os.setpgid(0, 0)
    os.set_inheritable(writing, False)
    os.ftruncate(log, 0)
    os.lseek(log, 0, os.SEEK_SET)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(log, 2)
    resource.setrlimit(resource.RLIMIT_DATA, (_MEMORY, _MEMORY))

    class Recorder:
        def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
            if report.failed:
                os.write(writing, f"{report.nodeid}\n".encode())

    options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:cov", "--hypothesis-seed=0"]
    code = 3
    try:
        code = int(pytest.main([*options, f"--basetemp={tree / 'tmp'}", *tests], plugins=[Recorder()]))
    finally:
        os._exit(code)


# --- The run ----------------------------------------------------------------------------------------------------------


def run_all(
    mutants: Sequence[Mutant], baseline: Baseline, processes: int, budget: float, deadline: float
) -> list[Outcome]:
    queue, outcomes, lock = iter(mutants), list[Outcome](), threading.Lock()

    def work(number: int) -> None:
        with contextlib.closing(Worker(baseline, number)) as worker:
            worker.check()
            while time.monotonic() < deadline:
                with lock:
                    mutant = next(queue, None)
                if mutant is None:
                    return
                outcome = worker.run(mutant, budget)
                with lock:
                    outcomes.append(outcome)
                    count = f"{len(outcomes):5}/{len(mutants)}"
                    print(f"{count}  {outcome.word:9} {outcome.seconds:5.1f} s  {mutant}", flush=True)

    with ThreadPoolExecutor(processes) as pool:
        for ended in [pool.submit(work, number) for number in range(processes)]:
            ended.result()
    return outcomes


def report(name: str, mutants: Sequence[Mutant], outcomes: Sequence[Outcome]) -> bool:
    """Print a population's survivors and its score."""
    mine = [outcome for outcome in outcomes if outcome.mutant in set(mutants)]
    counted = [outcome for outcome in mine if outcome.mutant.key not in EQUIVALENT]
    print(f"\n{name}: survivors")
    for outcome in sorted(mine, key=lambda o: (o.mutant.path, o.mutant.line)):
        if not outcome.killed:
            note = " (known to be equivalent)" if outcome not in counted else ""
            print(f"  {outcome.mutant}  [{outcome.detail}]{note}")
    for outcome in mine:
        if outcome.killed and outcome not in counted:
            print(f"  not equivalent after all: {outcome.mutant}  [{outcome.detail}]")
    killed = sum(outcome.killed for outcome in counted)
    stuck = sum(outcome.word == "timeout" for outcome in counted)
    if not counted:
        print(f"{name}: no mutants")
        return True
    score, required = killed / len(counted), REQUIRED[name]
    word = "pass" if score >= required else "FAIL"
    left = len(mutants) - len(mine)
    print(
        f"{name}: {killed} of {len(counted)} killed ({stuck} by their time), {score:.1%} (required: {required:.0%}): "
        f"{word}" + (f"; {left} not run for lack of time" if left else "")
    )
    return score >= required


def populations(arguments: argparse.Namespace) -> dict[str, list[Mutant]]:
    mutants = all_mutants(arguments.only)
    rng = np.random.default_rng(arguments.seed)

    def drawn(some: list[Mutant], most: int | None) -> list[Mutant]:
        return [some[i] for i in rng.permutation(len(some))[: most if most is not None else len(some)]]

    gates = drawn([m for m in mutants if m.gate], arguments.sample)
    others = drawn([m for m in mutants if m.other and not m.gate], arguments.sample or SAMPLE)
    return {"gates": gates, "others": others}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", action="append", default=[], metavar="PATH", help="file or folder of the package")
    parser.add_argument("--tests", action="append", default=[], metavar="PATH", help="run only these tests")
    parser.add_argument("--sample", type=int, metavar="N", help="at most so many mutants of each population")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--time-limit", type=float, default=60.0, metavar="MINUTES")
    parser.add_argument("--budget", type=float, default=20.0, metavar="S", help="of tests for each mutant")
    parser.add_argument("--list", action="store_true", help="list the mutants, run nothing")
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve:
        serve(arguments.serve)
        return 0
    deadline = time.monotonic() + 60.0 * arguments.time_limit
    chosen = populations(arguments)
    if arguments.list:
        for name, mutants in chosen.items():
            print(f"{name}: {len(mutants)}")
            for mutant in sorted(mutants, key=lambda m: (m.path, m.line)):
                print(f"  {mutant}")
        return 0
    baseline = Baseline(arguments.processes, arguments.tests)
    every = [mutant for mutants in chosen.values() for mutant in mutants]
    shuffled = [every[i] for i in np.random.default_rng(arguments.seed).permutation(len(every))]
    outcomes = run_all(shuffled, baseline, arguments.processes, arguments.budget, deadline)
    passed = [report(name, mutants, outcomes) for name, mutants in chosen.items()]
    return int(not all(passed))


if __name__ == "__main__":
    sys.exit(main())
