"""An intruder of the line's own user, a process of its own: `python -m tests.bench.intruder` reads and takes steps.

Steps come as a JSON list on standard input, and a result a step goes to standard output, one JSON object a line. It
speaks to sockets with the project's codec and nothing else of it, so that it can send what no client would.

    raw         datagrams as they are, over one connection
    flood       requests of a topic as fast as they are answered, over several connections, for a while
    take-loop   the loop's socket is taken away from it, and every command is answered with success
    bus         requests on the agents' bus under any key
    sealed      commands to the loop with a proof by a key of the intruder's own
    replay      commands to the loop with a proof that lies on the disk
"""

import asyncio
import json
import random
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import zenoh

from gateway.core.topics import LOOP_COMMAND
from gateway.mailbox.bus import client_settings, open_session
from gateway.mailbox.codec import Envelope, Kind, MalformedEnvelope, decode, encode
from gateway.mailbox.unix import UnixMailbox

ANSWER_S = 1.0
BUS_ANSWER_S = 1.0


def connected(path: str) -> socket.socket:
    peer = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    peer.settimeout(ANSWER_S)
    peer.connect(path)
    return peer


def raw(step: dict[str, Any]) -> dict[str, Any]:
    """What is answered to each, as far as something is."""
    sent, answers = 0, list[str]()
    with suppress(OSError):
        peer = connected(step["socket"])
        for datagram in step["datagrams"]:
            with suppress(OSError):
                peer.send(bytes.fromhex(datagram))
                sent += 1
        peer.settimeout(0.2)
        with suppress(OSError, MalformedEnvelope):
            while len(answers) < len(step["datagrams"]):
                answers.append(decode(peer.recv(400_000)).payload[:300].decode("utf-8", "replace"))
        peer.close()
    return {"sent": sent, "answers": answers}


def flood(step: dict[str, Any]) -> dict[str, Any]:
    """How many were asked, how many taken, and the codes of those that were not."""
    peers = [connected(step["socket"]) for _ in range(step["connections"])]
    until_s, asked, taken, codes = time.monotonic() + step["seconds"], 0, 0, dict[str, int]()
    while time.monotonic() < until_s:
        for peer in peers:
            asked += 1
            payload = json.dumps({**step["document"], "reason": f"forged {asked}"}).encode()
            with suppress(OSError):
                peer.send(encode(Envelope(Kind.REQUEST, step["topic"], asked, payload)))
        for peer in peers:
            with suppress(OSError, ValueError, MalformedEnvelope):
                reply = json.loads(decode(peer.recv(400_000)).payload)
                taken += reply.get("ok") is True
                for found in reply.get("findings", []):
                    codes[found["code"]] = codes.get(found["code"], 0) + 1
    for peer in peers:
        peer.close()
    return {"asked": asked, "taken": taken, "codes": codes}


def take_loop(step: dict[str, Any]) -> dict[str, Any]:
    """What was said to it instead of to the loop."""
    path, heard = Path(step["socket"]), list[str]()
    aside = [path.with_name(name) for name in (path.name, f"{path.name}.lock")]
    for one in aside:
        one.rename(one.with_name(f"{one.name}.aside"))

    async def serve() -> None:
        box = UnixMailbox()

        async def done(payload: bytes) -> bytes:
            heard.append(payload[:80].decode("utf-8", "replace"))
            return json.dumps({"ok": True, "state": "STOP", "text": "done", "reasons": []}).encode()

        box.serve(LOOP_COMMAND, done)
        await box.listen(path)
        print(json.dumps({"took": True}), flush=True)
        await asyncio.sleep(step["seconds"])
        await box.close()

    try:
        asyncio.run(serve())
    finally:
        for one in aside:
            with suppress(OSError):
                one.with_name(f"{one.name}.aside").rename(one)
    return {"heard": heard}


def on_bus(step: dict[str, Any]) -> dict[str, Any]:
    """How many questions under a key were answered."""
    try:
        session = open_session(client_settings(f"unixsock-stream/{step['socket']}"))
    except zenoh.ZError as error:
        return {"error": str(error)[:200]}
    answers = list[str]()
    for payload in step["payloads"]:
        with suppress(zenoh.ZError):
            for reply in session.get(step["key"], payload=bytes.fromhex(payload), timeout=BUS_ANSWER_S):
                if reply.ok is not None:
                    answers.append(bytes(reply.ok.payload)[:300].decode("utf-8", "replace"))
        with suppress(zenoh.ZError):
            session.put(step["key"], bytes.fromhex(payload))
    session.close()
    return {"answers": answers}


def said_to_loop(path: str, payloads: list[bytes]) -> dict[str, Any]:
    datagrams = [encode(Envelope(Kind.REQUEST, "loop/command", k + 1, one)).hex() for k, one in enumerate(payloads)]
    return raw({"socket": path, "datagrams": datagrams})


def with_own_key(step: dict[str, Any]) -> dict[str, Any]:
    """As a gateway would seal them, for the start of the loop that answers."""
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    from gateway.core.proof import Claim, Proof, Statement, content_hash, sealed

    peer = connected(step["socket"])
    peer.send(encode(Envelope(Kind.REQUEST, "loop/hello", 1, b"")))
    nonce = "a" * 32
    with suppress(OSError, MalformedEnvelope, ValueError, KeyError):
        nonce = nonce if step["own_nonce"] else json.loads(decode(peer.recv(400_000)).payload)["loop"]
    peer.close()
    dice, payloads = random.Random(step["seed"]), list[bytes]()
    key = Ed25519PrivateKey.from_private_bytes(dice.randbytes(32))
    for content in map(bytes.fromhex, step["commands"]):
        number = dice.choice([time.monotonic_ns(), 1, 2**63 - 1, time.monotonic_ns() + 10**12])
        statement = Statement(
            site=step["site"], line=step["line"], loop=nonce, number=number, command=json.loads(content)["command"],
            content=content_hash(dice.choice([content, b"other"])), claim=Claim(),
        )  # fmt: skip
        signature = key.sign(statement.signed_bytes()).hex()
        payloads.append(sealed(Proof(statement=statement, signature=signature), content))
    return said_to_loop(step["socket"], payloads)


def with_old_proof(step: dict[str, Any]) -> dict[str, Any]:
    from gateway.core.proof import Proof, sealed

    proof = Proof.model_validate(json.loads(Path(step["kept"]).read_bytes())["proof"])
    dice, payloads = random.Random(step["seed"]), list[bytes]()
    for content in map(bytes.fromhex, step["commands"]):
        statement = proof.statement
        if dice.random() < 0.5:  # what a moment of now would make it
            statement = statement.model_copy(update={"number": time.monotonic_ns()})
        payloads.append(sealed(proof.model_copy(update={"statement": statement}), content))
    return said_to_loop(step["socket"], payloads)


STEPS = {
    "raw": raw, "flood": flood, "take-loop": take_loop, "bus": on_bus, "sealed": with_own_key, "replay": with_old_proof,
}  # fmt: skip


def main() -> None:
    for step in json.load(sys.stdin):
        print(json.dumps(STEPS[step["do"]](step)), flush=True)


if __name__ == "__main__":
    main()
