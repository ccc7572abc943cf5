"""Who may do what on the agents' bus: by certificate off the machine, by the rows of the table everywhere."""

import asyncio
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import zenoh

from gateway.cli.certificates import CERTIFICATE_DAYS
from gateway.core.topics import (
    AGENT_DECIDE,
    AGENT_TOPICS,
    ASK_STATUS,
    AgentTopic,
)
from gateway.mailbox.bus import BusUnavailable, TlsEndpoint, client_settings, connect, open_router
from gateway.mailbox.port import Unreachable
from gateway.mailbox.zenoh_mailbox import ZenohMailbox
from tests.protocol.bus_support import (
    DECIDE,
    LINE,
    LONG_S,
    STATUS,
    Authority,
    client,
    echo,
    endpoint,
    is_here,
    on_network,
    opened,
    router,
    run,
    session_of,
)
from tests.unit.supervisor_support import until

pytestmark = pytest.mark.wires


async def forged(_: bytes) -> bytes:
    return b"forged"


async def reaches(mailbox: ZenohMailbox, row: AgentTopic) -> bool:
    try:
        return await mailbox.request(row.of("sysid"), b"", LONG_S) == b"echo "
    except Unreachable:
        return False


def test_agents_with_a_known_certificate_ask_and_are_asked_from_another_machine() -> None:
    async def story(folder: Path) -> None:
        authority = Authority(folder, "plant")
        line, address = on_network(authority, ["agents"])
        async with router(folder, line) as gateway:
            gateway.serve(STATUS, echo)
            async with client(endpoint(address, authority, "agents", authority)) as agents:
                agents.serve(DECIDE, echo)
                await is_here(gateway, DECIDE)
                assert await agents.request(STATUS, b"1", LONG_S) == b"echo 1"
                assert await gateway.request(DECIDE, b"2", LONG_S) == b"echo 2"
                async with client(folder) as phases:
                    assert await phases.request(DECIDE, b"3", LONG_S) == b"echo 3"

    run(story)


def test_a_certificate_that_is_not_named_may_nothing() -> None:
    async def story(folder: Path) -> None:
        authority = Authority(folder, "plant")
        line, address = on_network(authority, ["agents"])
        async with router(folder, line) as gateway, client(folder) as local:
            gateway.serve(STATUS, echo)
            async with client(endpoint(address, authority, "visitor", authority)) as visitor:
                visitor.serve(DECIDE, forged)
                assert not await reaches(visitor, ASK_STATUS)
                local.serve(DECIDE, echo)
                await is_here(gateway, DECIDE)
                assert await gateway.request(DECIDE, b"", LONG_S) == b"echo "

    run(story)


def test_foreign_certificates_none_and_plain_connections_are_refused() -> None:
    async def story(folder: Path) -> None:
        authority, foreign = Authority(folder, "plant"), Authority(folder, "foreign")
        line, address = on_network(authority, ["agents"])
        own = endpoint(address, authority, "agents", authority)
        forged = endpoint(address, foreign, "agents", authority)
        deceived = endpoint(address, authority, "agents", foreign)
        async with router(folder, line) as gateway:
            gateway.serve(STATUS, echo)
            for where in (forged, deceived):
                with pytest.raises(BusUnavailable, match=f"no gateway takes this certificate on {address}"):
                    await connect(where, "demo", "line-1")
            nothing = client_settings(f"tls/{address}") | {
                "transport/link/tls/root_ca_certificate": str(authority.file)
            }
            plain = client_settings(f"tcp/{address}") | {"transport/link/protocols": ["tcp"]}
            for settings in (nothing, plain):
                with pytest.raises(zenoh.ZError):
                    await opened(settings)
            async with client(own) as agents:  # and whoever tried has done no harm
                assert await reaches(agents, ASK_STATUS)

    run(story)


def test_a_certificate_whose_time_is_over_is_refused() -> None:
    async def story(folder: Path) -> None:
        authority = Authority(folder, "plant")
        line, address = on_network(authority, ["agents"])
        long_ago = datetime.now(UTC) - timedelta(days=CERTIFICATE_DAYS + 1.0)
        file, key = authority.certificate("agents", long_ago)
        async with router(folder, line):
            with pytest.raises(BusUnavailable):
                await connect(TlsEndpoint(address, file, key, authority.file), "demo", "line-1")

    run(story)


def test_files_that_are_none_and_a_port_in_use_are_told() -> None:
    async def story(folder: Path) -> None:
        authority = Authority(folder, "plant")
        line, address = on_network(authority, ["agents"])
        assert line.network is not None
        lost = line.network.model_copy(update={"certificate": "/no/such.pem"})
        with pytest.raises(BusUnavailable, match="cannot be opened"):
            await open_router(line.model_copy(update={"network": lost}), folder)
        async with router(folder, line):
            (folder / "other").mkdir(mode=0o700)
            with pytest.raises(BusUnavailable, match="cannot be opened"):
                await open_router(line, folder / "other")

    run(story)


@pytest.mark.parametrize("over", ["the machine", "the network"])
def test_the_table_is_all_that_is_allowed(over: str) -> None:
    """Every row, in either direction, from an agent; as the table has it, and nothing else."""

    async def story(folder: Path) -> None:
        authority = Authority(folder, "plant")
        line, address = on_network(authority, ["agents"])
        own = endpoint(address, authority, "agents", authority)
        async with router(folder, line) as gateway, client(folder) as other:
            asked = [row for row in AGENT_TOPICS if row.asks == "agent"]
            for row in (row for row in AGENT_TOPICS if row.answers == "gateway"):
                gateway.serve(row.of("sysid"), echo)
            for row in (row for row in AGENT_TOPICS if row.answers == "agent"):
                other.serve(row.of("sysid"), echo)
                await is_here(gateway, row.of("sysid"))
            async with client(folder if over == "the machine" else own) as agents:
                reached = [row for row in AGENT_TOPICS if await reaches(agents, row)]
                # On the machine the phases ask agents, over the same socket.
                assert reached == (list(AGENT_TOPICS) if over == "the machine" else asked)

    run(story)


@pytest.mark.parametrize("over", ["the machine", "the network"])
def test_nobody_answers_in_the_gateways_place(over: str) -> None:
    async def story(folder: Path) -> None:
        authority = Authority(folder, "plant")
        line, address = on_network(authority, ["agents"])
        own = endpoint(address, authority, "agents", authority)
        async with router(folder, line), client(folder) as honest:
            async with client(folder if over == "the machine" else own) as forging:
                rows = [row for row in AGENT_TOPICS if row.answers == "gateway"]
                for row in rows:
                    forging.serve(row.of("sysid"), forged)
                forging.serve(AGENT_DECIDE.of("sysid"), echo)
                await is_here(honest, AGENT_DECIDE.of("sysid"))  # by now the others would be, too
                for row in rows:
                    with pytest.raises(Unreachable, match="nobody answers"):
                        await honest.request(row.of("sysid"), b"", LONG_S)

    run(story)


@pytest.mark.parametrize("key", ["demo/line-1/loop/command", "demo/line-1/ask/sysid/status", "demo/line-1/x", "**"])
def test_nothing_is_published_and_nothing_is_overheard(key: str) -> None:
    async def story(folder: Path) -> None:
        async with router(folder) as gateway, client(folder) as forger, client(folder) as spy:
            heard: list[str] = []
            overheard: list[str] = []
            inside, outside = session_of(gateway), session_of(forger)
            hears = inside.declare_subscriber(key, _into(heard))
            overhears = session_of(spy).declare_subscriber(key, _into(overheard))
            gateway.serve(STATUS, echo)
            plain = key if key != "**" else "demo/line-1/x"
            for _ in range(100):
                outside.put(plain, b"forged")
                outside.delete(plain)
                inside.put(plain, b"secret")
            for mailbox in (forger, spy):  # after all of them, on the same connection
                assert await mailbox.request(STATUS, b"", LONG_S) == b"echo "
            await until(lambda: len(heard) >= 100)
            assert set(heard) == {"secret"}
            assert overheard == []
            for declared in (hears, overhears):
                await asyncio.to_thread(declared.undeclare)

    run(story)


def test_the_line_beside_cannot_be_reached_with_the_certificate_of_this_one() -> None:
    async def story(folder: Path) -> None:
        authority = Authority(folder, "plant")
        line, address = on_network(authority, ["agents"])
        own = endpoint(address, authority, "agents", authority)
        async with router(folder, line) as gateway:
            beside = ZenohMailbox(session_of(gateway), "demo", "line-2")  # whose gateway has the same router
            beside.serve(STATUS, forged)
            gateway.serve(STATUS, echo)
            async with client(own, line="line-2") as agents:
                assert not await reaches(agents, ASK_STATUS)
                with pytest.raises(Unreachable):
                    await agents.request(STATUS, b"", LONG_S)
            async with client(own) as agents:
                assert await agents.request(STATUS, b"", LONG_S) == b"echo "
            await beside.close()

    run(story)


def test_a_connection_that_says_nothing_keeps_nobody_out() -> None:
    async def story(folder: Path) -> None:
        authority = Authority(folder, "plant")
        line, address = on_network(authority, ["agents"])
        port = int(address.rpartition(":")[2])
        async with router(folder, line) as gateway:
            gateway.serve(STATUS, echo)
            silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(20)]
            async with client(endpoint(address, authority, "agents", authority)) as agents:
                assert await reaches(agents, ASK_STATUS)
            for _, writer in silent:
                writer.close()
                with suppress(OSError):
                    await writer.wait_closed()

    run(story)


def test_without_a_table_network_no_port_is_open() -> None:
    async def story(folder: Path) -> None:
        assert LINE.network is None
        before = _listening()
        async with router(folder):
            assert _listening() == before

    run(story)


def _listening() -> set[int]:
    """Inodes of this process's listening TCP sockets."""
    own = {link.readlink().name for link in _links()}
    rows = [row.split() for name in ("tcp", "tcp6") for row in Path(f"/proc/self/net/{name}").read_text().splitlines()]
    return {int(row[9]) for row in rows[1:] if len(row) > 9 and row[3] == "0A" and f"socket:[{row[9]}]" in own}


def _links() -> list[Path]:
    found = []
    for link in Path("/proc/self/fd").iterdir():
        with suppress(OSError):
            link.readlink()
            found.append(link)
    return found


def _into(heard: list[str]) -> Any:
    return zenoh.handlers.Callback(lambda sample: heard.append(bytes(sample.payload).decode()), indirect=False)
