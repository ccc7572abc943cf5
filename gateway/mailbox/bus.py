"""The bus of the agents: how its sessions are opened, and who may send what on it.

The gateway's session is the router: it listens on a unix socket of the line's run folder, and beyond the machine only
where the line's file has a table [network], with certificates of both sides. Nothing is discovered: endpoints are
named, scouting and gossip are off. Whatever comes from a socket meets access rules that allow the rows of
`topics.AGENT_TOPICS` in their direction, and nothing else; a refused request looks like one that nobody serves.
"""

import asyncio
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from gateway.core.line import Line, Network
from gateway.core.topics import AGENT_TOPICS, AgentTopic
from gateway.mailbox.listener import PathTooLong, check_path
from gateway.mailbox.paths import BUS_SOCKET
from gateway.mailbox.port import MAX_PAYLOAD, Unreachable
from gateway.mailbox.who_serves import ServedByStranger, require_socket
from gateway.mailbox.zenoh_mailbox import ZenohMailbox

MOST_SESSIONS = 32
LEASE_MS = 4000  #: a peer that is silent for so long is gone; one whose process ends is gone at once
WAIT_US = 1_000_000  #: for a peer that does not read; then its session ends
_QUESTIONS = ["query", "declare_liveliness_subscriber", "liveliness_query"]
_ANSWERS = ["reply", "declare_queryable", "liveliness_token"]
_RESERVED = "#?;"  #: in a path they would begin Zenoh's own options

_COMMON: dict[str, Any] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,
    "adminspace/enabled": False,
    "transport/shared_memory/enabled": False,
    "transport/unicast/compression/enabled": False,
    "transport/unicast/max_sessions": MOST_SESSIONS,
    "transport/link/protocols": ["unixsock-stream", "tls"],
    "transport/link/tx/lease": LEASE_MS,
    "transport/link/tx/queue/congestion_control/block/wait_before_close": WAIT_US,
    "transport/link/rx/max_message_size": 2 * MAX_PAYLOAD,
}


class BusUnavailable(Unreachable):
    """The bus cannot be opened or reached; the text says why."""


@dataclass(frozen=True)
class TlsEndpoint:
    """A gateway on another machine."""

    address: str  #: HOST:PORT, as its certificate has the host
    certificate: Path  #: PEM, own
    private_key: Path  #: PEM
    authority: Path  #: PEM, of who has signed the gateway's


async def open_router(line: Line, run_folder: Path) -> ZenohMailbox:
    """The gateway's own session. The run folder is private to the user: `Listener` has seen to it.

    Raises BusUnavailable.
    """
    path = run_folder / BUS_SOCKET
    settings = router_settings(line, path)
    mailbox = await _opened(settings, line.site, line.line, f"the agents' bus cannot be opened on {path}")
    os.chmod(path, 0o600)
    return mailbox


async def connect(where: Path | TlsEndpoint, site: str, line: str) -> ZenohMailbox:
    """A session of an agent, or of who asks agents, with the gateway in a run folder or on another machine.

    It connects anew by itself when the gateway has been started again. Raises BusUnavailable.
    """
    if isinstance(where, TlsEndpoint):
        tls = {
            "root_ca_certificate": str(where.authority),
            "connect_certificate": str(where.certificate),
            "connect_private_key": str(where.private_key),
            "enable_mtls": True,
            "close_link_on_expiration": True,
        }
        settings = client_settings(f"tls/{where.address}") | _under("transport/link/tls", tls)
        return await _opened(settings, site, line, f"no gateway takes this certificate on {where.address}")
    path = where / BUS_SOCKET
    try:
        require_socket(path)
    except (OSError, ServedByStranger) as error:
        raise BusUnavailable(str(error)) from error
    return await _opened(
        client_settings(_local(path)), site, line, f"no gateway on {path}: start it with `r2rgate gateway LINE.toml`"
    )


def client_settings(endpoint: str) -> dict[str, Any]:
    """Of Zenoh, by key: one endpoint, and an error at once where nobody listens there."""
    connect = {"endpoints": [endpoint], "timeout_ms": 0, "exit_on_failure": True}
    return {**_COMMON, "mode": "client", "listen/endpoints": []} | _under("connect", connect)


def router_settings(line: Line, path: Path) -> dict[str, Any]:
    """Of Zenoh, by key: where the gateway listens, and its access rules. Raises BusUnavailable."""
    network = line.network
    endpoints = [_local(path)] + ([] if network is None else [network.listen])
    before = f"{line.site}/{line.line}"
    size = {"flows": ["ingress"], "messages": ["put", "delete", "query", "reply"], "key_exprs": ["**"]}
    settings = {
        **_COMMON,
        "mode": "router",
        "listen/endpoints": endpoints,
        "access_control": _access(before, network),
        "low_pass_filter": [{"id": "size", **size, "size_limit": MAX_PAYLOAD}],
    }
    if network is None:
        return settings
    tls = {
        "root_ca_certificate": network.authority,
        "listen_certificate": network.certificate,
        "listen_private_key": network.private_key,
        "enable_mtls": True,
        "close_link_on_expiration": True,
    }
    return settings | _under("transport/link/tls", tls)


def _access(before: str, network: Network | None) -> dict[str, Any]:
    """Who may what: on this machine agents and phases, beyond it agents alone, known by their certificates."""
    rules: list[dict[str, Any]] = []
    agents: list[str] = []
    phases: list[str] = []
    for topic in AGENT_TOPICS:
        asking, answering = _asking(before, topic), _answering(before, topic)
        rules += asking + answering
        (agents if topic.asks == "agent" else phases).extend(one["id"] for one in asking)
        agents.extend(one["id"] for one in answering if topic.answers == "agent")
    subjects: list[dict[str, Any]] = [{"id": "machine", "link_protocols": ["unixsock-stream"]}]
    policies = [{"rules": agents + phases, "subjects": ["machine"]}]
    if network is not None:
        subjects.append({"id": "network", "link_protocols": ["tls"], "cert_common_names": list(network.names)})
        policies.append({"rules": agents, "subjects": ["network"]})
    return {
        "enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies,
    }  # fmt: skip


def _asking(before: str, topic: AgentTopic) -> list[dict[str, Any]]:
    """For who asks: questions come in from there, answers go out to it."""
    return [_rule(before, topic, "ingress", _QUESTIONS), _rule(before, topic, "egress", _ANSWERS)]


def _answering(before: str, topic: AgentTopic) -> list[dict[str, Any]]:
    return [_rule(before, topic, "ingress", _ANSWERS), _rule(before, topic, "egress", _QUESTIONS)]


def _rule(before: str, topic: AgentTopic, flow: str, messages: list[str]) -> dict[str, Any]:
    id_ = f"{topic.name} {messages[0]} {flow}"
    key = f"{before}/{topic.name}"
    return {"id": id_, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": [key]}


def _local(path: Path) -> str:
    """The endpoint of a socket. Raises BusUnavailable where it cannot be one."""
    try:
        check_path(path)
    except PathTooLong as error:
        raise BusUnavailable(str(error)) from error
    if found := sorted(set(_RESERVED) & set(str(path))):
        raise BusUnavailable(f"the socket path {path} has {' '.join(found)} in it: choose another run folder")
    return f"unixsock-stream/{path.absolute()}"


def _under(prefix: str, settings: dict[str, Any]) -> dict[str, Any]:
    return {f"{prefix}/{key}": value for key, value in settings.items()}


async def _opened(settings: dict[str, Any], site: str, line: str, otherwise: str) -> ZenohMailbox:
    try:
        session = await asyncio.to_thread(open_session, settings)
    except zenoh.ZError as error:
        raise BusUnavailable(f"{otherwise} ({_short(error)})") from error
    return ZenohMailbox(session, site, line)


def open_session(settings: dict[str, Any]) -> zenoh.Session:
    """Blocks; raises zenoh.ZError."""
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def _short(error: zenoh.ZError) -> str:
    """Without the places in Zenoh's own source."""
    return " ".join(str(error).split(" at /")[0].split())
