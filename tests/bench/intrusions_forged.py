"""Commands to the loop that no gateway has made, and texts that would blind people: families of points 11 and 15."""

import random
from typing import Any

from gateway.core.messages import Event
from gateway.core.topics import TOPICS
from gateway.mailbox.codec import MAX_PAYLOAD, Envelope, Kind, encode
from gateway.mailbox.paths import GATEWAY_SOCKET, LOOP_SOCKET
from tests.bench.intrusions_families import COMMANDS, DECISIONS, Attempt, Family, Site, as_bytes, changed

DATAGRAMS = 12
REFUSED = "refused-at-the-door"


def _commands(site: Site) -> list[dict[str, Any]]:
    """Every command that changes something, as a gateway would word it. Not `stop` and `hold`: they are anybody's."""
    change = site.proposal["change"]
    deployment = {
        "controller": change["controller"], "hash": "0" * 64, "epoch": 1, "lease_s": 60.0, "region": {}, "watch": None,
    }  # fmt: skip
    deploys = [{"command": "deploy", "deployment": {**deployment, "epoch": epoch}} for epoch in (0, 1, 2, 3, 2**40)]
    return [
        *deploys, *(one for one in COMMANDS if one["command"] not in ("deploy", "configuration")),
        {"command": "keep", "epoch": 2, "watch": None}, {"command": "watch-good", "watch": {}},
        {"command": "confirmed", "configuration": "0" * 64}, {"command": "start"},
        {"command": "set", "span": 1, "tension_n": 30.0}, {"command": "speed", "speed_m_per_s": 0.1, "step": True},
        {"command": "recipe", "name": "velocity"}, {"command": "experiment", "experiment": {}, "proposal": "0" * 64},
    ]  # fmt: skip


def plain(rng: random.Random, site: Site) -> Attempt:
    """Commands as they are, some with fields at their bounds."""
    datagrams: list[str] = []
    for k in range(DATAGRAMS):
        document = rng.choice(_commands(site))
        if rng.random() < 0.5:
            command = document["command"]
            bent = changed(rng, {**document}, rng.randint(1, 3))
            document = {**bent, "command": command} if isinstance(bent, dict) else bent
        datagrams.append(encode(Envelope(Kind.REQUEST, "loop/command", k + 1, as_bytes(document))).hex())
    step = {"do": "raw", "socket": str(site.run_folder / LOOP_SOCKET), "datagrams": datagrams}
    return Attempt("commands without a proof", [step], told=(REFUSED,))


def sealed(rng: random.Random, site: Site) -> Attempt:
    """Commands with a proof by a key of the intruder's own, for this start of the loop or another."""
    said = [as_bytes(rng.choice(_commands(site))).hex() for _ in range(DATAGRAMS)]
    step = {
        "do": "sealed", "socket": str(site.run_folder / LOOP_SOCKET), "commands": said, "site": site.site,
        "line": rng.choice([site.line, site.line, "another"]), "own_nonce": rng.random() < 0.3,
        "seed": rng.randrange(2**31),
    }  # fmt: skip
    return Attempt("commands with a proof by a strange key", [step], told=(REFUSED,))


def replayed(rng: random.Random, site: Site) -> Attempt:
    """The proof that lies beside the kept configuration, with the command that it was made for, and with others."""
    said = [as_bytes(rng.choice(_commands(site))).hex() for _ in range(DATAGRAMS)]
    step = {
        "do": "replay", "socket": str(site.run_folder / LOOP_SOCKET), "commands": said, "kept": str(site.kept),
        "seed": rng.randrange(2**31),
    }  # fmt: skip
    return Attempt("a proof that was used before", [step], told=(REFUSED,), of_kept=True)


def _long(rng: random.Random, value: Any) -> Any:
    """A copy in which texts are long, and nasty."""
    if isinstance(value, dict):
        return {key: _long(rng, one) for key, one in value.items()}
    if isinstance(value, list):
        return [_long(rng, one) for one in value]
    if not isinstance(value, str) or rng.random() < 0.4:
        return value
    sort = rng.choice(["x", "\u001b[2J", "\u202e", "</script><script>", "\n\n", "é", "\U0001f600", "{span:d}", "%s"])
    return value[:4] + sort * (rng.choice([10, 600, 5000, 60_000]) // len(sort))


def texts(rng: random.Random, site: Site) -> Attempt:
    """Long and nasty texts in everything that people are told of, on the gateway's socket."""
    event = Event(time_s=1.0, kind="state", text="RUN", data={"why": "because", "who": ["a", "b"] * 300})
    documents = [*DECISIONS, *COMMANDS, site.proposal, event.model_dump(mode="json")]
    topics = [topic for topic in TOPICS if topic.way == "request"]
    datagrams = [
        encode(
            Envelope(
                Kind.REQUEST,
                rng.choice(topics).name,
                k + 1,
                as_bytes(_long(rng, rng.choice(documents)))[: MAX_PAYLOAD - 1000],
            )  # fmt: skip
        ).hex()
        for k in range(DATAGRAMS)
    ]
    step = {"do": "raw", "socket": str(site.run_folder / GATEWAY_SOCKET), "datagrams": datagrams}
    return Attempt("texts without an end", [step], most_taken=1)


FAMILIES = (
    Family("plain", 11, plain, 3),
    Family("sealed", 11, sealed, 2),
    Family("replayed", 11, replayed, 2),
    Family("texts", 15, texts, 3),
)
