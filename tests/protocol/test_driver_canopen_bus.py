"""A bus that dies: what is missed, when it is opened again, what is said of it. Two scripted drives, as elsewhere."""

import asyncio
import errno
import os
import socket
from collections.abc import Awaitable, Callable
from typing import Any

import can
import pytest

from drivers.canopen.bus import FAILURES_ALLOWED, CanBus
from drivers.canopen.link import CanopenLink
from drivers.registry import build_links
from gateway.core.line import CanopenBus
from gateway.core.signals import DriveRequest, DriveState, Inputs, Outputs, Quality
from tests.protocol.driver_support import ENABLED, GROUP, Drive, Drives, cycle, line, until
from tests.support.ports import free_port

Body = Callable[[CanopenLink, Drives, Drive, Drive], Awaitable[None]]


def bench(body: Body, **bus: Any) -> None:
    """Two drives on a fresh bus, the link prepared."""
    if not bus:
        bus = {"interface": "udp_multicast", "channel": GROUP, "port": free_port()}
    peer_bus = {**bus, "hop_limit": 0, "fd": False} if bus["interface"] == "udp_multicast" else bus

    async def run() -> None:
        first, second = Drive(1), Drive(2)
        link = build_links(line(can_bus=bus))[0]
        assert isinstance(link, CanopenLink)
        async with Drives([first, second], **peer_bus) as drives:
            await link.open()
            try:
                await link.prepare()
                await body(link, drives, first, second)
            finally:
                await link.close()

    asyncio.run(run())


def write(link: CanopenLink) -> None:
    outputs = Outputs(2)
    outputs.drive_request[:] = DriveRequest.ENABLE
    outputs.torque_nm[:] = 8.0
    link.write(outputs)


def wire(link: CanopenLink) -> Any:
    """Through which the frames go."""
    return link._bus._wire  # noqa: SLF001


async def turn(link: CanopenLink, inputs: Inputs) -> None:
    """A cycle, and the rest of its period: with all drives absent, nothing is waited for in it."""
    await cycle(link, inputs, 0.02)
    await asyncio.sleep(0.005)


def raises(error: Exception) -> Callable[..., None]:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    return fail


DOWN = can.CanOperationError("Failed to receive: Network is down", errno.ENETDOWN)
NAMELESS = can.CanOperationError("the adapter does not say why")


@pytest.mark.parametrize("error", [DOWN, OSError(errno.ENODEV, "No such device"), NAMELESS])
@pytest.mark.parametrize("kind", ["udp_multicast", pytest.param("virtual", marks=pytest.mark.wires)])
def test_a_dead_receiver_is_missed_in_the_same_cycle_and_opened_again(kind: str, error: Exception) -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        first.statusword = second.statusword = ENABLED
        await cycle(link, inputs)
        assert inputs.speed.good()
        failures: list[Exception] = []

        def recv(*_: Any, **__: Any) -> None:
            failures.append(error)
            raise error

        wire(link).receive = recv
        await turn(link, inputs)
        assert list(inputs.speed.quality) == [Quality.STALE] * 2
        async with asyncio.timeout(10.0):
            while link.health.reconnects == 0 or not inputs.speed.good():
                await turn(link, inputs)
        assert link.health.reconnects == 1
        assert len(failures) <= FAILURES_ALLOWED + 10, "a dead receiver is left alone"

    if kind == "virtual":
        bench(body, interface="virtual", channel="test-driver-canopen-bus")
    else:
        bench(body)


def test_three_missed_periods_drop_the_drives_and_they_are_told_when_the_bus_is_back() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        first.statusword = second.statusword = ENABLED
        await cycle(link, inputs)
        real = wire(link).receive
        wire(link).receive = wire(link).send = raises(DOWN)
        drives.heartbeat(1)  # something arrives, and cannot be read
        await until(lambda: bool(link._bus.gone))  # noqa: SLF001
        link._bus._retry_s = float("inf")  # noqa: SLF001
        assert real is not None
        first.rpdos.clear()
        first.nmt.clear()
        for missed in (1, 2, 3):
            await cycle(link, inputs, 0.0)
            state = DriveState.ABSENT if missed == 3 else DriveState.ENABLED
            assert list(inputs.drive_state) == [state] * 2, missed
            write(link)
        assert link.health.absent == ["drive-1", "drive-2"] and "Network is down" in link.health.last_error
        link._bus._retry_s = 0.0  # noqa: SLF001
        async with asyncio.timeout(5.0):
            while not first.nmt:
                await turn(link, inputs)
                write(link)
        write(link)
        assert (first.nmt, first.rpdos, link.health.reconnects) == ([0x80], [], 1)

    bench(body)


def test_the_pauses_between_attempts_grow(monkeypatch: pytest.MonkeyPatch) -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        wire(link).receive = raises(DOWN)
        drives.heartbeat(1)
        await until(lambda: bool(link._bus.gone))  # noqa: SLF001
        attempts: list[float] = []
        now_s = 1000.0

        def fails(**_: Any) -> None:
            attempts.append(now_s)
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))

        with monkeypatch.context() as patched:
            patched.setattr(can, "Bus", fails)
            for k in range(900):
                now_s = 1000.0 + 0.01 * k
                link.trigger(now_s)
                if link._bus._reopening is not None:  # noqa: SLF001
                    await asyncio.wait([link._bus._reopening])  # noqa: SLF001
                await link.collect(Inputs(2), 0.0)
        pauses = [later - earlier for earlier, later in zip(attempts, attempts[1:], strict=False)]
        assert pauses == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.6, 2.0, 2.0], abs=0.011)
        assert "No such device" in link.health.last_error and link.health.reconnects == 0
        link.trigger(now_s + 3.0)
        await until(lambda: not link._bus.gone)  # noqa: SLF001
        await link.collect(Inputs(2), 0.0)
        assert link.health.reconnects == 1

    bench(body)


def test_prepare_opens_a_bus_that_is_gone() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        wire(link).receive = raises(DOWN)
        drives.heartbeat(1)
        await until(lambda: bool(link._bus.gone))  # noqa: SLF001
        await link.prepare()
        inputs = Inputs(2)
        await cycle(link, inputs)
        assert inputs.speed.good() and link.health.reconnects == 1

    bench(body)


def error_frame(identifier: int, data: bytes = bytes(8)) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_error_frame=True, is_extended_id=False)


def test_error_frames_are_told_and_bus_off_opens_the_bus_again() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await cycle(link, inputs)
        frames: list[can.Message | None] = [error_frame(0x004, bytes([0, 0x20, 0, 0, 0, 0, 0, 0])), None]
        wire(link).receive = lambda: frames.pop(0)
        link._bus.drain()  # noqa: SLF001
        assert link.health.last_error == "CAN error: controller: error passive, sending"
        assert not link._bus.gone and link.health.malformed == 1  # noqa: SLF001
        frames[:] = [error_frame(0x040), error_frame(0x004), None]
        link._bus.drain()  # noqa: SLF001
        assert len(frames) == 2, "nothing more is read"
        assert "bus-off" in link._bus.gone and "termination" in link._bus.gone  # noqa: SLF001
        async with asyncio.timeout(5.0):
            while not (link.health.reconnects and inputs.speed.good()):
                await turn(link, inputs)
        assert link.health.reconnects == 1

    bench(body)


def test_a_sender_that_is_full_for_long_is_opened_again() -> None:
    """Nobody acknowledges: the buffer fills, and python-can gives no number with that."""

    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        wire(link).send = raises(can.CanOperationError("Transmit buffer full"))
        sends = 0
        while not link._bus.gone:  # noqa: SLF001
            link._bus.send(0x080, b"")  # noqa: SLF001
            sends += 1
        assert sends == FAILURES_ALLOWED and "Transmit buffer full" in link._bus.gone  # noqa: SLF001
        async with asyncio.timeout(5.0):
            while not inputs.speed.good():
                await turn(link, inputs)
        assert link.health.reconnects == 1

    bench(body)


def test_frames_that_are_none_do_not_close_the_bus() -> None:
    port = free_port()

    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        asyncio.get_running_loop().remove_reader(drives._bus.fileno())  # noqa: SLF001 (it would choke)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as raw:
            raw.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            for k in range(40):
                raw.sendto(b"\xc1no frame", (GROUP, port))
                if k == 20:
                    drives.send(0x701, b"\x05")
            await until(lambda: link.health.malformed == 40)
        assert not link._bus.gone  # noqa: SLF001
        await cycle(link, inputs, 0.0)
        assert link.health.reconnects == 0

    bench(body, interface="udp_multicast", channel=GROUP, port=port)


def test_socketcan_is_opened_with_filters_and_error_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[dict[str, Any]] = []

    def remember(**options: Any) -> None:
        opened.append(options)
        raise OSError(errno.ENODEV, "no such device")

    monkeypatch.setattr(can, "Bus", remember)

    async def run() -> None:
        link = build_links(line(can_bus={"interface": "socketcan", "channel": "can0"}))[0]
        with pytest.raises(OSError, match="ip link set can0 up"):
            await link.open()
        await link.close()
        many = CanBus(
            CanopenBus(name="can", protocol="canopen", interface="socketcan", channel="can0"),
            range(600),
            lambda *_: None,
            lambda _: None,
        )
        with pytest.raises(OSError):
            many.open()

    asyncio.run(run())
    options, unfiltered = opened
    assert options["ignore_rx_error_frames"] is False
    wanted = sorted(base + node for base in (0x080, 0x180, 0x580, 0x700) for node in (1, 2))
    assert options["can_filters"] == [{"can_id": i, "can_mask": 0x7FF, "extended": False} for i in wanted]
    assert "can_filters" not in unfiltered, "more than the kernel takes"
