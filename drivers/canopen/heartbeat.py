"""Our own heartbeat, for drives whose watchdog is a heartbeat consumer (CiA 301, object 1016h). No I/O.

It leaves from the link's `write` only, at most a third of the watchdog time apart: a loop that hangs stops it. But all
drives that listen share it, so it cannot be withheld from one of them, as an RPDO can. It is withheld from all, in
every cycle in which one of them was not given its command, until that one has confirmed by SDO that its torque is off:
since it was dropped, and since it was last seen with torque.

A drive that is deaf to SYNC, or was restarted, confirms within milliseconds, and the others notice nothing. One that is
dead or mute never does: then every drive that listens loses its torque within the watchdog time. That is no controlled
stop; it is the price of a shared watchdog, and the only bound on the torque of a drive of which nothing is known. The
order to leave operational is sent as well, but nothing rests on its being heard.
"""

HEARTBEAT = 0x700  #: COB-ID of node 0
_OPERATIONAL = b"\x05"
_SHARE = 1.0 / 3.0  #: of the watchdog time, at most from one heartbeat to the next


class HeartbeatProducer:
    """Node `node`; the drives that listen wait `watchdog_s`; cycles are `period_s` apart."""

    def __init__(self, node: int, watchdog_s: float, period_s: float) -> None:
        self.cob_id = HEARTBEAT + node
        self.payload = _OPERATIONAL
        self._due_after_s = _SHARE * watchdog_s - period_s  #: waiting another cycle would be too long
        self._sent_s = float("-inf")

    def due(self, now_s: float) -> bool:
        """Whether this cycle has to send one."""
        return now_s - self._sent_s >= self._due_after_s

    def sent(self, now_s: float) -> None:
        self._sent_s = now_s

    def forget(self) -> None:
        """Silence: the next one is due at once."""
        self._sent_s = float("-inf")
