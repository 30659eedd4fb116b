"""One language: help texts, messages and docstrings avoid words that only the authors of this library understand.

The glossary of the documentation explains the words to use. To ban a word, add a line to `WORDS`.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FILES = sorted(
    path for folder in ("modgnn_rl", "envs", "trainers", "configs") for path in (ROOT / folder).rglob("*.py")
)

# A pattern that whole words must not match, and what to write instead.
WORDS = {
    r"flown": "rolled out, collected, evaluated",
    r"(policy|expert|model|size|program|who|which) flies": "acts, is rolled out",
    r"how-manyth": "every n-th",
    r"anew": "again, from scratch; recomputed, restarted",
    r"go(es|ing)? on(?! (a|the) )": "resume, continue",
    r"(?<!there )is no (?!longer|more|less|better|worse|way)[a-z]+": "is not a ...",
    r"no number": "NaN or infinite",
    r"drawn (from|for each|at random)|draws (from|at random|seeds|the indices|actions)": "sampled, samples",
    r"touch(es)?": "collide",
    r"held[- ]out": "validation",
    r"(a|the|each|every|one) lot": "a sample",
    r"stretch(es)?": "switching interval, hold steps",
    r"judge[sd]?|blame[sd]?": "evaluate, describe",
    r"of (one|people)'s own|whose own": "your own",
    r"heeds?|heeded": "handle",
    r"films?": "video",
    r"(?<!body to )(?<!body-to-)worlds?(?!-| (size|frame|coordinates))": "environment",
    r"mends?|mended": "fix",
}
PATTERNS = {word: re.compile(rf"\b(?:{word})\b", re.IGNORECASE) for word in WORDS}

NODES = (ast.Module, ast.ClassDef, ast.FunctionDef)


@pytest.mark.parametrize("name", sorted({str(path.relative_to(ROOT)) for path in FILES}))
def test_what_a_file_tells_people_is_in_plain_words(name: str) -> None:
    found = [
        f"line {line}: {match[0]!r} in ...{text[max(0, match.start() - 40) : match.end() + 30]!r}: use {WORDS[word]}"
        for line, text in texts(ast.parse((ROOT / name).read_text(encoding="utf-8")))
        for word, pattern in PATTERNS.items()
        for match in pattern.finditer(text)
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("source", "is_found"),
    [
        ('raise InputError(f"step={step} was not flown, but {other}")', True),
        ('setting(1, "a film of a rollout")', True),
        ('HEADINGS = ["error", "flown"]', True),
        ('def f():\n    """Go on\n    with a run."""', True),
        ('def _f():\n    """Flown."""', False),
        ('derive_seed(seed, "flown")', False),
        ('def f():\n    """Follow the rollout."""', False),
        ("flown = 1  # flown", False),
    ],
)
def test_the_reader_finds_words_where_people_see_them(source: str, is_found: bool) -> None:
    found = [
        text for _, text in texts(ast.parse(source)) if any(map(re.Pattern.search, PATTERNS.values(), [text] * 99))
    ]
    assert bool(found) == is_found


def texts(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the line and the text of the docstrings of public names, and of strings outside docstrings.

    A single word counts in a list of headings, but not as an argument or a key: it may be the name of a random seed.
    """
    yield from _docstrings(tree)
    documented = [node for node in ast.walk(tree) if isinstance(node, NODES) and ast.get_docstring(node)]
    hidden = {id(child) for node in documented for child in ast.walk(node.body[0])}
    names = {
        id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Assign) and "__all__" in ast.unparse(node)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            hidden |= set(map(id, node.values))
            values = [str(value.value) if isinstance(value, ast.Constant) else "X" for value in node.values]
            yield node.lineno, _in_one_line("".join(values))
        elif isinstance(node, (ast.List, ast.Tuple)) and id(node) not in names:
            yield from ((part.lineno, str(part.value)) for part in node.elts if isinstance(part, ast.Constant))
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and " " in node.value
            and id(node) not in hidden
        ):
            yield node.lineno, _in_one_line(node.value)


def _docstrings(node: ast.Module | ast.ClassDef | ast.FunctionDef) -> Iterator[tuple[int, str]]:
    """Yield the docstrings of a module or a class, and of the public classes and functions in it."""
    if docstring := ast.get_docstring(node):
        yield node.body[0].lineno, _in_one_line(docstring)
    for child in node.body:
        if isinstance(child, (ast.ClassDef, ast.FunctionDef)) and not child.name.startswith("_"):
            yield from _docstrings(child)


def _in_one_line(text: str) -> str:
    return " ".join(text.split())
