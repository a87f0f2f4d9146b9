"""Pools, which work side by side: what every pool does, processes on this machine, a Ray cluster of any size.

Files travel as bytes, so the nodes of a cluster need no shared folder. Hands and objects named by path must lie at that path
on every node, and every node needs the same version of dro-grasp.
"""

from __future__ import annotations

import multiprocessing
import os
import socket
import time
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from pebble import ProcessExpired, ProcessPool

from dro_grasp.errors import ClusterError, OptionError
from dro_grasp.extras import require_extra
from dro_grasp.training.data.engine.shards import Failed, failure_of
from dro_grasp.training.data.engine.worker import Job, make_shards
from dro_grasp.workers import use_one_thread

if TYPE_CHECKING:
    import ray


Work = Callable[[Any, Any], Any]
"""What makes something of the settings that all share and of a task: `make_shards` of a Job and tasks of one hand."""


Outcome = tuple[Any, Any]  # The task, and what was made of it, or Failed


@runtime_checkable
class Pool(Protocol):
    """Something that works side by side."""

    @property
    def free(self) -> int:
        """Number of tasks that it would start at once."""
        ...

    def submit(self, task: Any) -> None:
        """Start a task."""
        ...

    def wait(self, timeout: float) -> list[Outcome]:
        """Tasks that ended, as soon as there is one; none after `timeout` [s]."""
        ...

    def close(self) -> None:
        """Stop everything; tasks in flight are dropped."""
        ...


def attempt(work: Work, job: Any, task: Any) -> Any:
    """What is made of a task; an error becomes a value, as it must not stop the others."""
    try:
        return work(job, task)
    except Exception as error:  # a fault of ours too: `failure_of` names it
        return failure_of(error)


class LocalPool:
    """Processes on this machine. A worker's death costs what it was making, nothing else.

    Each process has a pebble pool of its own. Processes of one pool share a lock, and one that is killed while it hands
    over its shard would keep the lock from the others.
    """

    def __init__(self, job: Any, workers: int, limit: float, work: Work = make_shards, threads: int = 1) -> None:
        """Prepare the processes; each starts with its first shard. One that takes longer than the limit [s] is stopped.

        Simulations take so many threads in each.
        """
        self.job, self.limit, self.work = job, limit, work
        self.begin = partial(use_one_thread, threads)
        self.idle = [_one_process(self.begin) for _ in range(workers)]
        self.busy: dict[Future[Any], tuple[Any, ProcessPool]] = {}

    @property
    def free(self) -> int:
        """Idle processes."""
        return len(self.idle)

    def submit(self, task: Any) -> None:
        """Hand a shard to an idle process."""
        pool = self.idle.pop()
        try:
            future = pool.schedule(attempt, (self.work, self.job, task), timeout=self.limit)
        except RuntimeError:  # its process died while idle
            pool = self._replaced(pool)
            future = pool.schedule(attempt, (self.work, self.job, task), timeout=self.limit)
        self.busy[future] = task, pool

    def wait(self, timeout: float) -> list[Outcome]:
        """Finished shards, errors, and shards whose process died or took too long."""
        done, _ = wait(self.busy, timeout, FIRST_COMPLETED)
        return [self._collect(future) for future in done]

    def close(self) -> None:
        """End the processes."""
        pools = [*self.idle, *(pool for _, pool in self.busy.values())]
        with ThreadPoolExecutor(len(pools)) as threads:
            list(threads.map(_end, pools))

    def _collect(self, future: Future[Any]) -> Outcome:
        task, pool = self.busy.pop(future)
        try:
            result = future.result()
        except TimeoutError:
            result = Failed(f"took longer than {self.limit:.0f} s", died=True)
        except ProcessExpired as error:
            result, pool = Failed(f"its worker process died (exit code {error.exitcode})", died=True), self._replaced(pool)
        except BrokenProcessPool:
            result, pool = Failed("its worker process died before it began", died=True), self._replaced(pool)
        except Exception as error:  # a result that cannot be handed over: pickling runs code of any kind
            result = failure_of(error)
        self.idle.append(pool)
        return task, result

    def _replaced(self, pool: ProcessPool) -> ProcessPool:
        _end(pool)
        return _one_process(self.begin)


def _one_process(begin: Callable[[], None] = use_one_thread) -> ProcessPool:
    return ProcessPool(1, initializer=begin, context=multiprocessing.get_context("spawn"))


def _end(pool: ProcessPool) -> None:
    pool.stop()
    pool.join()


CONNECT_TIME = 5.0  # Longest wait for a cluster's head to accept a connection [s]. Ours
GPU_SHARE = 0.25
"""Share of a GPU for a shard whose energies are computed there. Ours: trials, on the CPU, take most of its time."""
SLICE = 1.0  # Longest time for which the process that joined a cluster cannot be told to leave it [s]. Ours
RETRIES = 3
"""Times that Ray starts a shard again elsewhere when its process or node is gone. Ours; a shard depends on its seed alone."""


class RayPool:
    """Tasks of a Ray cluster, which are as many as `shards_at_once` says.

    A process of its own joins the cluster: Ray ends the process that joined, without a word, when the node of its machine
    dies. A cluster that this process has joined already is used from here.
    """

    def __init__(self, job: Job, workers: int, limit: float, address: str | None = None, work: Work = make_shards) -> None:
        """Join a cluster, or start one of so many workers here; a shard that takes longer than the limit [s] is stopped.

        `address` is that of the cluster's head, `host:port`, or `auto` for the one that runs here; without it RAY_ADDRESS
        counts, and without both a cluster starts on this machine.
        """
        require_extra("ray")
        import ray

        self.process = None if ray.is_initialized() else _one_process(_join_alone)
        try:
            self._ask(_join, job, workers, limit, address or os.environ.get("RAY_ADDRESS"), work)
        except BaseException as error:
            self._end()
            if isinstance(error.__cause__, BrokenProcessPool):
                raise ClusterError("the process that joins the Ray cluster ended as it began; give it a script that can be "
                                   'imported, with its calls under `if __name__ == "__main__":`') from error
            raise

    @property
    def free(self) -> int:
        """Shards that the cluster makes at once now, less those in flight; at least one may wait for a node."""
        return self._ask(_free)

    def submit(self, task: Any) -> None:
        """Hand a shard to the cluster."""
        self._ask(_submit, task)

    def wait(self, timeout: float) -> list[Outcome]:
        """Finished shards, errors, and shards whose machine is gone for good or that took too long.

        Raises:
            ClusterError: The node of this machine died.
        """
        end = time.monotonic() + timeout
        while not (outcomes := self._ask(_wait, min(timeout, SLICE))) and time.monotonic() < end:
            pass
        return outcomes

    def close(self) -> None:
        """Cancel what runs, and leave the cluster if this pool joined it."""
        with suppress(ClusterError):  # it has been said
            self._ask(_leave)
        self._end()

    def _ask(self, call: Callable[..., Any], *arguments: Any) -> Any:
        """What a call returns in the process that joined the cluster."""
        if self.process is None:
            return call(*arguments)
        try:
            return self.process.schedule(call, arguments).result()
        except (ProcessExpired, BrokenProcessPool, RuntimeError) as error:
            raise ClusterError("the Ray node of this machine died, and this run with it; the shards that are there are whole. "
                               "Start the node again (`ray start`) or name another head, and run the same command again: it "
                               "goes on from them") from error

    def _end(self) -> None:
        if self.process is not None:
            _end(self.process)


class RayTasks:
    """Shards that a Ray cluster makes, in the process that joined it."""

    joined: RayTasks | None = None  # Those of this process

    def __init__(self, job: Job, workers: int, limit: float, address: str | None, work: Work) -> None:
        """Join the cluster, unless this process has; arguments are those of `RayPool`."""
        import ray

        self.limit, self.ray, self.work = limit, ray, work
        self.joined_here = not ray.is_initialized()
        if self.joined_here:
            _connect(address, workers)
        self.job = ray.put(job)
        options: dict[str, Any] = {"max_retries": RETRIES, "scheduling_strategy": "SPREAD"}
        self.on_device = job.config.synthesis.device != "cpu"
        if self.on_device:
            # Ray would start a new process for each task, which would load and compile everything again.
            options |= {"num_gpus": GPU_SHARE, "max_calls": 0}
        # Ray lets a task simulate in as many threads.
        _, options["num_cpus"] = shards_at_once(ray.cluster_resources(), self.on_device)
        # Errors come back as values, so Ray retries lost machines and nothing else.
        self.start = ray.remote(**options)(attempt)
        self.running: dict[ray.ObjectRef, tuple[Any, float]] = {}

    @staticmethod
    def here() -> RayTasks:
        """Those of this process."""
        assert RayTasks.joined is not None
        return RayTasks.joined

    def wait(self, timeout: float) -> list[Outcome]:
        """As `RayPool.wait`."""
        done, _ = self.ray.wait(list(self.running), num_returns=1, timeout=timeout)
        outcomes = [self._collect(ref) for ref in done]
        for ref in [r for r, (_, since) in self.running.items() if time.monotonic() - since > self.limit]:
            self.ray.cancel(ref, force=True)
            outcomes.append((self.running.pop(ref)[0], Failed(f"took longer than {self.limit:.0f} s", died=True)))
        return outcomes

    def _collect(self, ref: ray.ObjectRef) -> Outcome:
        task = self.running.pop(ref)[0]
        try:
            return task, self.ray.get(ref)
        except self.ray.exceptions.RayError as error:
            return task, Failed(f"its Ray worker was lost ({type(error).__name__})", died=True)


def _join_alone() -> None:
    """Prepare the process that joins a cluster: what Ray prints is no result."""
    use_one_thread()
    os.dup2(2, 1)


def _join(*arguments: Any) -> None:
    RayTasks.joined = RayTasks(*arguments)


def _free() -> int:
    tasks = RayTasks.here()
    return max(0, shards_at_once(tasks.ray.cluster_resources(), tasks.on_device)[0] - len(tasks.running))


def shards_at_once(resources: Mapping[str, float], on_device: bool) -> tuple[int, int]:
    """How many shards a cluster of these resources makes at once, and the CPUs of each.

    One for each CPU; where GPUs make the candidates, as many as share the GPUs, each with its share of the CPUs.
    """
    cpus = max(1, int(resources.get("CPU", 0)))
    if not on_device:
        return cpus, 1
    count = min(cpus, max(1, int(resources.get("GPU", 0) / GPU_SHARE)))
    return count, cpus // count


def _submit(task: Any) -> None:
    tasks = RayTasks.here()
    tasks.running[tasks.start.remote(tasks.work, tasks.job, task)] = (task, time.monotonic())


def _wait(timeout: float) -> list[Outcome]:
    return RayTasks.here().wait(timeout)


def _leave() -> None:
    if (tasks := RayTasks.joined) is None:
        return
    for ref in tasks.running:
        tasks.ray.cancel(ref, force=True)
    if tasks.joined_here:
        tasks.ray.shutdown()


def _connect(address: str | None, workers: int) -> None:
    import ray

    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address is None:
        try:
            ray.init(address="local", num_cpus=workers, include_dashboard=False, **quiet)
        except Exception as error:  # Ray raises that very class
            raise ClusterError(f"Ray could not start a node on this machine ({str(error).partition('.')[0]}); try again when "
                               "it is less busy, or use engine='local'") from error
        return
    try:
        _knock(address)
        ray.init(address=address, **quiet)
    except (OSError, RuntimeError, ValueError) as error:
        raise OptionError(f"no Ray cluster answers at {address} ({error}); start its head with `ray start --head`, "
                          "give the address that it prints and, where Ray asks for one, the head's token "
                          "(RAY_AUTH_TOKEN)") from error


def _knock(address: str) -> None:
    """Check in seconds that something listens at `host:port`; Ray itself waits for minutes."""
    host, _, port = address.rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host, int(port)), CONNECT_TIME).close()
