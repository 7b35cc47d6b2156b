"""A bad network: a proxy before an HTTP server that spoils chosen requests; in this process, or as a program.

python -m tests.faults.proxy 127.0.0.1:9000        # prints its own port; POST /__faults__ sets what it spoils
"""

from __future__ import annotations

import http.client
import http.server
import json
import random
import sys
import threading
import time
import urllib.parse
from collections.abc import Callable

FAULTS = ("drop", "delay", "cut", "corrupt", "500", "503", "403")
"""No answer at all; an answer two seconds late; half of it; a flipped bit in it; errors."""
_WORDS = {"500": "InternalError", "503": "SlowDown", "403": "AccessDenied"}


class Proxy:
    """Passes requests on to the server, and spoils those for which `fault(method, path)` names one of FAULTS."""

    def __init__(self, host: str, port: int):
        self.fault: Callable[[str, str], str | None] = lambda method, path: None
        self.requests: list[tuple[str, str, str | None]] = []
        proxy = self

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def log_message(self, *args):
                pass

            def answer(self):
                length = int(self.headers.get("Content-Length") or 0)
                body = self.rfile.read(length)
                path = urllib.parse.unquote(self.path)
                if path == "/__faults__":
                    proxy.spoil(**json.loads(body))
                    return self.reply(200, b"", {})
                kind = proxy.fault(self.command, path)
                proxy.requests.append((self.command, path, self.headers.get("Range")))
                self.close_connection = True
                if kind == "drop":
                    return None
                if kind in _WORDS:
                    word = _WORDS[kind]
                    text = f"<Error><Code>{word}</Code><Message>{word}</Message></Error>".encode()
                    return self.reply(int(kind), text, {})
                if kind == "delay":
                    time.sleep(2)
                inner = http.client.HTTPConnection(host, port, timeout=30)
                headers = {k: v for k, v in self.headers.items() if k.lower() != "connection"}
                inner.request(self.command, self.path, body, headers)
                answer = inner.getresponse()
                data = answer.read()
                inner.close()
                if kind == "corrupt" and data:
                    data = data[:-1] + bytes([data[-1] ^ 1])
                return self.reply(answer.status, data, dict(answer.getheaders()), cut=kind == "cut")

            def reply(self, status, data, headers, cut=False):
                self.send_response(status)
                for name, value in headers.items():
                    if name.lower() not in ("connection", "content-length", "transfer-encoding", "date", "server"):
                        self.send_header(name, value)
                length = headers.get("Content-Length", len(data)) if self.command == "HEAD" else len(data)
                self.send_header("Content-Length", str(length))
                self.send_header("Connection", "close")
                self.end_headers()
                if self.command != "HEAD":
                    self.wfile.write(data[: len(data) // 2] if cut else data)

            do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = answer

        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}"

    def start(self) -> Proxy:
        """Serve in a thread of this process."""
        threading.Thread(target=self.server.serve_forever, daemon=True).start()
        return self

    def spoil(self, kinds: list[str], share: float, seed: int, times: int = 10**9) -> None:
        """Spoil a random share of the requests from now on, at most `times` of them; none with kinds=[]."""
        rng, lock, left = random.Random(seed), threading.Lock(), [times]

        def fault(method: str, path: str) -> str | None:
            with lock:
                if not kinds or left[0] <= 0 or rng.random() >= share:
                    return None
                left[0] -= 1
                return rng.choice(kinds)

        self.fault = fault


def main() -> None:
    host, _, port = sys.argv[1].partition(":")
    proxy = Proxy(host, int(port))
    print(proxy.server.server_address[1], flush=True)
    proxy.server.serve_forever()


if __name__ == "__main__":
    main()
