"""What the recorder at the simulated drives says is asserted here: where it fails, no second try says anything."""

from collections.abc import Mapping


class Unsafe(AssertionError):
    """The line was in a state that may hurt. That it never is, also on a machine that stalls, is what is promised."""


def require_safe(events: Mapping[str, int]) -> None:
    """Of a recorder's counts by kind none but 0. Raises Unsafe."""
    if any(events.values()):
        raise Unsafe(str({kind: count for kind, count in events.items() if count}))
