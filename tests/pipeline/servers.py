"""An S3 server of its own on loopback, and one that misbehaves in front of it."""

from __future__ import annotations

import http.client
import os
import threading
import urllib.request
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

SECRET = "never-to-be-seen-4711"
KEY = "AKIANEVERTOBESEEN"


def environment(port, local):
    """What a program needs to reach it."""
    return {
        "AWS_ACCESS_KEY_ID": KEY,
        "AWS_SECRET_ACCESS_KEY": SECRET,
        "AWS_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "RILLE_LOCAL": str(local),
    }


@contextmanager
def s3():
    """A server with the bucket ``bucket``; gives its port."""
    import logging

    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    os.environ.setdefault("AWS_ACCESS_KEY_ID", "moto")  # it wants some itself
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    port = server.get_host_and_port()[1]
    request = urllib.request.Request(f"http://127.0.0.1:{port}/bucket", method="PUT")
    urllib.request.urlopen(request, timeout=20).close()
    try:
        yield port
    finally:
        server.stop()


class Proxy:
    """Passes requests on to a server, but for what ``trouble(method, path, count)`` says.

    It says ``refuse`` (503, not passed on), ``forbid`` (403), ``deafen`` (passed on, but 503 is answered), ``blind``
    (``If-None-Match`` is taken away), ``cut`` (the connection is closed within the answer), or nothing.
    """

    def __init__(self, port, trouble):
        self.upstream, self.trouble = port, trouble
        self.requests, self.ranges, self.troubled = [], [], 0
        self._lock = threading.Lock()
        proxy = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def _pass_on(self):
                proxy._serve(self)

            do_GET = do_PUT = do_POST = do_DELETE = do_HEAD = _pass_on

            def log_message(self, *args):
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.port = self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self):
        self._server.shutdown()
        self._server.server_close()

    def _serve(self, handler):
        body = handler.rfile.read(int(handler.headers.get("Content-Length") or 0))
        with self._lock:
            self.requests.append((handler.command, handler.path))
            self.ranges += handler.headers.get_all("Range", [])
            what = self.trouble(handler.command, handler.path, len(self.requests))
            self.troubled += bool(what)
        headers = {k: v for k, v in handler.headers.items() if k.lower() != "content-length"}
        if what == "blind":
            headers = {k: v for k, v in headers.items() if k.lower() != "if-none-match"}
        status, answered, data = 503, {}, b"<Error><Code>SlowDown</Code></Error>"
        if what == "forbid":
            status, data = 403, b"<Error><Code>InvalidAccessKeyId</Code></Error>"
        elif what != "refuse":
            upstream = http.client.HTTPConnection("127.0.0.1", self.upstream, timeout=30)
            upstream.request(handler.command, handler.path, body, headers)
            response = upstream.getresponse()
            content = response.read()
            if what != "deafen":
                status, data = response.status, content
                skip = ("content-length", "transfer-encoding", "connection", "date", "server")
                answered = {k: v for k, v in response.getheaders() if k.lower() not in skip}
            upstream.close()
        handler.send_response(status)
        for name, value in answered.items():
            handler.send_header(name, value)
        handler.send_header("Content-Length", str(len(data)))
        handler.end_headers()
        if handler.command != "HEAD":
            handler.wfile.write(data[: len(data) // 2] if what == "cut" else data)
        if what == "cut":
            handler.close_connection = True
