"""How much anybody may have written down: a few at once, then one now and then. Pure; time is given.

What is refused to somebody has to be on record, and must not fill the disk: what is left out is counted, and told with
the next that is not.
"""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

AT_ONCE, EVERY_S = 10, 60.0
MOST_NAMES = 500  #: that are counted apart; the one that was quiet for longest is forgotten first


@dataclass
class _Account:
    left: float
    at_s: float
    left_out: int = 0


class Bounded:
    """By name: `at_once` in a row, and then one every `every_s`."""

    def __init__(self, clock: Callable[[], float], at_once: int = AT_ONCE, every_s: float = EVERY_S) -> None:
        self._clock = clock
        self._at_once = at_once
        self._every_s = every_s
        self._by_name: OrderedDict[str, _Account] = OrderedDict()

    def left_out(self, name: str) -> int | None:
        """None: this one is left out, too. Else it may be written, and so many before it were not."""
        now_s = self._clock()
        account = self._by_name.pop(name, None) or _Account(self._at_once, now_s)
        self._by_name[name] = account
        while len(self._by_name) > MOST_NAMES:
            self._by_name.popitem(last=False)
        account.left = min(self._at_once, account.left + (now_s - account.at_s) / self._every_s)
        account.at_s = now_s
        if account.left < 1.0:
            account.left_out += 1
            return None
        account.left -= 1.0
        before, account.left_out = account.left_out, 0
        return before

    def undo(self, name: str, left_out: int) -> None:
        """What `left_out` let through could not be written: it takes nothing, and so many are told with the next."""
        if (account := self._by_name.get(name)) is not None:
            account.left = min(self._at_once, account.left + 1.0)
            account.left_out += left_out


def with_left_out(what: dict[str, object], left_out: int) -> dict[str, object]:
    """The content of a record that stands for those before it, too."""
    return {**what, "left_out": left_out} if left_out else what
