"""The page of a map of drives under way."""

import json
import re
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Final

from groundsbot.calib.foundation import printable
from groundsbot.calib.web import Access, Endpoint, Guard, PageServer, content_policy, hash_source
from groundsbot.offline.live.live_map import Update
from groundsbot.offline.report import asset, component_figures

if TYPE_CHECKING:
    from starlette.types import ASGIApp

_ASSETS: Final = "groundsbot.offline.live.assets"
_SCRIPTS: Final = ("plots.js", "map.js")  # of the report
_PIECE_BYTES: Final = 1 << 16  # of an answer; the next one is made when the client has taken it
_END_LIMIT_S: Final = 2.0


class NewestState:
    """What the page shows; it is made when a browser asks for it."""

    def __init__(self) -> None:
        """Begin without a map."""
        self._lock = threading.Lock()
        self._number = 0
        self._shown: tuple[Update, dict[str, Any] | None, str, list[str]] = Update(()), None, "No map yet.", []
        self._text: tuple[int, str] = -1, ""

    def show(self, update: Update, document: dict[str, Any] | None, line: str, hints: list[str]) -> None:
        """Replace what is shown.

        Args:
            update: what is known now.
            document: its map, from `map_as_json`; None before anything can be mapped.
            line: the map in one line.
            hints: what is missing.
        """
        with self._lock:
            self._number += 1
            self._shown = update, document, line, hints

    def as_json(self, after: int) -> str | None:
        """Return the state as JSON; None if its number is still `after`."""
        with self._lock:
            number, (update, document, line, hints) = self._number, self._shown
        if number == after:
            return None
        if self._text[0] != number:
            self._text = number, _json_of(number, update, document, line, hints)
        return self._text[1]


def _json_of(number: int, update: Update, document: dict[str, Any] | None, line: str, hints: list[str]) -> str:
    components = []
    if document is not None and update.workings is not None:
        components = component_figures(document, update.workings)
    state = {
        "number": number,
        "line": printable(line),
        "hints": [printable(each) for each in hints],
        "runs": [{"name": printable(run.name), "state": run.state} for run in update.runs],
        "components": components,
    }
    return json.dumps(state, allow_nan=False)


@contextmanager
def serve_page(endpoint: Endpoint) -> Iterator[NewestState]:
    """Serve the page in a thread while the block runs, and give what it shows."""
    state = NewestState()
    # Two programs on one computer have two tokens.
    access = endpoint.access(f"live_{endpoint.listener.getsockname()[1]}")
    server = PageServer(make_app(state, access))
    thread = threading.Thread(target=server.run, args=([endpoint.listener],), name="page", daemon=True)
    thread.start()
    try:
        yield state
    finally:
        server.should_exit = True
        thread.join(_END_LIMIT_S)
        endpoint.listener.close()


def make_app(state: NewestState, access: Access) -> "ASGIApp":
    """Return the application."""
    from plotly.offline import get_plotlyjs
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import HTMLResponse, Response, StreamingResponse
    from starlette.routing import Route

    html, policy = _html()
    plotly = get_plotlyjs().encode()

    def page(_request: Request) -> Response:
        return HTMLResponse(html, headers={"content-security-policy": policy})

    def script(_request: Request) -> Response:
        return StreamingResponse(_pieces(plotly), media_type="text/javascript")

    def newest(request: Request) -> Response:
        after = request.query_params.get("after", "")
        text = state.as_json(int(after) if re.fullmatch(r"\d{1,9}", after) else -1)
        if text is None:
            return Response(None, 204)
        return StreamingResponse(_pieces(text.encode()), media_type="application/json")

    answers = {"/": page, "/plotly.js": script, "/state": newest}
    return Guard(Starlette(routes=[Route(path, answer, methods=["GET"]) for path, answer in answers.items()]), access)


async def _pieces(data: bytes) -> AsyncIterator[bytes]:
    for begin in range(0, len(data), _PIECE_BYTES):
        yield data[begin : begin + _PIECE_BYTES]


def _html() -> tuple[str, str]:
    """Return the page, and a policy under which nothing runs or loads but its own scripts and states."""
    folder = files(_ASSETS)
    texts = {name: folder.joinpath(name).read_text(encoding="utf-8") for name in ("page.html", "page.css", "page.js")}
    script = '"use strict";\n(() => {\n' + "".join(map(asset, _SCRIPTS)) + texts["page.js"] + "})();"
    html = texts["page.html"].replace("{style}", asset("page.css") + texts["page.css"]).replace("{script}", script)
    # Plotly writes styles of its own.
    return html, content_policy(f"'self' {hash_source(script)}", "'unsafe-inline'", "data: blob:")
