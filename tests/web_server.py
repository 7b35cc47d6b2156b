"""Web servers in threads, for tests: files of a folder with byte ranges, answers that a test writes, and S3."""

import contextlib
import http.server
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest


class Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_GET(self):
        self.server.asked.append((self.command, self.path, dict(self.headers)))
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.server.answer(self)

    do_HEAD = do_PUT = do_GET

    def give(self, data: bytes, status: int = 200, **headers: str) -> None:
        """An answer with a body of its true length, if `headers` say nothing else."""
        self.send_response(status)
        for name, value in {"Content_Length": str(len(data)), **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def log_message(self, *_):
        pass


def give_files(find):
    """An answer that gives the file which `find` has for a path (None: there is none), or the part asked for."""

    def answer(request: Handler) -> None:
        path = find(unquote(urlsplit(request.path).path).lstrip("/"))
        if path is None or not path.is_file():
            return request.give(b"no such file", 404)
        data = path.read_bytes()
        part = re.fullmatch(r"bytes=(\d+)-(\d+)", request.headers.get("Range", ""))
        if part is None:
            return request.give(data)
        start, end = int(part[1]), min(int(part[2]) + 1, len(data))
        if start >= len(data):
            return request.give(b"", 416)
        return request.give(data[start:end], 206, Content_Range=f"bytes {start}-{end - 1}/{len(data)}")

    return answer


@contextlib.contextmanager
def serving(answer):
    """A server whose `url` answers each request with `answer(request)`, and keeps what was `asked`."""
    if isinstance(answer, Path):
        folder = answer
        answer = give_files(lambda path: folder / path)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    server.answer, server.asked, server.url = answer, [], f"http://127.0.0.1:{server.server_port}"
    threading.Thread(target=server.serve_forever, args=[0.01], daemon=True).start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()


@contextlib.contextmanager
def serving_s3(bucket: str) -> Iterator[dict[str, Any]]:
    """An S3 server with an empty bucket; gives the options that readers and writers need for it."""
    s3fs = pytest.importorskip("s3fs")
    server = pytest.importorskip("moto.server").ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    options = {"key": "someone", "secret": "a/very-secret", "client_kwargs": {"use_ssl": False}}
    options["endpoint_url"] = "http://{}:{}".format(*server.get_host_and_port())
    s3fs.S3FileSystem(**options, skip_instance_cache=True).mkdir(bucket)
    yield options
    server.stop()
