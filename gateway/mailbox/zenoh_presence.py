"""Who serves a topic is known as alive there, by a liveliness token under the topic's key. Here it is seen."""

from collections.abc import Callable
from dataclasses import dataclass, field

import zenoh

from gateway.mailbox.zenoh_bridge import Bridge


@dataclass
class _Watched:
    handlers: list[Callable[[bool], None]] = field(default_factory=list)
    here: bool = False  #: as the handlers know it
    newest: bool = False  #: as Zenoh told it last
    told: bool = True  #: nothing is on its way to the event loop


class Presence:
    def __init__(self, session: zenoh.Session, bridge: Bridge, gone: Callable[[str], None]) -> None:
        """`gone` is called with a key that is watched, when nobody serves it any more."""
        self._session = session
        self._bridge = bridge
        self._gone = gone
        self._watched: dict[str, _Watched] = {}

    def watch(self, key: str, handler: Callable[[bool], None] | None = None) -> None:
        """Call `handler` with whether somebody serves `key`, when that changes; first when somebody does."""
        if (watched := self._watched.get(key)) is None:
            watched = self._watched[key] = _Watched()
            self._subscribe(key, watched)
        if handler is not None:
            watched.handlers.append(handler)
            if watched.here:
                handler(True)

    def _subscribe(self, key: str, watched: _Watched) -> None:
        def changed(sample: zenoh.Sample) -> None:
            with self._bridge.lock:  # one call at a time, however often somebody comes and goes
                watched.newest, told = sample.kind == zenoh.SampleKind.PUT, watched.told
                watched.told = False
            if told:
                self._bridge.call(self._seen, key, watched)

        callback = zenoh.handlers.Callback(changed, indirect=False)
        self._session.liveliness().declare_subscriber(key, callback, history=True)

    def _seen(self, key: str, watched: _Watched) -> None:
        with self._bridge.lock:
            here, watched.told = watched.newest, True
        if watched.here == here:
            return
        watched.here = here
        if not here:
            self._gone(key)
        for handler in watched.handlers:
            handler(here)
