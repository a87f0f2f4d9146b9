"""Web pages with their own server."""

from __future__ import annotations

import contextlib
import socket
import sys

import viser

from dro_grasp.errors import OptionError

HOST = "127.0.0.1"
"""Default address: only this machine can connect."""
PORTS = range(1, 65536)
"""Valid TCP ports."""


class ServedPage:
    """A page that is being served; `stop()` ends it."""

    def __init__(self, port: int, host: str) -> None:
        """Start serving.

        Args:
            port: Port to serve on; if it is taken, the next free one.
            host: Address to serve at; 0.0.0.0 serves the whole network.

        Raises:
            OptionError: The port is invalid, or the host is no address of this machine.
        """
        if port not in PORTS:
            raise OptionError(f"port is {port}; give a number from {PORTS[0]} to {PORTS[-1]}, for example --port 8080")
        try:
            # viser would search for a free port forever.
            socket.create_server((host, 0)).close()
        except OSError as error:
            raise OptionError(f"this machine cannot serve at '{host}' ({error}); give --host {HOST} for this machine only, or "
                              "0.0.0.0 for the whole network") from error
        # viser prints a banner to stdout, which is reserved for tables and JSON.
        with contextlib.redirect_stdout(sys.stderr):
            self.server = viser.ViserServer(host=host, port=port, verbose=False)

    @property
    def url(self) -> str:
        """Address of the page for a browser."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def stop(self) -> None:
        """Stop serving and free the port."""
        self.server.stop()


def serve(page: ServedPage) -> None:
    """Print the address of the page, and serve it until Ctrl-C."""
    print(f"viewer: {page.url} (Ctrl-C stops it)", file=sys.stderr, flush=True)
    try:
        page.server.sleep_forever()
    except KeyboardInterrupt:
        pass
    finally:
        page.stop()
