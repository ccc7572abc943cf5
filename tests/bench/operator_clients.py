"""Clients of the operator's process for bench-operator: `python -m tests.bench.operator_clients KIND ADDRESS PKI`.

    honest      reads, calls a method, and connects anew, now and then; tells how long each took
    reader      reads a hundred nodes again and again, as fast as it is answered
    subscriber  has fifty variables told, every 100 ms
    refresher   has the events of all conditions told ten times over, and asks for what waits again and again
    killer      begins a subscriber, kills it as soon as it is told something, and again
    page        a browser that looks on (ADDRESS is the page's)

Each says `ready` first, and goes on until SIGTERM.
"""

import asyncio
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
from asyncua import ua as asyncua_ua
from asyncua.client.client import Client
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from cryptography import x509

from gateway.operator.opcua.limits import MAX_CALLS, MAX_EVENT_ITEMS
from gateway.operator.opcua.trust import application_uri
from tests.operator.names import PANEL, PASSWORD

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ

Kind = Callable[[str, Path, asyncio.Event], Awaitable[None]]

NUMBER = 2  #: of the line's namespace
TIMEOUT_S = 20.0
TRIES = 5
READ_EVERY_S, CALL_EVERY_S, CONNECT_EVERY_S = 0.1, 1.0, 3.0
SPANS = 6
PATHS = [
    *(f"Line.Spans.{k}.{name}" for k in range(1, SPANS + 1) for name in ("Tension", "Setpoint", "Error", "Quality")),
    *(f"Line.Rollers.{k}.{name}" for k in range(1, SPANS + 1) for name in ("Speed", "Torque", "TorqueActual", "Drive")),
    "Line.Unwinder.Speed", "Line.Operation.State",
]  # fmt: skip


async def connected(address: str, pki: Path, user: str) -> Client:
    client = Client(address, timeout=TIMEOUT_S, watchdog_intervall=TIMEOUT_S)  # asyncua's own gives up after a second
    own = pki / f"opcua-client-{PANEL}.pem"
    client.application_uri = application_uri(x509.load_pem_x509_certificate(own.read_bytes()))
    await client.set_security(
        SecurityPolicyBasic256Sha256, own, own.with_suffix(".key.pem"), server_certificate=str(pki / "opcua-server.pem")
    )
    client.set_user(user)
    client.set_password(PASSWORD)
    await client.connect()
    return client


async def connected_at_last(address: str, pki: Path) -> Client:
    """For those whose coming in is not what is measured: on a machine this busy it may take longer than is allowed."""
    for _ in range(TRIES - 1):
        with suppress(ConnectionError, TimeoutError, asyncua_ua.UaError):
            return await connected(address, pki, "vera")
    return await connected(address, pki, "vera")


def node(path: str) -> Any:
    return ua.NodeId(path, NUMBER)


async def read(client: Client, paths: list[str]) -> None:
    """Raises what asyncua does."""
    asked = [ua.ReadValueId(node(path), ua.AttributeIds.Value) for path in paths]
    found = await client.uaclient.read(ua.ReadParameters(NodesToRead=asked))
    assert len(found) == len(paths)


async def call(client: Client) -> None:
    """All the way to the loop, where it changes nothing."""
    recipe = ua.Variant("tension", ua.VariantType.String)
    (result,) = await client.uaclient.call([ua.CallMethodRequest(node("Line"), node("Line.SelectRecipe"), [recipe])])
    assert result.OutputArguments[0].Value, result


async def honest(address: str, pki: Path, ended: asyncio.Event) -> None:
    """One line of JSON for each deed: its kind, when it began (monotonic), how long it took, and why it failed."""
    held: list[Client] = [await connected(address, pki, "otto")]
    ready()

    async def anew() -> None:
        await (await connected(address, pki, "vera")).disconnect()

    async def again(kind: str, every_s: float, do: Callable[[], Awaitable[None]]) -> None:
        while not ended.is_set():
            at_s, why = time.monotonic(), ""
            try:
                await do()
            except Exception as error:  # whatever becomes of it is what is measured
                why = f"{type(error).__name__}: {error}"
            took_s = time.monotonic() - at_s
            print(json.dumps({"kind": kind, "at_s": at_s, "took_s": took_s, "why": why}), flush=True)
            if why and kind == "read":
                with suppress(Exception):
                    held[0].disconnect_socket()
                    held[0] = await connected(address, pki, "otto")
            await asyncio.sleep(max(0.0, every_s - took_s))

    await asyncio.gather(
        again("read", READ_EVERY_S, lambda: read(held[0], PATHS[:12])),
        again("call", CALL_EVERY_S, lambda: call(held[0])),
        again("connect", CONNECT_EVERY_S, anew),
    )


async def reader(address: str, pki: Path, ended: asyncio.Event) -> None:
    client = await connected_at_last(address, pki)
    ready()
    paths, answers = (PATHS * 2)[:100], 0
    while not ended.is_set():
        await read(client, paths)
        answers += 1
    print(json.dumps({"answers": answers}))


class _Told:
    def __init__(self) -> None:
        self.changes = self.events = 0

    def event_notification(self, event: Any) -> None:
        self.events += 1

    def datachange_notification(self, node: Any, val: Any, data: Any) -> None:
        self.changes += 1
        if self.changes == len(PATHS):
            ready()


async def subscriber(address: str, pki: Path, ended: asyncio.Event) -> None:
    client, told = await connected_at_last(address, pki), _Told()
    subscription = await client.create_subscription(100, told)
    await subscription.subscribe_data_change([client.get_node(node(path)) for path in PATHS])
    await ended.wait()
    print(json.dumps({"answers": told.changes}))
    await client.disconnect()


async def refresher(address: str, pki: Path, ended: asyncio.Event) -> None:
    client, told = await connected_at_last(address, pki), _Told()
    subscription = await client.create_subscription(100, told)
    kind = client.get_node(ua.ObjectIds.DialogConditionType)
    for _ in range(MAX_EVENT_ITEMS):
        await subscription.subscribe_events(evtypes=kind)
    ready()
    of = ua.NodeId(ua.ObjectIds.ConditionType), ua.NodeId(ua.ObjectIds.ConditionType_ConditionRefresh)
    number = ua.Variant(subscription.subscription_id, ua.VariantType.UInt32)
    while not ended.is_set():
        await client.uaclient.call([ua.CallMethodRequest(*of, [number])] * MAX_CALLS)
    print(json.dumps({"answers": told.events}))


async def page(address: str, _: Path, ended: asyncio.Event) -> None:
    events = 0
    async with httpx.AsyncClient(base_url=address, headers={"origin": address}, timeout=TIMEOUT_S) as browser:
        (await browser.post("/api/login", json={"name": "vera", "password": PASSWORD})).raise_for_status()
        async with browser.stream("GET", "/events") as stream:
            async for text in stream.aiter_lines():
                events += text.startswith("data:")
                if events == 1 and text.startswith("data:"):
                    ready()
                if ended.is_set():
                    break
    print(json.dumps({"answers": events}))


def ready() -> None:
    print("ready", flush=True)


def killer(address: str, pki: Path) -> None:
    """Children of this process, which need not load everything anew."""
    ended: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: ended.append(number))
    killed = 0
    while not ended:
        told, telling = os.pipe()
        if (pid := os.fork()) == 0:
            os.dup2(telling, sys.stdout.fileno())
            asyncio.run(begin(subscriber, address, pki))
            os._exit(0)
        os.close(telling)
        killed += bool(os.read(told, 16))
        os.close(told)
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        if killed == 1:
            ready()
    print(json.dumps({"answers": killed}))


logging.getLogger("asyncua").setLevel(logging.CRITICAL)
KINDS = {one.__name__: one for one in (honest, reader, subscriber, refresher, page)}


async def begin(kind: Kind, address: str, pki: Path) -> None:
    ended = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, ended.set)
    await kind(address, pki, ended)


def main(kind: str, address: str, pki: Path) -> None:
    if kind == killer.__name__:
        killer(address, pki)
    else:
        asyncio.run(begin(KINDS[kind], address, pki))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], Path(sys.argv[3]))
