"""Who on the bus is given commands and kept alive, cycle by cycle; and who is not any more.

A node that is no longer heard may still hear: every RPDO would renew its watchdog, although it may act on none of them
(they act at SYNC). One that ignores its orders, or whose watchdog is not what `prepare` set it to, is no better. Such a
node is dropped: it is told once to leave operational, which takes torque off (or run away) without a SYNC, and gets no
RPDO until the next `prepare`. If it does not heed the one, its watchdog fires for want of the other.

Drives whose watchdog is a heartbeat consumer share one heartbeat, which cannot be withheld from one of them: see
`heartbeat`.
"""

from collections.abc import Callable, Sequence

from drivers.canopen.heartbeat import HeartbeatProducer
from drivers.canopen.node import Node
from drivers.canopen.questions import Questions
from drivers.canopen.station import ENTER_PRE_OPERATIONAL, nmt_frame
from gateway.core.finding import Finding
from gateway.core.signals import LinkHealth, Outputs
from gateway.wording.catalogue import sentence

Send = Callable[[int, bytes], bool]


class Feed:
    """Sends to `nodes` with `send`, which says whether the bus has taken a frame."""

    def __init__(
        self,
        nodes: Sequence[Node],
        heartbeat: HeartbeatProducer | None,
        questions: Questions,
        send: Send,
        health: LinkHealth,
    ) -> None:
        self._nodes = nodes
        self._heartbeat = heartbeat
        self._questions = questions
        self._send = send
        self._health = health
        self._told: set[int] = set()  #: dropped nodes whose order to leave operational was sent

    def give(self, outputs: Outputs, now_s: float) -> None:
        """One RPDO for each node that takes commands and is there, and the heartbeat when all that need it have one.

        What cannot be commanded is not sent: the watchdog has the last word.
        """
        fed = [self._command(node, outputs, now_s) for node in self._nodes]
        heartbeat = self._heartbeat
        if heartbeat is not None and all(fed) and heartbeat.due(now_s):
            if self._send(heartbeat.cob_id, heartbeat.payload):
                heartbeat.sent(now_s)

    def drop(self, node: Node, trouble: Finding) -> None:
        """It is not fed any more, and that is told."""
        self._drop(node, trouble)
        self._health.last_error = sentence(trouble)

    def _drop(self, node: Node, trouble: Finding) -> None:
        node.station.drop(trouble)
        self._questions.doubt(node)  # what it confirmed before is over

    def forget(self) -> None:
        """Silence."""
        self._told.clear()
        if self._heartbeat is not None:
            self._heartbeat.forget()

    def _command(self, node: Node, outputs: Outputs, now_s: float) -> bool:
        """Whether the node may hear the heartbeat: it was given its command, or has no torque, or needs neither."""
        station = node.station
        if not station.fed:
            return True
        if station.withheld:  # nor is it told to take its torque off: its watchdog has to do it
            return station.listens_to is None
        if not station.dropped:
            self._judge(node, now_s)
        sent = not station.dropped and self._send_command(node, outputs, now_s)
        # Told once; again only where the bus did not take it.
        if station.dropped and station.node not in self._told:
            if self._send(*nmt_frame(ENTER_PRE_OPERATIONAL, station.node)):
                self._told.add(station.node)
        if station.listens_to is None:
            return True
        return self._is_off(node) if station.distrust else sent

    def _judge(self, node: Node, now_s: float) -> None:
        if node.absent(now_s) and (trouble := node.trouble(now_s)):
            self._drop(node, trouble)  # the link tells who is absent
        elif node.defies:
            self.drop(node, node.defies)

    def _is_off(self, node: Node) -> bool:
        """As it has confirmed, with nothing since that speaks against it."""
        if node.shows_torque:
            self._questions.doubt(node)
        return self._questions.has_confirmed(node)

    def _send_command(self, node: Node, outputs: Outputs, now_s: float) -> bool:
        try:
            frame = node.command(outputs, now_s)
        except ValueError as error:
            self._health.malformed += 1
            self._health.last_error = f"{node.station.name}: {error}"
            return False
        return frame is not None and self._send(*frame)
