"""What is asked of the nodes by SDO beside the cycle: one question at a time each, in tasks of their own."""

import asyncio
from collections.abc import Coroutine
from typing import Any

from drivers.canopen.node import Node
from drivers.canopen.sdo import SdoBus, SdoFailed, SdoSilent
from gateway.core.signals import LinkHealth


class Questions:
    def __init__(self, sdo: SdoBus, health: LinkHealth) -> None:
        self._sdo = sdo
        self._health = health
        self._tasks: dict[int, asyncio.Task[None]] = {}  #: by node
        self._ending: set[asyncio.Task[None]] = set()
        self._stopped: set[int] = set()

    def ask(self, node: Node, now_s: float, *, active: bool) -> None:
        """Ask for what no PDO brings, if it is time for it. `active`: the link commands the nodes."""
        if node.station.node not in self._tasks and node.reading_due(now_s, active=active):
            self._start(node, self._read(node, now_s, silent=not active))

    def has_confirmed(self, node: Node) -> bool:
        """Whether the node has said by SDO that its torque is off, since `stop`. If not, it is asked to."""
        confirmed = node.station.node in self._stopped
        if not confirmed and node.station.node not in self._tasks:
            self._start(node, self._confirm_stopped(node))
        return confirmed

    def stop(self) -> None:
        """Drop what is under way: its answer would belong to another time. What was confirmed does not count more."""
        for task in self._tasks.values():
            task.cancel()
        self._tasks.clear()
        self._stopped.clear()

    async def close(self) -> None:
        self.stop()
        await asyncio.gather(*self._ending, return_exceptions=True)

    def _start(self, node: Node, question: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(question)
        self._tasks[node.station.node] = task
        self._ending.add(task)

        def over(_: asyncio.Task[None]) -> None:
            self._ending.discard(task)
            if self._tasks.get(node.station.node) is task:
                del self._tasks[node.station.node]

        task.add_done_callback(over)

    async def _read(self, node: Node, now_s: float, *, silent: bool) -> None:
        try:
            reasons = await node.read(self._sdo, now_s)
        except SdoSilent as error:
            self._health.timeouts += 1
            self._health.last_error = f"{node.station.name}: {error}"
        except SdoFailed as error:
            self._health.malformed += 1
            self._health.last_error = f"{node.station.name}: {error}"
        else:
            if reasons:
                self._health.last_error = f"{node.station.name}: {'; '.join(reasons)}"
            elif silent:
                node.station.heard(now_s)  # a sign of life: its heartbeat may be off until `prepare` sets it

    async def _confirm_stopped(self, node: Node) -> None:
        try:
            if await node.confirm_stopped(self._sdo):
                self._stopped.add(node.station.node)
        except SdoFailed as error:
            self._health.last_error = f"{node.station.name}: does not confirm that its torque is off: {error}"
