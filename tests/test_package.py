"""The package stands alone, its names mean one thing, its files stay small, and its docstrings open plainly."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import urdfcal

if TYPE_CHECKING:
    from collections.abc import Iterator

PACKAGE = Path(urdfcal.__file__).parent
METHOD = PACKAGE / "METHOD.md"
LONGEST_FILE, LONGEST_LINE = 400, 120
# No reader of an installed package has these.
ELSEWHERE = re.compile(r"\bDESIGN\b|\.\./shared|shared/data")
CITATION = re.compile(r"\bMETHOD\s+(\d+)")
# A full stop and a capital after it, sources in brackets left out: "Acta Cryst. A32".
BRACKETS = re.compile(r"\([^)]*\)")
SECOND_SENTENCE = re.compile(r"[\w)`\]][.!?] +[A-Z]")
SECTION = re.compile(r"^## (\d+) ", re.MULTILINE)


def sources() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def named(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def lines_with(pattern: re.Pattern[str]) -> Iterator[str]:
    for path in (*sources(), METHOD):
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            if pattern.search(line):
                yield f"{named(path)}:{number}: {line.strip()}"


def class_names(tree: ast.Module) -> set[str]:
    """Classes and, as they stand for types as well, names in CamelCase that are assigned."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            names.add(node.name)
        for target in [*getattr(node, "targets", []), getattr(node, "target", None)]:
            if (
                isinstance(target, ast.Name)
                and re.fullmatch(r"_?[A-Z]+[a-z]\w*", target.id)
                and "_" not in target.id[1:]
            ):
                names.add(target.id)
    return names


def public_definitions(node: ast.AST, prefix: str = "") -> Iterator[tuple[str, ast.AST]]:
    """Public classes, functions and methods, and the module itself."""
    if isinstance(node, ast.Module):
        yield "(module)", node
    for child in getattr(node, "body", []):
        if isinstance(child, (ast.ClassDef, ast.FunctionDef)) and not child.name.startswith("_"):
            yield prefix + child.name, child
            if isinstance(child, ast.ClassDef):
                yield from public_definitions(child, f"{prefix}{child.name}.")


def docstring_openings() -> Iterator[tuple[str, str]]:
    """Where each public docstring is, and its first line."""
    for path in sources():
        for name, node in public_definitions(parsed(path)):
            text = ast.get_docstring(node, clean=True)  # type: ignore[arg-type]
            if text:
                yield f"{named(path)}: {name}", text.splitlines()[0]


def test_no_file_of_the_package_points_to_documents_that_are_not_in_it() -> None:
    found = list(lines_with(ELSEWHERE))
    assert not found, "\n".join(found)


def test_the_method_has_the_sections_that_comments_cite() -> None:
    sections = SECTION.findall(METHOD.read_text(encoding="utf-8"))
    assert sections == [str(number) for number in range(1, len(sections) + 1)]
    cited = {number: path for path in sources() for number in CITATION.findall(path.read_text(encoding="utf-8"))}
    assert {number: named(path) for number, path in cited.items() if number not in sections} == {}


def test_each_class_name_has_one_meaning() -> None:
    homes: defaultdict[str, list[str]] = defaultdict(list)
    for path in sources():
        for name in class_names(parsed(path)):
            homes[name].append(named(path))
    twice = [f"{name}: {', '.join(files)}" for name, files in homes.items() if len(files) > 1]
    assert not twice, "\n".join(twice)


def test_no_file_is_longer_than_one_thought() -> None:
    lengths = {named(path): len(path.read_text(encoding="utf-8").splitlines()) for path in sources()}
    long = [f"{name}: {length} lines" for name, length in lengths.items() if length > LONGEST_FILE]
    assert not long, "\n".join(long)


def test_public_docstrings_open_with_one_sentence_on_one_line() -> None:
    odd = [
        f"{where}: {line}"
        for where, line in docstring_openings()
        if len(line) > LONGEST_LINE
        or not line.endswith((".", ". [m]", ". [px]"))
        or SECOND_SENTENCE.search(BRACKETS.sub("", line))
    ]
    assert not odd, "\n".join(odd)


def test_the_rules_have_something_to_judge() -> None:
    assert len(sources()) > 50
    assert len(list(docstring_openings())) > 300
