"""What outlives the loop: the last known good configuration, in one file, all of it or the one before.

Beside it the predictive one that was kept on top of it, if one was (see `configurations`). Never the one on probation:
a loop that starts anew starts with what was kept. The file belongs to the configuration that the loop is started with:
an engineer who gives it another one gets that.

What has ended the loop by an exception twice in a row is not started a third time (`deaths`): the loop goes back to
the last known good without the one on top, then without the model that watches it, then to the good one before, then to
what it is given.
"""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Annotated

from pydantic import Field, ValidationError

from gateway.core.canonical import known_hashes
from gateway.core.controller import Controller, ControllerConfig, canonical, config_hash
from gateway.core.controller_fit import misfits
from gateway.core.deployment import Hash, RecoveryPrediction, Region
from gateway.core.line import Line, Strict
from gateway.loop.deaths import DEATHS, Deaths

FILE = "configuration.json"
BEFORE = "configuration-before.json"  #: the good one that `FILE` has replaced
SET_ASIDE = "configuration-set-aside.json"  #: the last one that has ended the loop too often, for whoever looks into it
GIVEN = "started-with.json"  #: what the loop was given, for the gateway: its messages name configurations by hash


class OnTop(Strict):
    """A predictive configuration that was kept: it controls the line, and is not what the line goes back to."""

    controller: ControllerConfig
    region: Region


@dataclass(frozen=True, slots=True)
class Durable:
    """What a loop that starts anew is to run."""

    epoch: int  #: the last that was taken, whatever became of it
    controller: Controller
    region: Region
    watch: RecoveryPrediction | None = None
    on_top: OnTop | None = None


class Kept(Strict):
    format: Annotated[int, Field(ge=1, le=1)] = 1
    started_with: Hash  #: the configuration that the loop was given
    epoch: Annotated[int, Field(ge=0)]  #: the last that was taken, whatever became of it
    controller: ControllerConfig
    region: Region
    watch: RecoveryPrediction | None
    on_top: OnTop | None = None

    @property
    def durable(self) -> Durable:
        return Durable(self.epoch, self.controller, self.region, self.watch, self.on_top)


def fingerprint(durable: Durable) -> str:
    """The hash of what runs the line, and of what watches it: whatever can end a loop."""
    watch = b"" if durable.watch is None else durable.watch.model_dump_json().encode()
    on_top = b"" if durable.on_top is None else canonical(durable.on_top.controller)
    parts = (canonical(durable.controller), on_top, watch)
    return sha256(b"".join(sha256(part).digest() for part in parts)).hexdigest()


class Store:
    """The file in `folder`, for a loop that was started with `config`."""

    def __init__(self, folder: Path, config: Controller) -> None:
        self.path = folder / FILE
        self.deaths = Deaths(folder / DEATHS)
        self._given = config
        self._started_with, *self._formerly = known_hashes(config)
        self._content: bytes | None = None  #: of the file; None: not known
        self.last: Durable | None = None  #: that was read or written: what a loop that starts now would run
        self._good: Durable | None = None  #: that was decided last

    def read(self, line: Line, say: Callable[[str], None]) -> Kept | None:
        """What the loop is to run, or None: what it is given. A file that is not used is told, with why."""
        kept = self._usable(self.path, line, say)
        if kept is None:
            return None
        self.last = self._good = kept.durable
        found = self._first_that_may_run(kept, line, say)
        if found is not kept:
            self._set_aside(found, say)
        return found

    def _usable(self, path: Path, line: Line, say: Callable[[str], None]) -> Kept | None:
        try:
            kept = Kept.model_validate_json(path.read_bytes())
        except FileNotFoundError:
            return None
        except (OSError, ValidationError) as error:
            reason = str(error).partition("\n")[0]
            say(f"{path} is not used, the configuration given is: {reason}")
            return None
        if kept.started_with not in (self._started_with, *self._formerly):
            say(f"{path} belongs to another configuration than the one given, which is used")
            return None
        on_top = [] if kept.on_top is None else misfits(kept.on_top.controller, line)
        if reasons := [*misfits(kept.controller, line), *on_top]:
            say(f"{path} is not used, the configuration given is: {'; '.join(reasons)}")
            return None
        return kept

    def _first_that_may_run(self, kept: Kept, line: Line, say: Callable[[str], None]) -> Kept:
        """The first of what there is to go back to that has not ended the loop too often; at the end what is given."""
        for candidate in self._ways_back(kept, line, say):
            if not self.deaths.too_often(fingerprint(candidate.durable)):
                return candidate
        given = {"controller": self._given, "watch": None, "on_top": None}
        return kept.model_copy(update=given)

    def _ways_back(self, kept: Kept, line: Line, say: Callable[[str], None]) -> Iterator[Kept]:
        """What was judged for less stays within it, and epochs go on."""
        yield kept
        if kept.on_top is not None:
            yield kept.model_copy(update={"on_top": None})
        if kept.watch is not None:
            yield kept.model_copy(update={"on_top": None, "watch": None})
        if (before := self._usable(self.path.with_name(BEFORE), line, say)) is not None:
            yield before.model_copy(update={"epoch": kept.epoch, "region": before.region.no_further(kept.region)})

    def _set_aside(self, found: Kept, say: Callable[[str], None]) -> None:
        aside = self.path.with_name(SET_ASIDE)
        why = self.deaths.last_reason
        self._good = None  # it is nothing to go back to
        try:
            self._write(aside, self.path.read_bytes().rstrip(b"\n"))
            self.settle(found.durable)
        except OSError as error:
            say(f"{self.path} could not be set aside: {error.strerror}")
        running = found.controller if found.on_top is None else found.on_top.controller
        say(
            f"what was kept has ended the loop {self.deaths.most} times in a row and lies in {aside} now; "
            f"{running.kind} controller {config_hash(running)[:12]} is used. The last end: {why}"
        )

    def write_given(self, config: Controller) -> None:
        """Before the first period. Raises OSError."""
        self._write(self.path.with_name(GIVEN), canonical(config))

    def write(self, durable: Durable) -> None:
        """On the disk when it returns, and nothing is written where that is there. Takes its time: never in a period.

        Raises OSError; a file that was there is then as it was, or this one, and the next `write` sees to it.
        """
        content = self._content_of(durable)
        if content == self._content:
            return
        self._content = None
        self._write(self.path, content)
        self._content, self.last = content, durable

    def settle(self, durable: Durable) -> None:
        """As `write`, of what is decided: the good one that it has replaced lies beside it from then on."""
        self.write(durable)
        good = self._good
        if good is not None and good.controller != durable.controller:
            self._write(self.path.with_name(BEFORE), self._content_of(replace(good, on_top=None)))
        self._good = durable

    def _content_of(self, durable: Durable) -> bytes:
        kept = Kept(
            started_with=self._started_with, epoch=durable.epoch, controller=durable.controller,
            region=durable.region, watch=durable.watch, on_top=durable.on_top,
        )  # fmt: skip
        return kept.model_dump_json().encode()

    def _write(self, path: Path, content: bytes) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside = path.with_name(path.name + ".part")
        with beside.open("wb") as file:
            file.write(content + b"\n")
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
