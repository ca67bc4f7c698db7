"""A server for the page, on this machine alone: it listens on the loopback, and answers this page and nobody else's.

A page of somebody else that is open in the same browser can send requests here, too. Those that come under another
host's name are refused, since that may have been bound to this address, and so are those that another page sent.
"""

from __future__ import annotations

import errno
import json
import os
import socketserver
import sys
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from typing import Any

from hrlspec.run.errors import UserError
from hrlspec.run.play.game import Busy
from hrlspec.run.play.requests import RequestError, read_json
from hrlspec.spec import SpecError

LOOPBACK = "127.0.0.1"
MOST_BODY = 64_000
"""Bytes of a request's body."""

Answer = Callable[[Mapping[str, Any]], Mapping[str, Any]]
"""From one JSON object to another; raises `RequestError`, `SpecError` or `Busy`."""


class Server(socketserver.ThreadingTCPServer):
    """Listens from the beginning, and answers while ``serve_forever`` runs.

    Args:
        port: 0 for any that is free.

    Attributes:
        page: UTF-8 text of the page.
        answers: what is done with a request's object, by path.

    Raises:
        UserError: the port cannot be had.
    """

    allow_reuse_address = os.name == "posix"  # elsewhere two could listen on one port
    daemon_threads = True

    def __init__(self, port: int) -> None:
        self.page = b""
        self.answers: Mapping[str, Answer] = {}
        try:
            super().__init__((LOOPBACK, port), _Handler)
        except OSError as error:
            why = "it is in use" if error.errno == errno.EADDRINUSE else error.strerror
            raise UserError(f"--port {port}: {why}; choose another, or 0 for any that is free") from error

    @property
    def hosts(self) -> tuple[str, ...]:
        """Names under which it is asked for, with the port unless it is HTTP's own."""
        port = "" if self.server_address[1] == 80 else f":{self.server_address[1]}"
        return LOOPBACK + port, "localhost" + port

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Shows what is a mistake of this program; who went away, or said nothing for too long, is none."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


class _Refused(Exception):
    """A request that is not answered, and the status that says why."""

    def __init__(self, status: HTTPStatus, message: str) -> None:
        super().__init__(message)
        self.status = status


class _Handler(BaseHTTPRequestHandler):
    server: Server
    server_version, sys_version = "hrlspec", ""
    timeout = 10  # seconds, for each part of a request to come

    def do_GET(self) -> None:
        """The page."""
        self._answer(self._page)

    def do_POST(self) -> None:
        """An answer in JSON."""
        self._answer(self._object)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing is logged."""

    def _page(self) -> tuple[str, bytes]:
        if self.path != "/":
            raise _Refused(HTTPStatus.NOT_FOUND, "there is nothing here")
        return "text/html", self.server.page

    def _object(self) -> tuple[str, bytes]:
        if self.headers.get("Origin") not in [f"http://{host}" for host in self.server.hosts]:
            raise _Refused(HTTPStatus.FORBIDDEN, "another page sent this")
        if self.path not in self.server.answers:
            raise _Refused(HTTPStatus.NOT_FOUND, "there is nothing here")
        if self.headers.get_content_type() != "application/json":
            raise _Refused(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "expected JSON")
        answer = self.server.answers[self.path](read_json(self._body()))
        return "application/json", json.dumps(answer, separators=(",", ":"), allow_nan=False).encode()

    def _body(self) -> bytes:
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit()):
            raise _Refused(HTTPStatus.LENGTH_REQUIRED, "how long is the body?")
        if len(length) > len(str(MOST_BODY)) or int(length) > MOST_BODY:
            raise _Refused(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"a body has {MOST_BODY} bytes at most")
        return self.rfile.read(int(length))

    def _answer(self, find: Callable[[], tuple[str, bytes]]) -> None:
        """Answers, or says why not."""
        try:
            if self.headers.get("Host") not in self.server.hosts:
                raise _Refused(HTTPStatus.MISDIRECTED_REQUEST, f"this is {self.server.hosts[0]}")
            self._send(HTTPStatus.OK, *find())
        except _Refused as refusal:
            self._explain(refusal.status, str(refusal))
        except SpecError as error:
            self._explain(HTTPStatus.UNPROCESSABLE_ENTITY, error.message, line=error.line, column=error.column)
        except RequestError as error:
            self._explain(HTTPStatus.UNPROCESSABLE_ENTITY, str(error))
        except Busy as error:
            self._explain(HTTPStatus.SERVICE_UNAVAILABLE, str(error))
        except OSError:
            raise
        except Exception as error:
            self._explain(HTTPStatus.INTERNAL_SERVER_ERROR, f"a mistake in hrlspec: {type(error).__name__}")
            raise

    def _explain(self, status: HTTPStatus, message: str, **where: int | None) -> None:
        self._send(status, "application/json", json.dumps({"message": message, **where}).encode())

    def _send(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self.send_response(status)
        for name, value in (
            ("Content-Type", f"{kind}; charset=utf-8"),
            ("Content-Length", str(len(body))),
            ("Cache-Control", "no-store"),
            ("Content-Security-Policy", "frame-ancestors 'none'"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("X-Content-Type-Options", "nosniff"),
        ):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)
