"""The scripted operator of the demonstration: an OPC UA client in a process of its own (`python -m`, see `main`).

It has nothing of the server's code. Of the line it knows what the server tells, and it decides on nothing else: it
reads a proposal's difference, verdict and margins, and says its word on exactly what it has read.
"""

import asyncio
import logging
import sys
import time
from math import isfinite
from typing import Any

from asyncua import ua as asyncua_ua
from asyncua.client.client import Client
from asyncua.crypto.security_policies import SecurityPolicyAes256Sha256RsaPss

from gateway.cli.demo_orders import ORDER, Access, Approve, Call, Told

NAMESPACE = "urn:r2rgate:line"  #: as docs/operator.md has it
READ = (
    "Id", "ShownHash", "BaseRevision", "Accepted", "Difference", "Rule", "RulePassed", "RuleMargin", "RuleLimit",
    "RuleUnit",
)  # fmt: skip
CALL_S = 25.0  #: arming and deployments take their time
THERE_WITHIN_S = 30.0  #: the server after its start, and a proposal after it began to wait
AGAIN_S = 0.2

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ


class NotShown(Exception):
    """The server does not show what is asked for; the text says what."""


def main() -> None:
    """Orders from standard input, a line each, until it ends."""
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    access = Access.model_validate_json(sys.stdin.readline())
    for line in sys.stdin:
        told = asyncio.run(carried_out(access, ORDER.validate_json(line)))
        print(told.model_dump_json(), flush=True)


async def carried_out(access: Access, order: Call | Approve) -> Told:
    """In a session of its own. What cannot be done is told."""
    try:
        client = await _connected(access)
        try:
            line = await _Line.of(client)
            return await (line.call(order.method) if isinstance(order, Call) else line.approve(order))
        finally:
            await client.disconnect()
    except (OSError, TimeoutError, NotShown, ua.UaError) as error:
        return Told(ok=False, sentence=f"{type(error).__name__}: {error}")


async def _connected(access: Access) -> Client:
    """Once the server is there: it takes some seconds to start."""
    deadline_s = time.monotonic() + THERE_WITHIN_S
    while True:
        client = Client(access.url, timeout=CALL_S)
        client.name, client.application_uri = "r2rgate demonstration", access.uri
        await client.set_security(
            SecurityPolicyAes256Sha256RsaPss, access.certificate, access.private_key,
            server_certificate=access.server_certificate, mode=ua.MessageSecurityMode.SignAndEncrypt,
        )  # fmt: skip
        client.set_user(access.user)
        client.set_password(access.password)
        try:
            await client.connect()
            return client
        except ConnectionRefusedError:
            if time.monotonic() > deadline_s:
                raise
            await asyncio.sleep(AGAIN_S)


class _Line:
    def __init__(self, client: Client, namespace: int) -> None:
        self._client = client
        self._namespace = namespace

    @classmethod
    async def of(cls, client: Client) -> "_Line":
        return cls(client, await client.get_namespace_index(NAMESPACE))

    async def call(self, method: str, *arguments: Any, seen: str = "") -> Told:
        ok, sentence = await self._node("Line").call_method(self._node(f"Line.{method}"), *arguments)
        return Told(ok=ok, sentence=sentence, seen=seen)

    async def approve(self, order: Approve) -> Told:
        """What the gate has let through by every rule, as it is shown."""
        shown = await self._shown(order.proposal)
        failed = [rule for rule, passed in zip(shown["Rule"], shown["RulePassed"], strict=True) if not passed]
        if not shown["Accepted"] or failed:
            return Told(ok=False, sentence=f"not approved: the gate has not accepted it ({', '.join(failed)})")
        return await self.call(
            "Decide", shown["Id"], shown["ShownHash"], ua.Variant(shown["BaseRevision"], ua.VariantType.UInt32), True,
            order.comment, seen=in_short(shown),
        )  # fmt: skip

    async def _shown(self, proposal: str) -> dict[str, Any]:
        """Everything of it in one answer. The server looks for proposals twice a second."""
        nodes = [self._node(f"Line.Proposals.{proposal}.{name}") for name in READ]
        deadline_s = time.monotonic() + THERE_WITHIN_S
        while time.monotonic() < deadline_s:
            found: Any = await self._client.uaclient.read_attributes(
                [one.nodeid for one in nodes], ua.AttributeIds.Value
            )
            if all(one.StatusCode.is_good() and one.Value is not None for one in found):
                return {name: one.Value.Value for name, one in zip(READ, found, strict=True)}
            await asyncio.sleep(AGAIN_S)
        raise NotShown(f"the server has not shown proposal {proposal[:12]} within {THERE_WITHIN_S:g} s")

    def _node(self, path: str) -> Any:
        return self._client.get_node(ua.NodeId(path, self._namespace))


def in_short(shown: dict[str, Any]) -> str:
    """The difference's first line, how many rules it has passed, and which of them most narrowly."""
    first, *more = shown["Difference"] or ["nothing"]
    told = f"{first}{f' and {len(more)} more' if more else ''}; {len(shown['Rule'])} rules passed"
    rows = zip(shown["RuleMargin"], shown["RuleLimit"], shown["Rule"], shown["RuleUnit"], strict=True)
    numbered = [row for row in rows if isfinite(row[0]) and isfinite(row[1]) and row[1] != 0.0]
    if numbered:
        margin, _, rule, unit = min(numbered, key=lambda row: row[0] / abs(row[1]))
        told += f", most narrowly {rule} by {margin:.3g}{f' {unit}' if unit else ''}"
    return told


if __name__ == "__main__":
    main()
