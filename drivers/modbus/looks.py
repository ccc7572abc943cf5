"""When the settings of a unit are looked at that no cycle reads: one at a time, in what is left of a period. No I/O."""

from drivers.modbus.unit import Unit

LOOK_S = 1.0  #: until every such setting was looked at again
LOOK_PATIENCE_S = 5.0  #: until a cycle is given up for it, of a device that is too slow for more than the cycles


class Looks:
    """Counts through the groups of `unit.unseen_settings`."""

    def __init__(self, unit: Unit, period_s: float) -> None:
        self._unit = unit
        self._period_s = period_s
        self._due_s = 0.0
        self._group = 0

    def begin(self, now_s: float) -> None:
        """The settings were proven just now."""
        self._due_s = now_s + LOOK_S

    def until_s(self, now_s: float, sent_s: float, deadline_s: float) -> float | None:
        """Until when there is time for a look now, None when there is none or none is due.

        The exchange of this cycle, which was sent at `sent_s` and had time until `deadline_s`, has ended. A look is
        expected to take as long. A device for which there never is the time gives up one cycle for it now and then.
        """
        if not self._unit.unseen_settings.groups or now_s < self._due_s or not self._unit.may_write():
            return None
        if now_s + (now_s - sent_s) <= deadline_s:
            return deadline_s
        return now_s + self._period_s if now_s >= self._due_s + LOOK_PATIENCE_S else None

    def next_group(self, now_s: float) -> int:
        """What is looked at now."""
        groups = len(self._unit.unseen_settings.groups)
        self._due_s = now_s + LOOK_S / groups
        self._group = (self._group + 1) % groups
        return self._group
