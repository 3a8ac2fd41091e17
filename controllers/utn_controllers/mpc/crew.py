"""Where the regions live: in this process, in a pool, or as Dask actors over machines. Same code, same messages.

Threads are no fourth way: the solver takes some twenty microseconds a call, and two threads spend more than that on
handing the interpreter to each other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, Protocol

from threadpoolctl import threadpool_limits

from utn_controllers.mpc.region import Region
from utn_sumo.errors import ControllerError


class Crew(Protocol):
    """Some regions, all of which do the same thing at a time."""

    def __len__(self) -> int: ...

    def call(self, method: str, *arguments: Sequence[Any]) -> list[Any]:
        """Call a region's method on every region, each with its own item of every argument; the answers in order."""
        ...


class InProcess:
    """One after the other."""

    def __init__(self, regions: Sequence[Callable[[], Region]]):
        self.regions = [build() for build in regions]

    def __len__(self) -> int:
        return len(self.regions)

    def call(self, method: str, *arguments: Sequence[Any]) -> list[Any]:
        return [getattr(region, method)(*own) for region, *own in zip(self.regions, *arguments, strict=True)]


class Processes:
    """One process a region on this machine. The states go out once a step; between the rounds only messages travel."""

    def __init__(self, regions: Sequence[Callable[[], Region]]):
        context = get_context("spawn")
        self.pipes: list[Connection] = []
        self.workers: list[BaseProcess] = []
        for build in regions:
            here, there = context.Pipe()
            # Daemons end with this process, however it ends.
            self.workers.append(context.Process(target=_serve, args=(there, build), daemon=True))
            self.workers[-1].start()
            # Whoever else has it open does not hear that the other end is gone.
            there.close()
            self.pipes.append(here)
        for failed in [_received(pipe) for pipe in self.pipes]:
            if failed is not None:
                raise failed

    def __len__(self) -> int:
        return len(self.pipes)

    def call(self, method: str, *arguments: Sequence[Any]) -> list[Any]:
        sent = [_sent(pipe, (method, own)) for pipe, *own in zip(self.pipes, *arguments, strict=True)]
        # All answers are fetched before any error is raised: none must be left for the next call.
        answers = [_received(pipe) if is_sent else _lost() for pipe, is_sent in zip(self.pipes, sent, strict=True)]
        for answer in answers:
            if isinstance(answer, Exception):
                raise answer
        return answers


def _sent(pipe: Connection, item: Any) -> bool:
    """Whether somebody is there to take it."""
    try:
        pipe.send(item)
    except OSError:
        return False
    return True


def _received(pipe: Connection) -> Any:
    try:
        return pipe.recv()
    except (EOFError, OSError):
        return _lost()


def _lost() -> ControllerError:
    return ControllerError("a process of the agents has ended: see what it printed")


def _serve(pipe: Connection, build: Callable[[], Region]) -> None:
    """Build a region and answer calls to it until the other side is gone."""
    # Two processes with as many threads as cores each would wait for one another.
    threadpool_limits(1)
    region: Region | None = None
    method, own = "", list[Any]()
    while True:
        try:
            if region is None:
                region, answer = build(), None
            else:
                answer = getattr(region, method)(*own)
        except Exception as error:  # noqa: BLE001 - whatever it is, the caller must hear of it
            answer = error
        try:
            pipe.send(answer)
            method, own = pipe.recv()
        except (EOFError, BrokenPipeError):
            return


class DaskActors:
    """One Dask actor a region, on the cluster of `address`, or on processes of this machine."""

    def __init__(self, regions: Sequence[Callable[[], Region]], address: str | None):
        try:
            from distributed import Client  # noqa: PLC0415 - heavy, and few use it
        except ImportError as error:
            raise ControllerError("agents = 'dask' needs Dask: run pip install 'utn-sumo[dask]'") from error
        local: dict[str, Any] = {"n_workers": len(regions), "threads_per_worker": 1, "host": "127.0.0.1"}
        connect: Any = Client
        self._client = connect(address) if address else connect(**local, processes=True, dashboard_address=None)
        futures = [self._client.submit(build, actor=True, pure=False) for build in regions]
        self._actors = [future.result() for future in futures]

    def __len__(self) -> int:
        return len(self._actors)

    def call(self, method: str, *arguments: Sequence[Any]) -> list[Any]:
        answers = [getattr(actor, method)(*own) for actor, *own in zip(self._actors, *arguments, strict=True)]
        return [answer.result() for answer in answers]
