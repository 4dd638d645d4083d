"""HTTP server with limits on the number of connections, and on the time that a client takes to ask and to listen."""

import asyncio
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import h11
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

MOST_CONNECTIONS: Final = 64
_ASK_S: Final = 5.0  # until a request is complete
_LISTEN_S: Final = 10.0  # for which data may wait for a client that does not read


class PageProtocol(H11Protocol):
    """One connection, which is cut off if it is one too many, or if its client is too slow."""

    _asking: asyncio.TimerHandle | None = None
    _listening: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override] # as uvicorn has it
        """Begin, or end at once."""
        super().connection_made(transport)
        # Whatever the kernel does not take at once counts as data that wait.
        transport.set_write_buffer_limits(high=0)
        if len(self.connections) > MOST_CONNECTIONS:
            transport.abort()
        else:
            self._asking = self.loop.call_later(_ASK_S, transport.abort)

    def data_received(self, data: bytes) -> None:
        """Take a part of a request; the time for it does not begin again with each part."""
        super().data_received(data)
        is_complete = self.conn.their_state not in (h11.IDLE, h11.SEND_BODY)
        if is_complete and self._asking is not None:
            self._asking.cancel()
            self._asking = None
        elif not is_complete and self._asking is None and not self.transport.is_closing():
            self._asking = self.loop.call_later(_ASK_S, self.transport.abort)

    def pause_writing(self) -> None:
        """Begin to wait for a client that does not read."""
        super().pause_writing()
        self._listening = self.loop.call_later(_LISTEN_S, self.transport.abort)

    def resume_writing(self) -> None:
        """Go on with a client that reads again."""
        super().resume_writing()
        if self._listening is not None:
            self._listening.cancel()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        super().connection_lost(exc)
        for each in (self._asking, self._listening):
            if each is not None:
                each.cancel()


class PageServer(uvicorn.Server):
    """Server that leaves the process's signals alone."""

    def __init__(self, app: ASGIApp) -> None:
        """Prepare to serve an application; a bad request makes no line in the log."""
        config = uvicorn.Config(
            app,
            http=PageProtocol,
            ws="none",
            loop="asyncio",
            lifespan="off",
            log_config=None,
            log_level=logging.CRITICAL,
            access_log=False,
            proxy_headers=False,
            server_header=False,
            backlog=MOST_CONNECTIONS,
            timeout_keep_alive=5,
            h11_max_incomplete_event_size=16 << 10,
        )
        super().__init__(config)

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture none."""
        yield
