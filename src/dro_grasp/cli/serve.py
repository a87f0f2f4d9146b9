"""`dro-grasp serve`: grasps for a robot, over HTTP."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from typing import Annotated

from dro_grasp.cli.inputs import optional

TOKEN = "DRO_GRASP_TOKEN"  # Environment variable of the token, which others cannot read in a list of processes


@dataclass(frozen=True)
class Serve:
    """Answer requests for grasps over HTTP, without the seconds that every start costs. Needs the extra `[apps]`.

    Example: dro-grasp serve --hand my_hand.urdf --port 8090
    """

    hand: tuple[str, ...] = ()  # Names or files of hands that are loaded at once; built-in ones can be asked for besides.
    object: tuple[str, ...] = ()
    """Files or folders of objects that can be asked for by their names; built-in ones, and what is sent, can be besides."""
    host: str = "127.0.0.1"
    """Address to serve at. By default only this machine can connect; 0.0.0.0 serves the whole network and needs a token."""
    port: int = 8090  # Port to serve on.
    token: Annotated[str | None, optional("TOKEN", "DRO_GRASP_TOKEN, or none")] = None
    """What requests must bear: the header `Authorization: Bearer TOKEN`."""
    queue: int = 16  # Requests that may wait; more are refused.
    time_limit: float = 60.0  # A request that is computed for longer is ended [s].
    megabytes: float = 32.0  # Largest request [MB].
    weights: Annotated[str | None, optional("NAME|PATH", "the shipped weights")] = None
    """Name of shipped weights or the path of a weights file."""
    device: str = "cpu"  # Device for the network and the energies: cpu, cuda or cuda:1. Trials always run on the CPU.

    def run(self) -> int:
        """Check, load, and serve until Ctrl-C or SIGTERM."""
        from dro_grasp.extras import require_extra

        require_extra("apps")
        from dro_grasp.apps.server.answering import ServerConfig
        from dro_grasp.apps.server.http_server import Access, listening_socket, serve_grasps
        from dro_grasp.apps.server.request_queue import RequestQueue

        access = Access(self.host, self.token or os.environ.get(TOKEN), self.megabytes)
        with listening_socket(self.host, self.port) as listener:
            config = ServerConfig(self.weights, self.device, self.hand, self.object)
            queue = RequestQueue(config, self.queue, self.time_limit)
            host, port = listener.getsockname()[:2]
            print(f"grasp server: http://{f'[{host}]' if ':' in host else host}:{port}, requests at /docs (Ctrl-C stops it)",
                  file=sys.stderr, flush=True)
            serve_grasps(queue, access, listener)
        return 0
