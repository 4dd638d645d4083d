"""A report as a program reads it."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any


class Read(HTMLParser):
    """Texts, tables by their section, and the elements of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.tables: dict[str, list[list[str]]] = {}
        self._section, self._cell = "", False
        self._stack: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self._stack.append(tag)
        if tag == "section":
            self._section = dict(attrs).get("id") or ""
        elif tag == "div" and dict(attrs).get("id") == "words":
            self._section = "words"
        elif tag == "tr":
            self.tables.setdefault(self._section, []).append([])
        elif tag in ("td", "th"):
            self.tables[self._section][-1].append("")
        elif tag == "p" and self._section == "words":
            self.words.append("")

    def handle_endtag(self, tag: str) -> None:
        while self._stack and self._stack.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        inner = self._stack[-1] if self._stack else ""
        if inner in ("td", "th"):
            self.tables[self._section][-1][-1] += data
        elif inner == "p" and self._section == "words":
            self.words[-1] += data

    def rows(self, key: str) -> list[dict[str, str]]:
        head, *rows = self.tables[key]
        return [dict(zip(head, row, strict=True)) for row in rows]


def data_of(path: Path) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', path.read_text())
    assert found is not None
    data: dict[str, Any] = json.loads(found[1])
    return data
