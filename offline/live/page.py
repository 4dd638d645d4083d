"""The page of a map of drives under way: the newest map, for browsers on the same computer only."""

import base64
import hashlib
import json
import re
import secrets
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from groundsbot.calib.foundation import printable
from groundsbot.offline.live.live_map import Update
from groundsbot.offline.live.ports import LOCAL_HOSTS, listen
from groundsbot.offline.report import asset, component_figures

if TYPE_CHECKING:
    from starlette.types import ASGIApp

_ASSETS: Final = "groundsbot.offline.live.assets"
_SCRIPTS: Final = ("plots.js", "map.js")  # of the report
_HEADERS: Final = {
    "cache-control": "no-store",
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}
_MOST_REQUESTS: Final = 32  # at a time
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


class LivePage(NamedTuple):
    """A page that is served.

    Attributes:
        url: its address, with the token that opens it.
        state: what it shows.
    """

    url: str
    state: NewestState


@contextmanager
def serve_page(port: int) -> Iterator[LivePage]:
    """Serve the page in a thread while the block runs.

    Args:
        port: on this computer's own address; 0 for any that is free.

    Raises:
        OfflineError: the port is in use.
    """
    import uvicorn

    listener = listen(port, "--page")
    token, state = secrets.token_urlsafe(16), NewestState()
    config = uvicorn.Config(
        make_app(state, token),
        http="h11",
        ws="none",
        lifespan="off",
        log_config=None,
        access_log=False,
        server_header=False,
        limit_concurrency=_MOST_REQUESTS,
        timeout_keep_alive=5,
        h11_max_incomplete_event_size=16 << 10,
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, args=([listener],), name="page", daemon=True)
    thread.start()
    try:
        yield LivePage(f"http://localhost:{listener.getsockname()[1]}/?token={token}", state)
    finally:
        server.should_exit = True
        thread.join(_END_LIMIT_S)
        listener.close()


def make_app(state: NewestState, token: str) -> "ASGIApp":
    """Return the application, which answers only requests with the token that name this computer."""
    from plotly.offline import get_plotlyjs
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import HTMLResponse, PlainTextResponse, Response
    from starlette.routing import Route

    html, policy = _html(token)

    def answer(request: Request) -> Response:
        host = re.sub(r":\d*$", "", request.headers.get("host", "").lower())
        given = request.query_params.get("token", "")
        if host not in LOCAL_HOSTS or not secrets.compare_digest(given.encode(), token.encode()):
            return PlainTextResponse("open the page with the whole address that `live` printed", 403, _HEADERS)
        if request.url.path == "/plotly.js":
            return Response(get_plotlyjs(), 200, _HEADERS, "text/javascript")
        if request.url.path == "/":
            return HTMLResponse(html, 200, {**_HEADERS, "content-security-policy": policy})
        after = request.query_params.get("after", "")
        text = state.as_json(int(after) if re.fullmatch(r"\d{1,9}", after) else -1)
        return Response(None, 204, _HEADERS) if text is None else Response(text, 200, _HEADERS, "application/json")

    return Starlette(routes=[Route(path, answer, methods=["GET"]) for path in ("/", "/state", "/plotly.js")])


def _html(token: str) -> tuple[str, str]:
    """Return the page, and a policy under which nothing runs or loads but its own scripts and states."""
    folder = files(_ASSETS)
    texts = {name: folder.joinpath(name).read_text(encoding="utf-8") for name in ("page.html", "page.css", "page.js")}
    script = '"use strict";\n(() => {\n' + "".join(map(asset, _SCRIPTS)) + texts["page.js"] + "})();"
    html = texts["page.html"].replace("{style}", asset("page.css") + texts["page.css"])
    html = html.replace("{token}", token).replace("{script}", script)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    # Plotly writes styles of its own.
    policy = (
        f"default-src 'none'; script-src 'self' 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data: blob:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return html, policy
