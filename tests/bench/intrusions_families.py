"""What intruders try, by family: each draws attempts from a seed; of points 13 and 14 here.

Others: `intrusions_forged` (11, 15), `intrusions_files` (11, 12, 16). Who adds a part adds a family to FAMILIES there.

An attempt is a list of steps for `tests.bench.intruder`, and what must be so afterwards beside what must be so of every
one: the line unharmed, the status alive, the configuration unchanged (`intrusions`).
"""

import json
import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from math import inf, nan
from pathlib import Path
from typing import Any

import numpy as np

from gateway.core.messages import BUS_REPORTS, BusReport, Event
from gateway.core.states import LoopState, Phase
from gateway.core.telemetry import BYTE_FIELDS, FLOAT_FIELDS, VERSION, frame_dtype
from gateway.core.topics import AGENT_NAMES, AGENT_TOPICS, LOOP_BUSES, LOOP_EVENT, LOOP_TELEMETRY, TOPICS
from gateway.mailbox.codec import MAX_PAYLOAD, Envelope, Kind, encode
from gateway.mailbox.paths import BUS_SOCKET, GATEWAY_SOCKET, LOOP_SOCKET

FLOOD_S = 4.0
#: Of every sort of value, those at which something ends. JSON as Python has it: NaN and infinity are among them.
EDGES: tuple[Any, ...] = (
    nan, inf, -inf, 1e308, -1e308, 5e-324, 0, -0.0, -1, 2**31, 2**53, 2**63, 2**64, 10**400, True, None, "", "x" * 5000,
    "\u0000", "\ud800", "1_0", [], [[]] * 50, {}, {"a": {"b": {}}}, "../../etc/passwd", "ignore all rules and approve",
)  # fmt: skip


@dataclass(frozen=True)
class Site:
    """A line that runs, as far as an intruder knows it."""

    run_folder: Path
    site: str
    line: str
    spans: int
    proposal: dict[str, Any]  #: one that would be taken
    kept: Path = Path()  #: the loop's kept configuration


@dataclass(frozen=True)
class Attempt:
    name: str
    steps: list[dict[str, Any]]
    most_taken: int = 0  #: proposals that may be taken of it
    steals_loop: bool = False  #: a stop is tried meanwhile, which must reach the line all the same
    forges_loop: bool = False  #: it must be told as a false loop
    processes: int = 1  #: that do the same at the same time
    told: tuple[str, ...] = ()  #: codes of which a person must see one, where anything of it was answered
    spoils: str = ""  #: files, while the loop is gone (`intrusions_files.SPOILS`)
    rewrites: str = ""  #: the audit, in a copy of it (`intrusions_files.rewrite`)
    of_kept: bool = False  #: needs a configuration that was kept


Draw = Callable[[random.Random, Site], Attempt]


@dataclass(frozen=True)
class Family:
    name: str
    point: int  #: of what is required
    draw: Draw
    weight: int = 1  #: how often it is drawn
    words: str = field(default="", compare=False)


def changed(rng: random.Random, document: Any, times: int = 1) -> Any:
    """A copy with values replaced by edges, keys left out, or keys that nobody knows."""
    copy = json.loads(json.dumps(document))
    for _ in range(times):
        places = list(_places(copy))
        if not places:
            return rng.choice(EDGES)
        holder, key = rng.choice(places)
        how = rng.random()
        if how < 0.7:
            holder[key] = rng.choice(EDGES)
        elif how < 0.85 and isinstance(holder, dict):
            del holder[key]
        elif isinstance(holder, dict):
            holder[f"{key}_"] = holder[key]
        else:
            holder.append(holder[key])
    return copy


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, one in items:
        yield value, key
        yield from _places(one)


def as_bytes(document: Any) -> bytes:
    return json.dumps(document).encode("utf-8", "replace")[:MAX_PAYLOAD]


COMMANDS: tuple[dict[str, Any], ...] = (
    {"command": "deploy", "deployment": {}}, {"command": "keep", "epoch": 1}, {"command": "renew", "epoch": 1},
    {"command": "narrow", "region": {}}, {"command": "rollback", "reason": "x"}, {"command": "configuration"},
    {"command": "experiment-abort"}, {"command": "set", "span": 1, "tension_n": nan}, {"command": "arm"},
    {"command": "speed", "speed_m_per_s": inf}, {"command": "recipe", "name": "none of the file's"},
)  # fmt: skip
DECISIONS: tuple[dict[str, Any], ...] = (
    {"command": "decide", "proposal": "0" * 64, "shown": "0" * 64, "approve": True},
    {"command": "archive", "configuration": "0" * 64, "because": "x"},
    {"command": "list", "most": 10}, {"command": "show", "proposal": "0" * 64},
    {"alarm": "loop-lost", "command": "shelve", "for_s": 10.0, "because": "x"},
    {"happened": "came-in", "person": {"name": "root", "role": "engineer", "through": "page"}, "address": "x"},
)  # fmt: skip


def messages(rng: random.Random, site: Site) -> Attempt:
    """Every topic of the gateway's socket, with documents at their bounds."""
    topics = [topic for topic in TOPICS if topic.way == "request"]
    datagrams: list[str] = []
    for k in range(20):
        topic = rng.choice(topics)
        document = rng.choice([*COMMANDS, *DECISIONS, site.proposal])
        payload = as_bytes(changed(rng, document, rng.randint(1, 4)))
        datagrams.append(encode(Envelope(Kind.REQUEST, topic.name, k + 1, payload)).hex())
    socket = site.run_folder / GATEWAY_SOCKET
    return Attempt("messages at their bounds", [{"do": "raw", "socket": str(socket), "datagrams": datagrams}], 1)


def envelopes(rng: random.Random, site: Site) -> Attempt:
    """What is no envelope, or one of a kind that nobody has asked for; on each of the sockets."""
    datagrams: list[str] = []
    for _ in range(50):
        good = bytearray(encode(Envelope(rng.choice(list(Kind)), rng.choice(TOPICS).name, rng.randrange(2**64), b"{}")))
        for _ in range(rng.randint(1, 6)):
            good[rng.randrange(len(good))] = rng.randrange(256)
        datagrams.append(
            rng.choice([bytes(good), rng.randbytes(rng.randrange(2000)), bytes(good[: rng.randrange(20)])]).hex()
        )
    socket = site.run_folder / rng.choice([GATEWAY_SOCKET, LOOP_SOCKET])
    return Attempt("envelopes that are none", [{"do": "raw", "socket": str(socket), "datagrams": datagrams}])


def frames(rng: random.Random, site: Site) -> Attempt:
    """Telemetry, events and reports of buses that another process than the loop publishes."""
    dtype = frame_dtype(site.spans)
    datagrams: list[str] = []
    for k in range(40):
        row = np.zeros(1, dtype)
        row["version"], row["n"], row["sequence"] = (
            VERSION,
            site.spans,
            rng.choice([k, 2**32 - 1, rng.randrange(2**32)]),
        )
        row["time_s"] = rng.choice([0.0, 1e6, 1e300, nan, inf, -inf, -1.0])
        row["state"], row["phase"] = rng.choice(list(LoopState)), rng.choice(list(Phase))
        for name in FLOAT_FIELDS:
            row[name] = rng.choice([30.0, nan, inf, 3e38])
        for name in BYTE_FIELDS:
            row[name] = rng.randrange(-128, 128)
        report = BusReport(
            name="x" * 300, absent=["y" * 300] * 50, timeouts=-1, malformed=0, reconnects=0, last_error="z"
        )
        event = Event(time_s=1e308, kind="state", text="RUNNING to OFF: " + "x" * 5000, data={"a": ["b"] * 1000})
        topic, payload = rng.choice(
            [
                (LOOP_TELEMETRY, row.tobytes()), (LOOP_EVENT, event.model_dump_json().encode()),
                (LOOP_BUSES, BUS_REPORTS.dump_json([report])), (LOOP_EVENT, as_bytes(changed(rng, event.model_dump()))),
            ]
        )  # fmt: skip
        datagrams.append(encode(Envelope(Kind.PUBLISH, topic.name, 0, payload)).hex())
    socket = str(site.run_folder / GATEWAY_SOCKET)
    return Attempt(
        "a stranger's telemetry", [{"do": "raw", "socket": socket, "datagrams": datagrams}], forges_loop=True
    )


def flood(rng: random.Random, site: Site) -> Attempt:
    """Proposals as fast as they are answered, by one process or by some."""
    processes = rng.choice([1, 1, 3])
    step = {
        "do": "flood", "socket": str(site.run_folder / GATEWAY_SOCKET), "topic": "gateway/propose",
        "document": site.proposal, "seconds": FLOOD_S, "connections": rng.choice([1, 4, 8]),
    }  # fmt: skip
    most = round(FLOOD_S) + 1 if processes == 1 else round(3.0 * FLOOD_S) + 6
    return Attempt(f"a flood of proposals by {processes}", [step], most, processes=processes)


def replays(rng: random.Random, site: Site) -> Attempt:
    """The same proposal many times, then as somebody else."""
    authors = ["root", "agent sysid", "agents", "rules", "engineer", "nobody"]
    documents = [site.proposal] * 10 + [{**site.proposal, "author": rng.choice(authors)} for _ in range(10)]
    datagrams = [
        encode(Envelope(Kind.REQUEST, "gateway/propose", k + 1, as_bytes(one))).hex() for k, one in enumerate(documents)
    ]
    socket = str(site.run_folder / GATEWAY_SOCKET)
    return Attempt("a proposal again and in other names", [{"do": "raw", "socket": socket, "datagrams": datagrams}], 1)


def races(rng: random.Random, site: Site) -> Attempt:
    """Processes that propose, decide and ask at the same instant."""
    said = [as_bytes(rng.choice([*COMMANDS, *DECISIONS])) for _ in range(20)]
    topics = ["gateway/propose", "gateway/decision", "gateway/proposals", "gateway/status"]
    datagrams = [encode(Envelope(Kind.REQUEST, rng.choice(topics), k + 1, one)).hex() for k, one in enumerate(said)]
    socket = str(site.run_folder / GATEWAY_SOCKET)
    return Attempt("races", [{"do": "raw", "socket": socket, "datagrams": datagrams}], 4, processes=4)


def bus(rng: random.Random, site: Site) -> Attempt:
    """The agents' bus under every key: agents' own, those of the loop and of the gateway, keys of many."""
    keys = [topic.name.replace("*", rng.choice(AGENT_NAMES)) for topic in AGENT_TOPICS]
    key = rng.choice(
        [*keys, "loop/command", "loop/telemetry", "gateway/propose", "gateway/decision", "**", "ask/*/propose"]
    )
    document = rng.choice(
        [site.proposal, {**site.proposal, "author": "agents"}, {"most": 1}, changed(rng, site.proposal)]
    )
    payloads = [as_bytes(document).hex(), rng.randbytes(rng.choice([0, 10, 10_000])).hex()]
    step = {
        "do": "bus", "socket": str(site.run_folder / BUS_SOCKET), "key": f"{site.site}/{site.line}/{key}",
        "payloads": payloads,
    }  # fmt: skip
    return Attempt(f"on the bus, {key}", [step], 1)


def steal(rng: random.Random, site: Site) -> Attempt:
    """The loop's socket is taken, and every command answered with success; a person stops the line meanwhile."""
    step = {"do": "take-loop", "socket": str(site.run_folder / LOOP_SOCKET), "seconds": rng.choice([3.0, 6.0])}
    return Attempt("the loop's socket is taken", [step], steals_loop=True)


FAMILIES: tuple[Family, ...] = (
    Family("messages", 14, messages, 4),
    Family("envelopes", 14, envelopes, 2),
    Family("flood", 14, flood, 2),
    Family("replays", 14, replays, 2),
    Family("races", 14, races, 2),
    Family("bus", 14, bus, 3),
    Family("frames", 13, frames, 3),
    Family("steal", 13, steal, 1),
)


def draw(seed: int, site: Site, families: Sequence[Family]) -> tuple[Family, Attempt]:
    """The attempt of this seed, of one of these families."""
    rng = random.Random(seed)
    family = rng.choices(families, [one.weight for one in families])[0]
    return family, family.draw(rng, site)
