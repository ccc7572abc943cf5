"""Whether the devices of a server may be trusted with torque: the right ones, off, watchdogs set and read back."""

from collections.abc import Sequence
from typing import Protocol

from drivers.opcua.amplifier import Amplifier
from drivers.opcua.drive import Axis
from drivers.opcua.messages import Answer
from drivers.opcua.plc import Plc
from drivers.opcua.proof import Watchdog, not_read
from drivers.opcua.status import describe, is_done
from gateway.core.finding import Finding, finding
from gateway.core.line_problem import printable
from gateway.tasks.cleanup import finish

Device = Axis | Amplifier | Plc


class NoAnswer(Exception):
    """The question was not answered; the text says why."""


class Ask(Protocol):
    """Write and read, and wait for both answers. Raises NoAnswer. What has to be read after the write, ask for then.

    Given the `connection` of an earlier answer, nothing is written on another, and an answer from another is none.
    """

    async def __call__(
        self, writes: tuple[tuple[int, float], ...], reads: tuple[int, ...], *, connection: int | None = None
    ) -> Answer: ...


async def prepare_devices(
    ask: Ask, devices: Sequence[Device], noted: dict[Device, float], serials: dict[str, str]
) -> list[Finding]:
    """Check every device, set every watchdog and read it back. What speaks against it; it is undone then.

    What a watchdog was before it was written is in `noted` (counts) while it may have to be restored: also when this
    is cancelled half-way. What devices tell of their serial numbers is in `serials`.
    """
    reasons: list[Finding] = []
    before: dict[Device, float] = {}
    for device in devices:
        try:
            readings = (await ask((), device.prepare_reads)).readings
            against = device.against(readings) or await _read_serial(ask, device, serials)
        except NoAnswer as error:
            return [*reasons, finding("server-silent", device=device.name, error=str(error))]
        reasons += against
        before[device] = readings[1].value  # of those that have one, the watchdog
    if reasons:
        return reasons
    for device in devices:
        if device.watchdog is not None:
            # Before the write: one that does not answer may have been written all the same.
            noted.setdefault(device, before[device])
            try:
                reasons += await _set_watchdog(ask, device.name, device.watchdog)
            except NoAnswer as error:
                reasons.append(finding("setting-not-set", **_watchdog_of(device.name), error=str(error)))
                break
    if reasons:
        return reasons + await finish(restore(ask, noted))
    noted.clear()
    return []


async def _read_serial(ask: Ask, device: Device, serials: dict[str, str]) -> list[Finding]:
    """A question of its own: its answer's text is the number. An amplifier's is that of each load cell on it."""
    if device.serial is None:
        return []
    answer = await ask((), (device.serial,))
    if not answer.readings[0].good:
        return [not_read(device.name, "serial", answer.readings[0])]
    if answer.text:
        serials.update(dict.fromkeys(device.name.split(", "), printable(answer.text)))
    return []


async def restore(ask: Ask, noted: dict[Device, float]) -> list[Finding]:
    """Set the watchdogs to what they were; the last that was written is the first. What went wrong.

    A server that does not answer is asked once.
    """
    reasons: list[Finding] = []
    for device in reversed(list(noted)):
        assert device.watchdog is not None
        try:
            reasons += await _undo(ask, device.name, device.watchdog, noted[device])
        except NoAnswer as error:
            reasons += [_not_restored(left.name, str(error)) for left in reversed(list(noted))]
            noted.clear()
            break
        del noted[device]  # not before: cut here, the next call goes on
    return reasons


async def _set_watchdog(ask: Ask, name: str, watchdog: Watchdog) -> list[Finding]:
    status = (await ask(((watchdog.node, float(watchdog.counts)),), ())).written[0]
    if not is_done(status):
        return [finding("setting-not-set", **_watchdog_of(name), error=describe(status))]
    found = (await ask((), (watchdog.node,))).readings[0]
    if not found.good:
        return [not_read(name, "watchdog", found)]
    if found.value != watchdog.counts:
        counts = {"set_counts": watchdog.counts, "found_counts": found.value}
        return [finding("setting-reads-back", **_watchdog_of(name), **counts)]
    return []


async def _undo(ask: Ask, name: str, watchdog: Watchdog, before: float) -> list[Finding]:
    status = (await ask(((watchdog.node, before),), ())).written[0]
    return [] if is_done(status) else [_not_restored(name, describe(status))]


def _not_restored(name: str, error: str) -> Finding:
    return finding("setting-not-restored", **_watchdog_of(name), error=error)


def _watchdog_of(name: str) -> dict[str, str]:
    return {"device": name, "setting": "watchdog"}
