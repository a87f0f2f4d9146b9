"""Workers on a Ray cluster of any number of machines.

Files travel as bytes, so nodes need no shared folder. Hands and objects named by path must lie at that path on every
node, and every node needs the same version of dro-grasp.
"""

from __future__ import annotations

import os
import socket
import time
from typing import TYPE_CHECKING, Any

from dro_grasp.datasets.engine.pools import Failed, Outcome, Work, attempt
from dro_grasp.datasets.engine.worker import Job, Task, make_shard
from dro_grasp.errors import OptionError

if TYPE_CHECKING:
    import ray

CONNECT_TIME = 5.0
"""Longest wait for a cluster's head to accept a connection [s]. Ours."""
GPU_SHARE = 0.25
"""Share of a GPU for a shard whose energies are computed there. Ours: trials, on the CPU, take most of its time."""
RETRIES = 3
"""Times that Ray starts a shard again elsewhere when its process or node is gone. Ours; a shard depends on its seed alone."""


class RayPool:
    """Tasks of a Ray cluster, one CPU each."""

    def __init__(self, job: Job, workers: int, limit: float, address: str | None = None, work: Work = make_shard) -> None:
        """Join a cluster, or start one of so many workers here; a shard that takes longer than the limit [s] is stopped.

        Args:
            address: Address `host:port` of the cluster's head, or `auto` for the one that runs here; None takes
                RAY_ADDRESS, and without it starts a cluster on this machine.

        Raises:
            OptionError: Ray is not installed, or there is no cluster at the address.
        """
        try:
            import ray
        except ImportError as error:
            raise OptionError("the engine 'ray' needs Ray: pip install 'ray>=2.40'; or use --engine local") from error
        self.limit, self.started_here = limit, False
        if not ray.is_initialized():
            self.started_here = True
            _connect(address or os.environ.get("RAY_ADDRESS"), workers)
        self.ray, self.work = ray, work
        self.job = ray.put(job)
        options: dict[str, Any] = {"num_cpus": 1, "max_retries": RETRIES, "scheduling_strategy": "SPREAD"}
        if job.config.synthesis.device != "cpu":
            options["num_gpus"] = GPU_SHARE
        # Errors come back as values, so Ray retries lost machines and nothing else.
        self.start = ray.remote(**options)(attempt)
        self.running: dict[ray.ObjectRef, tuple[Task, float]] = {}

    @property
    def free(self) -> int:
        """CPUs of the cluster now, less the shards in flight; at least one shard may wait for a node."""
        cpus = max(1, int(self.ray.cluster_resources().get("CPU", 0)))
        return max(0, cpus - len(self.running))

    def submit(self, task: Task) -> None:
        """Hand a shard to the cluster."""
        self.running[self.start.remote(self.work, self.job, task)] = (task, time.monotonic())

    def wait(self, timeout: float) -> list[Outcome]:
        """Finished shards, errors, and shards whose machine is gone for good or that took too long."""
        done, _ = self.ray.wait(list(self.running), num_returns=1, timeout=timeout)
        outcomes = [self._collect(ref) for ref in done]
        for ref in [r for r, (_, since) in self.running.items() if time.monotonic() - since > self.limit]:
            self.ray.cancel(ref, force=True)
            outcomes.append((self.running.pop(ref)[0], Failed(f"took longer than {self.limit:.0f} s", died=True)))
        return outcomes

    def close(self) -> None:
        """Cancel what runs, and leave the cluster if this pool joined it."""
        for ref in self.running:
            self.ray.cancel(ref, force=True)
        if self.started_here:
            self.ray.shutdown()

    def _collect(self, ref: ray.ObjectRef) -> Outcome:
        task = self.running.pop(ref)[0]
        try:
            return task, self.ray.get(ref)
        except self.ray.exceptions.RayError as error:
            return task, Failed(f"its Ray worker was lost ({type(error).__name__})", died=True)


def _connect(address: str | None, workers: int) -> None:
    """Join the cluster at the address, or start one on this machine where there is no address."""
    import ray

    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address is None:
        ray.init(address="local", num_cpus=workers, include_dashboard=False, **quiet)
        return
    try:
        _knock(address)
        ray.init(address=address, **quiet)
    except (OSError, RuntimeError, ValueError) as error:
        raise OptionError(f"no Ray cluster answers at {address} ({error}); start its head with `ray start --head`, and "
                          "give the address that it prints") from error


def _knock(address: str) -> None:
    """Check in seconds that something listens at `host:port`; Ray itself waits for minutes."""
    host, _, port = address.rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host, int(port)), CONNECT_TIME).close()
