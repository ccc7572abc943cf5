"""What the CANopen link asks by SDO beside the cycle: whether watchdogs are still set; and in whose threads."""

import asyncio
import struct
import threading

import pytest

from drivers.canopen import questions
from drivers.canopen.link import CanopenLink
from drivers.canopen.sdo import SdoBus, SdoSilent
from gateway.core.finding import finding
from gateway.core.signals import DriveRequest, DriveState, Inputs
from gateway.wording.catalogue import sentence
from tests.protocol.driver_support import ENABLED, Drive, Drives, cycle, until
from tests.protocol.test_driver_canopen import bench, settle, write

UPLOAD, ABORT = 0x40, 0x80  #: first byte of an SDO request
WATCHDOG, MODE = b"\x00\x14\x05", b"\x61\x60\x00"  #: index and sub-index


async def dropped(link: CanopenLink, drives: Drives, inputs: Inputs) -> None:
    """Cycles until a drive was told to leave operational."""
    async with asyncio.timeout(5.0):
        while all(drive.nmt[-1] == 0x01 for drive in drives.drives.values()):
            await cycle(link, inputs)
            write(link, DriveRequest.ENABLE, 10.0)
            await settle(drives)


@pytest.mark.parametrize("value", [0, 200])
def test_a_watchdog_that_was_altered_drops_its_drive(value: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(questions, "VERIFY_S", 0.0)

    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await link.prepare()
        first.statusword = second.statusword = ENABLED
        second.objects[0x1400, 5] = struct.pack("<H", value)
        await dropped(link, drives, inputs)
        altered = {"object": "object 1400h sub 5", "set_counts": 100, "found_counts": value}
        distrust = link._nodes[1].station.distrust  # noqa: SLF001
        assert distrust == finding("object-changed", device="drive-2", **altered)
        assert link.health.last_error == sentence(distrust)
        first.rpdos.clear()
        second.rpdos.clear()
        await cycle(link, inputs)
        write(link, DriveRequest.ENABLE, 10.0)
        await settle(drives)
        assert (first.nmt[-1], second.nmt[-1], second.rpdos) == (0x01, 0x80, []) and first.rpdos
        assert list(inputs.drive_state) == [DriveState.ENABLED, DriveState.FAULT]

    bench(body)


def test_watchdogs_are_read_one_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """With drives that do not answer: the next one waits for the end, and none of them is judged by it."""
    monkeypatch.setattr(questions, "VERIFY_S", 0.0)

    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await link.prepare()
        first.statusword = second.statusword = ENABLED
        first.sdo_answers = second.sdo_answers = False
        drives.frames.clear()
        async with asyncio.timeout(10.0):
            while len(asked(drives)) < 6:
                await cycle(link, inputs)
                write(link, DriveRequest.ENABLE, 10.0)
                await settle(drives)
        assert {data[1:4] for _, data in asked(drives) if data[0] == UPLOAD} == {WATCHDOG}
        turns = [(cob_id, data[0]) for cob_id, data in asked(drives)[:6]]
        assert turns == [(cob_id, command) for cob_id in (0x601, 0x602, 0x601) for command in (UPLOAD, ABORT)]
        assert first.nmt == second.nmt == [0x80, 0x01] and first.rpdos and second.rpdos
        assert list(inputs.drive_state) == [DriveState.ENABLED] * 2

    bench(body)


def asked(drives: Drives) -> list[tuple[int, bytes]]:
    """By SDO, but for the modes that they are in."""
    sdo = [(cob_id, data) for cob_id, data in drives.frames if cob_id in (0x601, 0x602)]
    return [(cob_id, data) for cob_id, data in sdo if data[1:4] != MODE]


def test_one_wrong_reading_of_a_watchdog_is_not_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(questions, "VERIFY_S", 0.0)

    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        inputs = Inputs(2)
        await link.prepare()
        answer, lies = first.sdo, [0]

        def lie_now_and_then(request: bytes) -> bytes | None:
            answered = answer(request)
            if request[1:4] != bytes.fromhex("001405") or answered is None:
                return answered
            lies.append(1 - lies[-1])
            return answered[:4] + bytes(4) if lies[-1] else answered

        first.sdo = lie_now_and_then
        async with asyncio.timeout(5.0):
            while len(lies) < 9:
                await cycle(link, inputs)
                write(link, DriveRequest.OFF)
                await settle(drives)
        assert first.nmt == [0x80, 0x01]

    bench(body)


def test_each_watchdog_is_read_once_a_second() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        await link.prepare()
        seen: list[tuple[float, int]] = []
        drives.frames.clear()
        for now_s in (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5):
            link._questions.verify(now_s)  # noqa: SLF001
            task = link._questions._verifying  # noqa: SLF001
            assert task is not None
            await task
            seen += [(now_s, cob_id) for cob_id, _ in asked(drives)]
            drives.frames.clear()
        assert seen == [(0.0, 0x601), (0.5, 0x602), (1.0, 0x601), (1.5, 0x602)]

    bench(body)


# SDO and threads


def test_sdo_needs_no_thread_and_ends_with_the_link() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        release = threading.Event()
        loop = asyncio.get_running_loop()
        hold = [loop.run_in_executor(None, release.wait, 10.0) for _ in range(64)]
        try:
            async with asyncio.timeout(5.0):
                await link.prepare()
        finally:
            release.set()
            await asyncio.gather(*hold)
        assert not any(thread.name.startswith("sdo") for thread in threading.enumerate())
        first.sdo_answers = False
        asking = asyncio.create_task(link._sdo.upload(1, 0x6041, 0, 2))  # noqa: SLF001
        await until(lambda: any(data[1:3] == b"\x41\x60" for _, data in asked(drives)[-1:]))
        await link.close()
        with pytest.raises(SdoSilent):
            await asking

    bench(body)


NAME = b"a name of 23 characters"
HEAD = bytes.fromhex("081000")  #: of 1008h sub 0


def in_segments(request: bytes, left: list[bytes]) -> bytes | None:
    """The server's side of an upload of `NAME` (CiA 301, 7.2.4.3.6); `left` are the segments to come."""
    if request[0] == 0x40:
        left[:] = [NAME[k : k + 7] for k in range(0, len(NAME), 7)]
        return b"\x41" + request[1:4] + struct.pack("<I", len(NAME))
    if request[0] & 0xE0 != 0x60:
        return None
    segment = left.pop(0)
    return bytes((request[0] & 0x10 | (7 - len(segment)) << 1 | (not left),)) + segment.ljust(7, b"\0")


@pytest.mark.parametrize("size", [256, 4], ids=["as a text", "though four bytes were expected"])
def test_what_comes_in_segments_is_read_in_a_thread_of_the_buss_own(size: int) -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        left: list[bytes] = []
        first.sdo = lambda request: in_segments(request, left)
        assert await link._sdo.upload(1, 0x1008, 0, size) == NAME  # noqa: SLF001
        assert any(thread.name.startswith("sdo") for thread in threading.enumerate())
        aborts = [data for _, data in asked(drives) if data[0] == ABORT]
        assert [data[1:4] for data in aborts] == ([] if size > 4 else [HEAD]), "the short transfer is ended first"
        await link.close()
        assert not any(thread.name.startswith("sdo") for thread in threading.enumerate()), "closed with the link"

    bench(body)


def test_a_transfer_in_segments_is_ended_before_the_next_request_to_its_node() -> None:
    sent: list[bytes] = []

    async def scene() -> None:
        loop = asyncio.get_running_loop()

        def send(cob_id: int, data: bytes) -> bool:
            sent.append(data)
            if data[0] == UPLOAD:
                answer = "4108100017000000" if data[1:4] == HEAD else "4B41600037120000"
                loop.call_soon(bus.on_frame, 0x581, bytes.fromhex(answer), 0.0)
            return True

        bus = SdoBus(send, [1])
        long = asyncio.create_task(bus.upload(1, 0x1008, 0, 4))
        following = asyncio.create_task(bus.upload(1, 0x6041, 0, 2))
        assert await following == b"\x37\x12"
        long.cancel()
        await asyncio.wait([long])
        await bus.close()

    asyncio.run(scene())
    assert [data[0] for data in sent[:3]] == [UPLOAD, ABORT, UPLOAD]
    assert sent[1] == b"\x80" + HEAD + struct.pack("<I", 0x08000000)


@pytest.mark.parametrize("answer", ["4B100000", "4B416001", "20416000", "60406100", "60416001"])
def test_an_answer_to_another_question_is_none(answer: str) -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        first.sdo = lambda request: bytes.fromhex(answer).ljust(8, b"\0")
        with pytest.raises(SdoSilent):
            await link._sdo.upload(1, 0x6041, 0, 2)  # noqa: SLF001
        with pytest.raises(SdoSilent):
            await link._sdo.download(1, 0x6041, 0, b"\1\2")  # noqa: SLF001

    bench(body)


def test_an_answer_that_nobody_waits_for_any_more_is_not_the_next_ones() -> None:
    async def body(link: CanopenLink, drives: Drives, first: Drive, second: Drive) -> None:
        answer, held = first.sdo, [False]

        def hold(request: bytes) -> bytes | None:
            held[0] = True
            return None

        first.sdo = hold
        asking = asyncio.create_task(link._sdo.upload(1, 0x6041, 0, 2))  # noqa: SLF001
        await until(lambda: held[0])
        asking.cancel()
        await asyncio.wait([asking])
        first.sdo, first.statusword = answer, 0x1237
        following = asyncio.create_task(link._sdo.upload(1, 0x6041, 0, 2))  # noqa: SLF001
        drives.frames.clear()
        await asyncio.sleep(0)
        drives.send(0x581, bytes.fromhex("4B41600050020000"))  # late, to the one that was given up
        assert await following == b"\x37\x12"

    bench(body)
