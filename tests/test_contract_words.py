"""Contract: texts for users and developers avoid words that have no exact meaning here.

A word is in the table if nearly every use of it has a clearer replacement, which the table names.
The test reads docstrings, errors, help and printed texts of the package, and the documentation.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.contract

ROOT = Path(__file__).parents[1]
REPLACEMENTS = {
    r"anew": "again",
    r"asked for": "requested",
    r"beside": "next to, compared with, with",
    r"dull": "overcast",
    r"foreign": "other, unknown",
    r"gives? away": "shows",
    r"held against": "compared with",
    r"(?<!there )is none": "is missing, there is none, not",
    r"lies?|lay": "is, are",
    r"lone": "isolated, single",
    r"mend(?:s|ed|ing)?": "fix, correct",
    r"noughts?": "zeros",
    r"parted": "separated, split",
    r"said|says": "reported, recorded, states",
    r"so many": "this many, the number",
    r"stands(?! for)|stood": "is, was",
    r"strangers?": "other people, unknown",
    r"told": "reported, stated, distinguished",
    r"twins?": "copy, the same",
    r"unsound": "invalid, damaged",
    r"whole": "complete, full, integer",
    r"wild": "gross, far",
}
_WORD = re.compile(rf"\b(?:{'|'.join(REPLACEMENTS)})\b", re.IGNORECASE)
# Names of options, columns and files, quoted in backticks or double quotes, are contracts.
_QUOTED = re.compile(r"`[^`\n]*`")
PAGES = (
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "docs").rglob("*.md")),
)


def _replacement(word: str) -> str:
    return next(
        text for form, text in REPLACEMENTS.items() if re.search(rf"\b(?:{form})\b", word, re.I)
    )


def _found(text: str, line: int = 1) -> Iterator[str]:
    """Yield each word of the table with its line and what to write instead."""
    for match in _WORD.finditer(_QUOTED.sub(lambda code: " " * len(code[0]), text)):
        context = " ".join(text[max(0, match.start() - 30) : match.end() + 30].split())
        if match[0].lower() == "is none" and match[0] != "is none":
            continue  # Python's None
        number = line + text.count("\n", 0, match.start())
        use = _replacement(text[max(0, match.start() - 6) : match.end() + 4])
        yield f"line {number}: ... {context} ...: instead of '{match[0]}' write {use}"


def _texts(path: Path) -> Iterator[tuple[int, str]]:
    """Yield strings with a blank: docstrings and texts, not names or keys."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        text = node.value if isinstance(node, ast.Constant) else None
        if isinstance(text, str) and " " in text.strip():
            yield node.lineno, text


@pytest.mark.parametrize(
    "package",
    sorted(
        path for path in (ROOT / "fieldlum").iterdir() if (path.suffix == ".py" or path.is_dir())
    ),
    ids=lambda path: path.name,
)
def test_texts_of_the_package(package: Path) -> None:
    files = [package] if package.is_file() else sorted(package.rglob("*.py"))
    bad = [
        f"{path.relative_to(ROOT)} {word}"
        for path in files
        for line, text in _texts(path)
        for word in _found(text, line)
    ]
    assert not bad, "\n".join(bad)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_texts_of_the_documentation(page: Path) -> None:
    text = re.sub(r"(?ms)^```.*?^```", lambda m: "\n" * m[0].count("\n"), page.read_text("utf-8"))
    bad = list(_found(text))
    assert not bad, "\n".join(bad)


def test_a_word_is_found_and_a_quoted_name_is_not() -> None:
    assert list(_found("a lone row, and\none beside it")) == [
        "line 1: ... a lone row, and one beside it ...: instead of 'lone' write isolated, single",
        "line 2: ... a lone row, and one beside it ...: instead of 'beside' write next to, "
        "compared with, with",
    ]
    assert not list(_found("`whole` is an option, and Q stands for heat; None if it is None"))


PAGE_PARTS = sorted(
    path
    for path in (ROOT / "fieldlum").rglob("*")
    if path.suffix in (".html", ".js", ".css", ".j2") and path.is_file()
)


@pytest.mark.parametrize("path", PAGE_PARTS, ids=lambda p: p.name)
def test_no_line_of_a_page_is_wider_than_100_columns(path: Path) -> None:
    lines = path.read_text(encoding="utf-8").splitlines()
    assert [number for number, line in enumerate(lines, 1) if len(line) > 100] == []


def test_the_notes_that_name_a_trouble_exist() -> None:
    """`demo --preset hard` recognises a trouble by words of a note."""
    written: list[str] = []
    for path in (p for at in ("learn", "room") for p in (ROOT / "fieldlum" / at).rglob("*.py")):
        nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        texts = (node.value for node in nodes if isinstance(node, ast.Constant))
        written += [text for text in texts if isinstance(text, str)]
    bench = ast.parse((ROOT / "bench" / "hard_campaign.py").read_text(encoding="utf-8"))
    named_by = next(
        ast.literal_eval(node.value)
        for node in bench.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "NAMED_BY"
    )
    absent = {k: v for k, v in named_by.items() if not any(v in text for text in written)}
    assert not absent
