"""Names that the linter does not judge: part of `make lint`.

    python -m tests.project.names

A function is called after what it does (an imperative) or returns (a noun), so a past participle is no name for one:
alone (`settled`), before a preposition (`told_by`) or at the end (`tags_joined`). As an adjective it may stand before a
noun (`weighted_mean`), and predicates (`is_fixed`) and handlers (`on_camera_lost`) may end with one. Public names use
the field's terms, so words that once stood for them are refused. A class name of the packages stands for one thing.
What a docstring lists under Attributes or Args is there.
"""

import ast
import asyncio
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from tests.support.paths import ROOT

PACKAGES: Final = ("offline", "onboard", "calib")
FOLDERS: Final = (*PACKAGES, "fixtures")


def _words(text: str) -> frozenset[str]:
    return frozenset(re.findall(r"\w+", text))


_IRREGULAR: Final = _words(
    "told heard seen held kept hung known shown taken given left lost made built drawn found thrown borne foretold"
    " begun broken chosen driven fallen grown hidden laid led met paid risen said sent spent stood stuck thought"
    " understood won worn written wound swung torn bent brought bought caught dealt dug done eaten forgotten frozen"
    " gone beaten"
)
_NO_PARTICIPLES: Final = _words("need seed feed speed exceed proceed indeed embed unneeded outlined preintegrated")
_FOLLOWERS: Final = _words(
    "by as from in to at out apart on over with without back again anew together alone whole behind twice once of"
)
_GIVEN: Final = frozenset(dir(asyncio.Protocol))  # asyncio calls methods by these names
_PREDICATES: Final = _words("is has are was were can did does should must may needs on")
# Before one at the end, which is then an object or a condition: `reason_not_joined`, `n_lost`, `ratio_to_expected`.
_BEFORE_A_PARTICIPLE: Final = _words("not n of or find to")
# Left column of the table of terms in docs/architecture.md, and words like them.
_PRIVATE_WORDS: Final = _words(
    "askew foretold foretell hung rehung hang lifted snooped told twins untied valley wobble worth rise rival rivals"
    " look looks sighting sightings spread stretch stretches effort workings"
)


def is_participle(word: str) -> bool:
    """Whether a word is a past participle, by its form."""
    regular = len(word) > 4 and word.endswith("ed") and word not in _NO_PARTICIPLES
    return word in _IRREGULAR or regular


def names_after_a_participle(name: str) -> bool:
    """Whether a function's name leaves open what the function does."""
    words = [word for word in name.strip("_").split("_") if word]
    if not words or name.startswith(("__", "test_")) or words[0] in _PREDICATES or name in _GIVEN:
        return False
    if is_participle(words[0]):
        return len(words) == 1 or words[1] in _FOLLOWERS or words[0] == "made"
    return len(words) > 1 and is_participle(words[-1]) and words[-2] not in _BEFORE_A_PARTICIPLE


def private_words(name: str) -> set[str]:
    """Words of a public name that have a term in the field."""
    if name.startswith("_"):
        return set()
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+", name)} & _PRIVATE_WORDS


def documented_names(node: ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    """Names that a class's docstring lists under Attributes, or a function's under Args."""
    section = "Attributes" if isinstance(node, ast.ClassDef) else "Args"
    found = re.search(rf"^{section}:\n((?:    .*\n?|\n)+)", ast.get_docstring(node) or "", re.MULTILINE)
    heads = re.findall(r"^    ([A-Za-z_*][\w, *]*): ", found[1], re.MULTILINE) if found else []
    return [name.strip(" *") for head in heads for name in head.split(",")]


def names_there(node: ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) -> set[str]:
    """Attributes and methods of a class, or parameters of a function."""
    if not isinstance(node, ast.ClassDef):
        given = node.args
        stars = [each for each in (given.vararg, given.kwarg) if each is not None]
        return {each.arg for each in (*given.posonlyargs, *given.args, *given.kwonlyargs, *stars)}
    names = {each.name for each in node.body if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef)}
    for each in ast.walk(node):
        if isinstance(each, ast.Attribute) and isinstance(each.value, ast.Name) and each.value.id == "self":
            names.add(each.attr)
        elif isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store):
            names.add(each.id)
    return names


def complaints(path: Path, top: str) -> Iterator[str]:
    """One line for each name of a file that should be another."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            continue
        where = f"{path.relative_to(ROOT)}:{node.lineno}: {node.name}"
        decorators = {ast.unparse(each).split("(")[0] for each in node.decorator_list}
        if missing := [name for name in documented_names(node) if name not in names_there(node)]:
            yield f"{where}: its docstring tells of {', '.join(missing)}, which it does not have"
        is_value = decorators & {"property", "cached_property", "pytest.fixture"}
        if not isinstance(node, ast.ClassDef) and not is_value and names_after_a_participle(node.name):
            yield f"{where}: is a past participle; name what the function does or returns"
        if top in PACKAGES and (words := private_words(node.name)):
            yield f"{where}: {', '.join(sorted(words))} is no term of the field"


def classes_with_two_meanings() -> Iterator[str]:
    """One line for each class name of the packages that is defined twice."""
    found: dict[str, list[Path]] = defaultdict(list)
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef):
                    found[node.name].append(path.relative_to(ROOT))
    for name, paths in found.items():
        if len(paths) > 1:
            yield f"{name} is a class of {' and of '.join(map(str, paths))}; give one of them a name of its own"


def main() -> int:
    """Prints what it finds; 1 where it finds something."""
    lines = [line for top in FOLDERS for path in sorted((ROOT / top).rglob("*.py")) for line in complaints(path, top)]
    lines += classes_with_two_meanings()
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
