"""Strangers at the OPC UA server's socket for bench-operator: `python -m tests.bench.operator_attacks KIND HOST:PORT`.

    connections  a hundred connections, opened and left: a third silent, a third after a hello, a third with a channel
    malformed    messages that are none, one after the other, each on its own connection, as fast as they are refused
    busy SHARE   nothing on the network: so much of a processor, for comparison

They come from another address of this machine than the honest client. Each says `ready` first, and goes on until
SIGTERM.
"""

import asyncio
import itertools
import json
import random
import signal
import struct
import sys
import time
from collections.abc import Coroutine, Sequence
from contextlib import suppress

FROM = "127.0.0.2"  #: the honest client's is 127.0.0.1
CONNECTIONS = 100
WORKERS = 8  #: connections with malformed messages at a time
SAID_S = 10.0  #: for the server to take what is said
ENDED_S = 1.0  #: for it to end the connection; otherwise this side does
GARBAGE = random.Random(1).randbytes(60_000)  #: the same in every run
CHUNK = 65_535
RESPONSE_HEADER = 24  #: bytes: time, handle, result, no diagnostics, no texts, nothing additional

Part = tuple[bytes, bytes]  #: kind of a message or chunk, and what follows its numbers

NONE = b"http://opcfoundation.org/UA/SecurityPolicy#None"
ENCRYPTED = b"http://opcfoundation.org/UA/SecurityPolicy#Basic256Sha256"


def text(value: bytes | None) -> bytes:
    return struct.pack("<i", -1) if value is None else struct.pack("<i", len(value)) + value


def message(kind: bytes, body: bytes, size: int | None = None) -> bytes:
    """With the header of OPC UA's TCP; `size`: what it says of its length, where that is not true."""
    return kind + struct.pack("<I", len(body) + 8 if size is None else size) + body


def hello(url: bytes = b"opc.tcp://127.0.0.1") -> bytes:
    return message(b"HELF", struct.pack("<5I", 0, CHUNK, CHUNK, 0, 0) + text(url))


def crumbs() -> bytes:
    """Of a client that takes answers in pieces of a byte."""
    return message(b"HELF", struct.pack("<5I", 0, 25, CHUNK, 0, 0) + text(b"x"))


def request_header(additional: bytes = b"\x00\x00\x00") -> bytes:
    return b"\x00\x00" + struct.pack("<qII", 0, 1, 0) + text(None) + struct.pack("<I", 1000) + additional


def open_channel(policy: bytes = NONE, certificate: bytes | None = None, thumbprint: bytes | None = None) -> bytes:
    """OpenSecureChannel, in the clear."""
    body = b"\x01\x00" + struct.pack("<H", 446) + request_header() + struct.pack("<III", 0, 0, 1)
    body += text(None) + struct.pack("<I", 3_600_000)
    secured = struct.pack("<I", 0) + text(policy) + text(certificate) + text(thumbprint) + struct.pack("<II", 1, 1)
    return message(b"OPNF", secured + body)


def asked(number: int, body: bytes, additional: bytes = b"\x00\x00\x00") -> bytes:
    """A request."""
    return b"\x01\x00" + struct.pack("<H", number) + request_header(additional) + body


def in_channel(channel: int, token: int, parts: Sequence[Part]) -> bytes:
    """Messages, or chunks of some, as they are numbered on a channel without security."""
    return b"".join(
        message(kind, struct.pack("<IIII", channel, token, 2 + k, 2 + k) + body) for k, (kind, body) in enumerate(parts)
    )


FIND_SERVERS, GET_ENDPOINTS, CREATE_SESSION, READ, CALL = 422, 428, 461, 631, 712
MOST = 2**31 - 1
FINAL, CHUNK_OF_MORE, ABORTED = b"MSGF", b"MSGC", b"MSGA"
#: LiteralOperand with an array of so many nulls, which take no bytes.
NULLS = b"\x01\x00" + struct.pack("<HBiBi", 597, 1, 5, 0x80, MOST)
OPENED = hello() + open_channel()
#: What is said on a connection, by what is wrong with it.
BEFORE: dict[str, bytes] = {
    "no OPC UA": b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" + bytes(200),
    "size 0": message(b"HELF", bytes(24), 0),
    "size 7": message(b"HELF", bytes(24), 7),
    "size 4 GiB": message(b"HELF", bytes(24), 2**32 - 1),
    "a chunk too large": message(b"OPNF", bytes(CHUNK + 100)),
    "shorter than it says": message(b"HELF", bytes(8), 5000),
    "unknown type": message(b"XYZF", bytes(64)),
    "reserved byte": message(b"HEL\xff", bytes(64)),
    "hello twice": hello() + hello(),
    "hello with an address of 60 kB": hello(b"x" * 60_000),
    "hello with a length of 2 GiB": message(b"HELF", struct.pack("<5Ii", 0, CHUNK, CHUNK, 0, 0, MOST)),
    "hello with buffers of nothing": message(b"HELF", struct.pack("<5I", 0, 0, 0, 0, 0) + text(b"x")),
    "hello that takes crumbs": crumbs() + open_channel(),
    "message before hello": in_channel(1, 1, [(FINAL, bytes(64))]),
    "close before hello": message(b"CLOF", bytes(64)),
    "unknown policy": hello() + open_channel(b"http://example.org/#None"),
    "channel with a certificate that is none": hello() + open_channel(ENCRYPTED, b"\x30\x82\x40\x00" + bytes(16_384)),
    "channel with a certificate of 60 kB": hello() + open_channel(ENCRYPTED, GARBAGE[:60_000], bytes(20)),
    "channel without a certificate": hello() + open_channel(ENCRYPTED),
    "channel again and again": OPENED + open_channel() * 200,
    "garbage after the channel is open": OPENED + GARBAGE[:4096],
    "message on a channel of nobody's": OPENED + in_channel(MOST, 1, [(FINAL, bytes(64))]),
}
#: And what on one with a channel, without security.
INSIDE: dict[str, list[Part]] = {
    "garbage as a message": [(FINAL, GARBAGE[:2000])],
    "chunks without end": [(CHUNK_OF_MORE, bytes(CHUNK - 24))] * 16,
    "small chunks without end": [(CHUNK_OF_MORE, b"x")] * 2000,
    "aborted chunks": [(ABORTED, bytes(64))] * 200,
    "array of 2 GiB": [(FINAL, asked(GET_ENDPOINTS, text(b"x") + struct.pack("<ii", MOST, MOST)))],
    "text of minus 2": [(FINAL, asked(FIND_SERVERS, struct.pack("<i", -2) * 3))],
    "nulls without end": [(FINAL, asked(GET_ENDPOINTS, text(b"x") + struct.pack("<ii", -1, -1), NULLS))],
    "reading without a session": [(FINAL, asked(READ, struct.pack("<dii", 0.0, 0, 1000) + bytes(20_000)))],
    "calling without a session": [(FINAL, asked(CALL, struct.pack("<i", 1000) + bytes(20_000)))],
    "session without encryption": [(FINAL, asked(CREATE_SESSION, bytes(400)))],
    "unknown service": [(FINAL, asked(9999, bytes(100)))],
    "endpoints again and again": [(FINAL, asked(GET_ENDPOINTS, text(b"x") + struct.pack("<ii", -1, -1)))] * 200,
}


async def connections(address: tuple[str, int], ended: asyncio.Event) -> dict[str, int]:
    openings = itertools.cycle((b"", hello(), OPENED))
    counts = {"opened": 0, "refused at once": 0}

    async def leave(opening: bytes) -> None:
        while not ended.is_set():
            try:
                stream, writer = await asyncio.open_connection(*address, local_addr=(FROM, 0))
                counts["opened"] += 1
                writer.write(opening)
                while await stream.read(4096):  # until the server ends it
                    pass
                writer.close()
            except OSError:
                counts["refused at once"] += 1
            await asyncio.sleep(0.01)

    await _until(ended, *(leave(next(openings)) for _ in range(CONNECTIONS)))
    return counts


async def malformed(address: tuple[str, int], ended: asyncio.Event) -> dict[str, int]:
    counts = dict.fromkeys((*BEFORE, *INSIDE), 0)
    wrong = itertools.cycle(counts)

    async def say() -> None:
        while not ended.is_set():
            name = next(wrong)
            counts[name] += await deliver(name, address)

    await _until(ended, *(say() for _ in range(WORKERS)))
    return counts


async def deliver(name: str, address: tuple[str, int]) -> bool:
    """Say it on a connection of its own, and wait for the server to end that. False: it came to nothing."""
    said = False
    with suppress(OSError, TimeoutError, EOFError):
        stream, writer = await asyncio.open_connection(*address, local_addr=(FROM, 0))
        try:
            async with asyncio.timeout(SAID_S):
                await _say(name, stream, writer)
                await writer.drain()
            said = True
            async with asyncio.timeout(ENDED_S):
                while await stream.read(65_536):
                    pass
        finally:
            writer.transport.abort()
    return said


async def _say(name: str, stream: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Raises EOFError where the server has not opened a channel."""
    if name in BEFORE:
        writer.write(BEFORE[name])
        return
    writer.write(OPENED)
    await _answer(stream)
    body = await _answer(stream)
    (header,) = (number for number in range(len(body)) if body[number : number + 4] == b"\x01\x00\xc1\x01")
    # The response's header, the protocol's version, and then the token: of the channel, of what was opened.
    channel, token = struct.unpack_from("<II", body, header + 4 + RESPONSE_HEADER + 4)
    writer.write(in_channel(channel, token, INSIDE[name]))


async def _answer(stream: asyncio.StreamReader) -> bytes:
    head = await stream.readexactly(8)
    return await stream.readexactly(int.from_bytes(head[4:], "little") - 8)


async def busy(share: float, ended: asyncio.Event) -> dict[str, int]:
    slices = 0
    while not ended.is_set():
        begin_s = time.monotonic()
        until_s = time.thread_time() + 0.02 * share
        while time.thread_time() < until_s:
            pass
        slices += 1
        await asyncio.sleep(max(0.0, begin_s + 0.02 - time.monotonic()))
    return {"slices": slices}


async def _until(ended: asyncio.Event, *works: Coroutine[None, None, None]) -> None:
    tasks = [asyncio.ensure_future(work) for work in works]
    await ended.wait()
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


async def main(kind: str, where: str) -> None:
    ended = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, ended.set)
    print("ready", flush=True)
    if kind == "busy":
        counts = await busy(float(where), ended)
    else:
        host, _, port = where.rpartition(":")
        counts = await {"connections": connections, "malformed": malformed}[kind]((host, int(port)), ended)
    print(json.dumps(counts))


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], sys.argv[2]))
