"""The process that holds the OPC UA client: `python -m drivers.opcua.worker FD PARENT GENERATION PRIORITY`.

It exists so that nothing a server sends can take time, memory or the interpreter from the loop: memory is limited,
its real-time priority lies below the loop's (on one processor it has none), it stays off the loop's processor (as the
spawner, its parent, does), and it ends with the loop. It reads the plan from its socket, then questions, and answers
each of them.
"""

import asyncio
import gc
import os
import resource
import socket
import sys
from contextlib import suppress

from drivers.opcua.messages import (
    MAX_MESSAGE,
    MAX_PLAN,
    READY,
    Answer,
    Outcome,
    Plan,
    decode_question,
    encode_answer,
)
from drivers.opcua.spawner import die_with

ADDRESS_SPACE_BYTES = 512 << 20  #: eight times what the client needs; a hostile answer can ask for gigabytes
DATA_BYTES = 256 << 20
REAL_TIME_CPU_S = 0.5  #: of computing without a pause at real-time priority; then the kernel ends the process


def main(arguments: list[str]) -> int:
    fd, parent, generation, priority = map(int, arguments[:4])
    die_with(parent)
    for limit, most in ((resource.RLIMIT_AS, ADDRESS_SPACE_BYTES), (resource.RLIMIT_DATA, DATA_BYTES)):
        resource.setrlimit(limit, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    connection = socket.socket(fileno=fd)
    return asyncio.run(_serve(connection, generation, priority))


async def _serve(connection: socket.socket, generation: int, priority: int) -> int:
    from drivers.opcua.engine import Engine  # half a second, which belongs to this process alone

    connection.setblocking(False)
    loop = asyncio.get_running_loop()
    engine = Engine(Plan.from_json(await loop.sock_recv(connection, MAX_PLAN)), generation)
    gc.collect()
    gc.freeze()  # the library's half a million objects: looking through them would take 0.1 s in mid-cycle
    gc.collect()  # of what is left: a full collection comes only once a quarter of what the last one saw is new
    _become_real_time(priority)
    await loop.sock_sendall(connection, encode_answer(Answer(READY, Outcome.DONE, 0)))
    questions: asyncio.Queue[bytes] = asyncio.Queue()
    received = memoryview(bytearray(MAX_MESSAGE))  # one that stays, as at the other end

    def hear() -> None:
        try:
            message = bytes(received[: connection.recv_into(received)])
        except OSError:  # the loop has gone and left an answer unread
            message = b""
        if not message:
            loop.remove_reader(connection)
        questions.put_nowait(message)

    loop.add_reader(connection, hear)
    while message := await questions.get():
        answer = encode_answer(await engine.answer(decode_question(message)))
        with suppress(BlockingIOError):  # nobody takes answers: it will not be missed
            connection.send(answer)
    await engine.close()
    return 0


def _become_real_time(priority: int) -> None:
    """After the imports, which would hold a processor for long. 0: not at all."""
    if priority == 0:
        return
    soft = int(1e6 * REAL_TIME_CPU_S)
    resource.setrlimit(resource.RLIMIT_RTTIME, (soft, soft))
    with suppress(OSError):  # where it is not permitted, the loop has said so
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
