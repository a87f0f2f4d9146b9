"""A page with a server of its own."""

from __future__ import annotations

import contextlib
import socket
import sys

import viser

from dro_grasp.errors import OptionError

HOST = "127.0.0.1"
"""Nobody else on the network can connect."""
PORTS = range(1, 65536)


class ServedPage:
    """What viewer and studio share: a running server; `stop()` ends it."""

    def __init__(self, port: int, host: str) -> None:
        """Start serving.

        Args:
            port: The next free one is taken.
            host: Only this machine, or 0.0.0.0 to let the network in.

        Raises:
            OptionError: There is no such port, or no address of this machine is called so.
        """
        if port not in PORTS:
            raise OptionError(f"port is {port}; give a number from {PORTS[0]} to {PORTS[-1]}, for example --port 8080")
        try:
            # viser would look for a free port for ever.
            socket.create_server((host, 0)).close()
        except OSError as error:
            raise OptionError(f"this machine cannot serve at '{host}' ({error}); give --host {HOST} for this machine alone, or "
                              "0.0.0.0 for the network") from error
        # The server prints a banner on stdout, where commands promise a table or one JSON object.
        with contextlib.redirect_stdout(sys.stderr):
            self.server = viser.ViserServer(host=host, port=port, verbose=False)

    @property
    def url(self) -> str:
        """Where to point the browser."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def stop(self) -> None:
        """Stop serving and free the port."""
        self.server.stop()


def serve(page: ServedPage) -> None:
    """Say where the page is, and serve it until Ctrl-C."""
    print(f"viewer: {page.url} (Ctrl-C ends it)", file=sys.stderr, flush=True)
    try:
        page.server.sleep_forever()
    except KeyboardInterrupt:
        pass
    finally:
        page.stop()
