"""A line of the gateway on the devices of a peer, and what the peer's own account of it says."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep

import numpy as np

from gateway.core.messages import Arm
from tests.bench.lines import Ports, Wiring, line_text
from tests.bench.live import LiveLine
from tests.system.peer import Peer

SPANS = 3
HELD_PERIODS = 5  #: a signal is held for three; one before is under way, and the command is written with the next
SEEN_LATE_MS = 100.0  #: on a machine that others use, too: two processes and a wire in between
RUN_S = 3.0
SETTLE_S, SETTLED_N = 5.0, 0.3  #: after the line has come to RUN; a law for a long period takes its time
TARGET_N = (28.0, 36.0, 20.0)


@dataclass(frozen=True, slots=True)
class PeerLine:
    live: LiveLine
    peer: Peer
    watchdog_ms: int

    def milliseconds_from(self, cause: str, effect: str) -> float:
        """From the last event of the peer that begins with `cause` to the first such effect behind it."""
        events = self.peer("state")["events"]
        at_ms = max(at_ms for at_ms, text in events if text.startswith(cause))
        after = [late_ms - at_ms for late_ms, text in events if late_ms >= at_ms and text.startswith(effect)]
        assert after, f"no {effect} after {cause}: {events[-12:]}"
        return after[0]

    def tripped_since(self, cause: str) -> list[str]:
        """Watchdogs that have ended something since the last event that begins with `cause`."""
        texts = [text for _, text in self.peer("state")["events"]]
        last = max(k for k, text in enumerate(texts) if text.startswith(cause))
        return [text for text in texts[last:] if "FAULT" in text or "watchdog" in text]

    def told(self) -> str:
        """What the loop has told of itself, the newest last."""
        status = self.live.status()
        assert status is not None
        return "; ".join(event.text for event in status.events)

    def assert_let_go_by(self, effect: str, periods: int) -> None:
        """`effect` came so many periods after the fault that was injected last, or sooner."""
        after_ms = self.milliseconds_from("fault", effect)
        assert after_ms <= 1e3 * periods * self.live.period_s + SEEN_LATE_MS, after_ms

    def assert_watchdogs_ended_it(self, *who: str) -> None:
        """Each of `who` has stopped by itself when no command came any more."""
        for name in who:
            after_ms = self.milliseconds_from("fault", name)
            assert after_ms <= self.watchdog_ms + 1e3 * self.live.period_s + SEEN_LATE_MS, (name, after_ms)

    def wait_stopped(self) -> None:
        """The line has stopped by itself, and no axis pulls."""
        self.live.wait(lambda status: status.loop.state == "STOP")
        deadline_s = monotonic() + 15.0
        while any(self.peer("state")["torque_nm"]) and monotonic() < deadline_s:
            sleep(0.05)  # between two looks
        assert not any(self.peer("state")["torque_nm"])


@contextmanager
def line_on(
    script: str, wiring: Wiring, ports: str, folder: Path, *, period_s: float, watchdog_s: float
) -> Iterator[PeerLine]:
    """Gateway and loop on the peer `script`, which says under `port` where it listens; `ports` names that wire."""
    with (
        Peer(script, SPANS, folder / "certificates", log=folder / "peer.log") as peer,
        LiveLine(folder, period_s) as live,
    ):
        text = line_text(wiring, period_s, Ports(**{ports: peer.ready["port"]}), spans=SPANS)
        live.describe(text.replace("watchdog_s = 0.1 ", f"watchdog_s = {watchdog_s} "))
        assert live.line.limits.watchdog_s == watchdog_s
        live.start_gateway()
        live.start_loop()
        yield PeerLine(live, peer, round(1e3 * watchdog_s))


def assert_arms_and_holds_tension(line: PeerLine) -> None:
    """Silent, armed with watchdogs set and proven, running on target, stopped; by what the peer has seen."""
    before = line.peer("state")
    assert not before["events"] and before["axis_watchdogs_ms"] == [0] * SPANS and before["plc_watchdog_ms"] == 0
    reply = line.live.order(Arm())
    assert reply.ok, reply
    armed = line.peer("state")
    assert armed["axis_watchdogs_ms"] == [line.watchdog_ms] * SPANS and armed["plc_watchdog_ms"] == line.watchdog_ms
    assert not any(armed["torque_nm"]) and armed["speed_m_per_s"] == 0.0
    line.live.stop()
    line.live.run()
    assert line.peer("state")["axes"] == ["ENABLED"] * SPANS
    settled_by_s = monotonic() + SETTLE_S
    while np.abs(np.array(line.peer("state")["tension_n"]) - TARGET_N).max() > SETTLED_N:
        assert monotonic() < settled_by_s, line.peer("state")["tension_n"]
        sleep(0.02)
    seen: list[list[float]] = []
    end_s = monotonic() + RUN_S
    while monotonic() < end_s:
        seen.append(line.peer("state")["tension_n"])
        sleep(0.02)  # between two samples
    assert np.abs(np.mean(seen, axis=0) - TARGET_N).max() < 0.5, np.mean(seen, axis=0)
    assert np.abs(np.array(seen) - TARGET_N).max() < 3.0
    line.live.stop()
    after = line.peer("state")
    assert not any(after["torque_nm"]) and after["speed_m_per_s"] == 0.0
    assert not line.tripped_since("axis 1 ENABLED")
