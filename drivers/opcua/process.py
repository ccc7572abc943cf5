"""The engine in a process of its own, seen from the loop: started, watched, asked, ended. Loads no OPC UA library."""

import asyncio
import os
import signal
import socket
import sys
from collections.abc import Callable
from contextlib import suppress

from drivers.opcua.messages import MAX_MESSAGE, READY, Answer, Outcome, Plan, Question, decode_answer, encode_question

START_TIMEOUT_S = 30.0  #: until a process that has not said that it is ready is ended
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 10.0  #: between a process's end and the next start
CLOSE_TIMEOUT_S = 1.5  #: for an ordered end
MESSAGES_PER_WAKEUP = 8  #: there is one answer a question; more would be a fault
_PRIORITY_BELOW_LOOP = 5
_SOCKET_FD = 3  #: of the worker's end, in the worker
#: They go to all processes of a terminal or a service at once. The loop still needs its devices then, to stop the line.
_NOT_FOR_WORKERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def processors_without(loop_cpu: int | None) -> list[int]:
    """Those that the loop will not pin itself to, all where there is one only. None: it takes the last."""
    ours = sorted(os.sched_getaffinity(0))
    taken = ours[-1] if loop_cpu is None else loop_cpu
    return [processor for processor in ours if processor != taken] or ours


class ProcessChannel:
    """A `drivers.opcua.channel.Channel`. `loop_cpu` and `loop_priority` are those of the line's file."""

    def __init__(self, plan: Plan, loop_cpu: int | None, loop_priority: int) -> None:
        self.up = asyncio.Event()
        self.pid: int | None = None  #: of the worker that runs now
        self._plan = plan.to_json()
        self._loop_cpu = loop_cpu
        self._priority = max(1, loop_priority - _PRIORITY_BELOW_LOOP)
        self._processors: list[int] = []
        self._socket: socket.socket | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._generation = 0
        self._started_s = 0.0
        self._start_again_s: float | None = None
        self._pause_s = FIRST_PAUSE_S
        self._ended: set[int] = set()  #: killed, and not yet reaped
        self._on_answer: Callable[[Answer], None] = lambda answer: None
        self._on_lost: Callable[[str], None] = lambda why: None

    def start(self, on_answer: Callable[[Answer], None], on_lost: Callable[[str], None]) -> None:
        """Start the first worker; before the loop pins itself, so that the other processors are known."""
        self._on_answer, self._on_lost = on_answer, on_lost
        self._loop = asyncio.get_running_loop()
        if self.pid is None:
            self._processors = self._processors or processors_without(self._loop_cpu)
            self._begin(self._loop.time())

    def tend(self, now_s: float) -> None:
        self._reap()
        if self.pid is not None and not self.up.is_set() and now_s - self._started_s > START_TIMEOUT_S:
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
        """Let the worker end its session, then end it."""
        self._start_again_s = None
        pid, self.pid = self.pid, None
        self._hang_up()
        if pid is not None:
            await _ended_in_time(pid)
            self._kill(pid)
        for ended in self._ended:
            await _ended_in_time(ended)
        self._reap()

    def _begin(self, now_s: float) -> None:
        """Raises OSError; it is tried again then."""
        try:
            self._spawn(now_s)
        except OSError as error:
            self._start_later(now_s)
            raise OSError(f"the OPC UA process cannot be started: {error}") from error

    def _spawn(self, now_s: float) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        self._generation += 1
        numbers = (_SOCKET_FD, os.getpid(), self._generation, self._priority)
        processors = ",".join(map(str, self._processors))
        command = [sys.executable, "-P", "-m", "drivers.opcua.worker", *map(str, numbers), processors]
        try:
            ours.send(self._plan)
            # Not as a real-time process: from within the loop it would start up at the loop's own priority.
            self.pid = os.posix_spawn(
                sys.executable,
                command,
                os.environ,
                file_actions=[
                    (os.POSIX_SPAWN_DUP2, theirs.fileno(), _SOCKET_FD),
                    *((os.POSIX_SPAWN_OPEN, fd, os.devnull, os.O_RDWR, 0) for fd in range(3)),
                ],
                setsigmask=_NOT_FOR_WORKERS,
                scheduler=(os.SCHED_OTHER, os.sched_param(0)),
            )
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
                message = self._socket.recv(MAX_MESSAGE)
            except BlockingIOError:
                return
            except OSError as error:
                self._lose(f"the OPC UA process is gone: {error}")
                return
            if not message:
                self._lose("the OPC UA process has ended")
                return
            self._on_message(message)

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
        pid, self.pid = self.pid, None
        self._hang_up()
        if pid is not None:
            self._kill(pid)
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

    def _kill(self, pid: int) -> None:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        self._ended.add(pid)

    def _reap(self) -> None:
        self._ended -= {pid for pid in self._ended if os.waitpid(pid, os.WNOHANG)[0] == pid}


async def _ended_in_time(pid: int) -> None:
    """Wait for a child to end by itself, for so long. It is not reaped."""
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    handle = os.pidfd_open(pid)
    loop.add_reader(handle, ended.set)
    try:
        async with asyncio.timeout(CLOSE_TIMEOUT_S):
            await ended.wait()
    except TimeoutError:
        pass
    finally:
        loop.remove_reader(handle)
        os.close(handle)
