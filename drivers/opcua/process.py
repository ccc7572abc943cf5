"""The engine in a process of its own, seen from the loop: started, watched, asked, ended. Loads no OPC UA library.

The loop does not start it itself, see `spawner`.
"""

import asyncio
import os
import socket
from collections.abc import Callable
from contextlib import suppress

from drivers.opcua.messages import MAX_MESSAGE, READY, Answer, Outcome, Plan, Question, decode_answer, encode_question
from drivers.opcua.spawner import CLOSE_TIMEOUT_S, kill_child, spawn
from gateway.tasks.cleanup import finish

START_TIMEOUT_S = 30.0  #: until a process that has not said that it is ready is ended
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 10.0  #: between a process's end and the next start
MESSAGES_PER_WAKEUP = 8  #: there is one answer a question; more would be a fault
_PRIORITY_BELOW_LOOP = 5
_END_WORKER = b"end"  #: a request to the spawner; any other is a generation, and brings a socket
_SPAWNER_TIMEOUT_S = CLOSE_TIMEOUT_S + 1.0  #: for the spawner's end after the worker's


def processors_without(loop_cpu: int | None) -> list[int]:
    """Those that the loop will not pin itself to, all where there is one only. None: it takes the last."""
    ours = sorted(os.sched_getaffinity(0))
    taken = ours[-1] if loop_cpu is None else loop_cpu
    return [processor for processor in ours if processor != taken] or ours


class ProcessChannel:
    """A `drivers.opcua.channel.Channel`. `loop_cpu` and `loop_priority` are those of the line's file."""

    def __init__(self, plan: Plan, loop_cpu: int | None, loop_priority: int) -> None:
        self.up = asyncio.Event()
        self.pid: int | None = None  #: of the spawner, parent of the worker
        self._plan = plan.to_json()
        self._loop_cpu = loop_cpu
        self._priority = max(1, loop_priority - _PRIORITY_BELOW_LOOP)
        self._control: socket.socket | None = None  #: to the spawner
        self._socket: socket.socket | None = None  #: to the worker
        # One that stays: room for a whole message, asked for and given back each cycle, leaves the heap in pieces.
        self._received = memoryview(bytearray(MAX_MESSAGE))
        self._loop: asyncio.AbstractEventLoop | None = None
        self._generation = 0
        self._started_s = 0.0
        self._start_again_s: float | None = None
        self._pause_s = FIRST_PAUSE_S
        self._on_answer: Callable[[Answer], None] = lambda answer: None
        self._on_lost: Callable[[str], None] = lambda why: None

    def start(self, on_answer: Callable[[Answer], None], on_lost: Callable[[str], None]) -> None:
        """Start spawner and first worker. Before the loop becomes real-time, and knows its processors."""
        self._on_answer, self._on_lost = on_answer, on_lost
        self._loop = asyncio.get_running_loop()
        if self._control is None:
            self._start_spawner()
        if self._socket is None:
            self._begin(self._loop.time())

    def tend(self, now_s: float) -> None:
        if self._socket is not None and not self.up.is_set() and now_s - self._started_s > START_TIMEOUT_S:
            self.give_up(f"the OPC UA process was not ready within {START_TIMEOUT_S:g} s")
        if self._start_again_s is not None and now_s >= self._start_again_s:
            try:
                self._begin(now_s)
            except OSError as error:
                self._on_lost(str(error))

    def ask(self, question: Question) -> bool:
        if self._socket is None or not self.up.is_set():
            return False
        try:
            self._socket.send(encode_question(question))
        except BlockingIOError:
            return False
        except OSError as error:
            self._lose(f"the OPC UA process is gone: {error}")
            return False
        return True

    def give_up(self, why: str) -> None:
        self._lose(why)

    async def close(self) -> None:
        """Let the worker end its session, and the spawner end it if it does not. No cancellation cuts it."""
        self._start_again_s = None
        self._hang_up()
        control, self._control = self._control, None
        if control is not None:
            control.close()
        pid, self.pid = self.pid, None
        if pid is not None:
            await finish(_end_child(pid))

    def _begin(self, now_s: float) -> None:
        """Raises OSError; it is tried again then."""
        try:
            self._spawn(now_s)
        except OSError as error:
            self._start_later(now_s)
            raise OSError(f"the OPC UA process cannot be started: {error}") from error

    def _start_spawner(self) -> None:
        """Raises OSError."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        processors = ",".join(map(str, processors_without(self._loop_cpu)))
        # Of one processor the kernel takes the real-time class 0.05 s in a second: that has to last the loop.
        priority = self._priority if len(os.sched_getaffinity(0)) > 1 else 0
        try:
            arguments = (str(os.getpid()), str(priority), processors)
            self.pid = spawn("drivers.opcua.spawner", theirs.fileno(), *arguments)
        except OSError as error:
            ours.close()
            raise OSError(f"the process that starts the OPC UA process cannot be started: {error}") from error
        finally:
            theirs.close()
        self._control = ours

    def _spawn(self, now_s: float) -> None:
        if self._control is None:
            raise OSError("there is nobody to start it")
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        self._generation += 1
        try:
            ours.send(self._plan)
            socket.send_fds(self._control, [str(self._generation).encode()], [theirs.fileno()])
        except OSError:
            ours.close()
            raise
        finally:
            theirs.close()
        self._socket = ours
        self._started_s, self._start_again_s = now_s, None
        assert self._loop is not None
        self._loop.add_reader(ours, self._read)

    def _read(self) -> None:
        for _ in range(MESSAGES_PER_WAKEUP):
            if self._socket is None:
                return
            try:
                length = self._socket.recv_into(self._received)
            except BlockingIOError:
                return
            except OSError as error:
                self._lose(f"the OPC UA process is gone: {error}")
                return
            if not length:
                self._lose("the OPC UA process has ended")
                return
            self._on_message(bytes(self._received[:length]))

    def _on_message(self, message: bytes) -> None:
        try:
            answer = decode_answer(message)
        except ValueError as error:
            self._lose(f"the OPC UA process talks nonsense: {error}")
            return
        if answer.number == READY:
            self.up.set()
            return
        if answer.outcome is Outcome.DONE:
            self._pause_s = FIRST_PAUSE_S
        self._on_answer(answer)

    def _lose(self, why: str) -> None:
        """End the worker, whatever it is doing, and start another after a pause."""
        self._hang_up()
        if self._control is not None:
            with suppress(OSError):  # a spawner that is gone has taken its worker with it
                self._control.send(_END_WORKER)
        assert self._loop is not None
        self._start_later(self._loop.time())
        self._on_lost(why)

    def _start_later(self, now_s: float) -> None:
        self._start_again_s = now_s + self._pause_s
        self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)

    def _hang_up(self) -> None:
        self.up.clear()
        connection, self._socket = self._socket, None
        if connection is not None:
            assert self._loop is not None
            self._loop.remove_reader(connection)
            connection.close()


async def _end_child(pid: int) -> None:
    try:
        await _ended_in_time(pid)
    finally:
        kill_child(pid)


async def _ended_in_time(pid: int) -> None:
    """Wait for a child to end by itself, for so long. It is not reaped."""
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    handle = os.pidfd_open(pid)
    loop.add_reader(handle, ended.set)
    try:
        async with asyncio.timeout(_SPAWNER_TIMEOUT_S):
            await ended.wait()
    except TimeoutError:
        pass
    finally:
        loop.remove_reader(handle)
        os.close(handle)
