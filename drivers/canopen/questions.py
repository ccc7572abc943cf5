"""What is asked of the nodes by SDO beside the cycle: one question at a time each, in tasks of their own."""

import asyncio
from collections.abc import Callable, Coroutine, Sequence
from typing import Any, TypeVar

from drivers.canopen.node import Node
from drivers.canopen.sdo import SdoBus, SdoFailed, SdoSilent
from drivers.canopen.transaction import Step, set_and_found
from gateway.core.finding import Finding, finding
from gateway.core.signals import LinkHealth
from gateway.wording.catalogue import sentences

VERIFY_S = 1.0  #: in which every watchdog is read once
READINGS = 2  #: that show another value than was set, one after the other, until a watchdog counts as altered

T = TypeVar("T")


class Questions:
    """`on_altered(node, trouble)` is called when a watchdog is not what `prepare` has set it to."""

    def __init__(
        self, sdo: SdoBus, nodes: Sequence[Node], health: LinkHealth, on_altered: Callable[[Node, Finding], None]
    ) -> None:
        self._sdo = sdo
        self._health = health
        self._on_altered = on_altered
        self._tasks: dict[int, asyncio.Task[None]] = {}  #: by node
        self._ending: set[asyncio.Task[None]] = set()
        self._stopped: set[int] = set()
        self._guarded = [(node, node.watchdog) for node in nodes if node.watchdog is not None]
        self._turn = 0  #: of `_guarded`, whose watchdog is read next
        self._verify_s = float("-inf")  #: when
        self._keeps_free: Node | None = None  #: for its watchdog: it is asked nothing else before
        self._verifying: asyncio.Task[None] | None = None

    def ask(self, node: Node, now_s: float, *, active: bool) -> None:
        """Ask for what no PDO brings, if it is time for it. `active`: the link commands the nodes."""
        if node is self._keeps_free or node.station.node in self._tasks:
            return
        if node.reading_due(now_s, active=active):
            self._start(node, self._read(node, now_s, silent=not active))

    def verify(self, now_s: float) -> None:
        """Ask the next node whether its watchdog still is what was set, if it is time for it: one after the other.

        Called at the end of a cycle, so that its frames do not come among the answers.
        """
        if now_s < self._verify_s or not self._guarded or not (self._verifying is None or self._verifying.done()):
            return
        node, watchdog = self._guarded[self._turn]
        if not node.station.distrust:
            if node.station.node in self._tasks:
                self._keeps_free = node  # it is asked something else: once that is over
                return
            self._verifying = self._start(node, self._verify(node, watchdog))
        self._keeps_free = None
        self._turn = (self._turn + 1) % len(self._guarded)
        self._verify_s = now_s + VERIFY_S / len(self._guarded)

    def has_confirmed(self, node: Node) -> bool:
        """Whether the node has said by SDO that its torque is off, since it was doubted. If not, it is asked to."""
        confirmed = node.station.node in self._stopped
        if not confirmed and node.station.node not in self._tasks:
            self._start(node, self._confirm_stopped(node))
        return confirmed

    def doubt(self, node: Node) -> None:
        """What the node has confirmed counts no more, nor what it is about to answer."""
        self._stopped.discard(node.station.node)
        task = self._tasks.pop(node.station.node, None)
        if task is not None and task is not asyncio.current_task():
            task.cancel()

    def stop(self) -> None:
        """Drop what is under way: its answer would belong to another time. What was confirmed does not count more."""
        for task in self._tasks.values():
            task.cancel()
        self._tasks.clear()
        self._stopped.clear()
        self._verify_s = float("-inf")
        self._keeps_free = None

    async def close(self) -> None:
        self.stop()
        await asyncio.gather(*self._ending, return_exceptions=True)

    def _start(self, node: Node, question: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(question)
        self._tasks[node.station.node] = task
        self._ending.add(task)

        def over(_: asyncio.Task[None]) -> None:
            self._ending.discard(task)
            if self._tasks.get(node.station.node) is task:
                del self._tasks[node.station.node]

        task.add_done_callback(over)
        return task

    async def _read(self, node: Node, now_s: float, *, silent: bool) -> None:
        reasons = await self._answer(node, node.read(self._sdo, now_s))
        if reasons:
            self._health.last_error = sentences(reasons)
        elif reasons is not None and silent:
            node.station.heard(now_s)  # a sign of life: its heartbeat may be off until `prepare` sets it

    async def _verify(self, node: Node, watchdog: Step) -> None:
        """A node that does not answer is not judged: that is for its PDOs and heartbeats."""
        wanted = found = watchdog.bytes_after(b"")
        for _ in range(READINGS):
            question = self._sdo.upload(node.station.node, watchdog.index, watchdog.sub, len(wanted))
            found = await self._answer(node, question)
            if found is None or found == wanted:
                return
        counts = set_and_found(wanted, found)
        self._on_altered(node, finding("object-changed", device=node.station.name, object=watchdog.name, **counts))

    async def _answer(self, node: Node, question: Coroutine[Any, Any, T]) -> T | None:
        """None, and why in `health`, where there is no answer."""
        try:
            return await question
        except SdoSilent as error:
            self._health.timeouts += 1
            self._health.last_error = f"{node.station.name}: {error}"
        except SdoFailed as error:
            self._health.malformed += 1
            self._health.last_error = f"{node.station.name}: {error}"
        return None

    async def _confirm_stopped(self, node: Node) -> None:
        try:
            if await node.confirm_stopped(self._sdo):
                self._stopped.add(node.station.node)
        except SdoFailed as error:
            self._health.last_error = f"{node.station.name}: does not confirm that its torque is off: {error}"
