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
from contextlib import suppress
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Annotated

from pydantic import Field, ValidationError

from gateway.core.canonical import known_hashes
from gateway.core.controller import Controller, ControllerConfig, canonical, config_hash
from gateway.core.controller_fit import misfits
from gateway.core.deployment import Hash, RecoveryPrediction, Region, first_region
from gateway.core.finding import Finding as Coded
from gateway.core.finding import finding
from gateway.core.json_problems import problems
from gateway.core.line import Line, Strict
from gateway.core.proof import Proof, watch_hash
from gateway.files import MOST_BYTES, read_bytes
from gateway.loop.deaths import DEATHS, Deaths
from gateway.mailbox.keys import PublicKey
from gateway.wording.catalogue import sentences
from safety.actions import Action, Finding, found

FILE = "configuration.json"
BEFORE = "configuration-before.json"  #: the good one that `FILE` has replaced
#: The last one that has ended the loop too often, or that the gateway has not signed, for whoever looks into it;
#: those before it have a number.
SET_ASIDE = "configuration-set-aside.json"
MOST_SET_ASIDE = 5
MOST_EPOCH = 2**40  #: that a file which nobody has signed may say: deployments go on from it
GIVEN = "started-with.json"  #: what the loop was given, for the gateway: its messages name configurations by hash


class OnTop(Strict):
    """A predictive configuration that was kept: it controls the line, and is not what the line goes back to."""

    controller: ControllerConfig
    region: Region
    proof: Proof | None = None  #: as of `Kept`


@dataclass(frozen=True, slots=True)
class Durable:
    """What a loop that starts anew is to run."""

    epoch: int  #: the last that was taken, whatever became of it
    controller: Controller
    region: Region
    watch: RecoveryPrediction | None = None
    on_top: OnTop | None = None
    proof: Proof | None = None
    watch_proof: Proof | None = None


class Kept(Strict):
    format: Annotated[int, Field(ge=1, le=1)] = 1
    started_with: Hash  #: the configuration that the loop was given
    epoch: Annotated[int, Field(ge=0)]  #: the last that was taken, whatever became of it
    controller: ControllerConfig
    region: Region
    watch: RecoveryPrediction | None
    on_top: OnTop | None = None
    #: That the gateway has deployed it, for a region that this one lies in. None: it is what the loop was given.
    proof: Proof | None = None
    watch_proof: Proof | None = None  #: that the gateway has sent `watch`

    @property
    def is_of_earlier_version(self) -> bool:
        """Whether nothing in it has a field for a signature, which this version writes always."""
        fields = [self.model_fields_set, *([] if self.on_top is None else [self.on_top.model_fields_set])]
        return all(not {"proof", "watch_proof"} & one for one in fields)

    @property
    def durable(self) -> Durable:
        return Durable(
            self.epoch, self.controller, self.region, self.watch, self.on_top, self.proof, self.watch_proof
        )  # fmt: skip


def fingerprint(durable: Durable) -> str:
    """The hash of what runs the line, and of what watches it: whatever can end a loop."""
    watch = b"" if durable.watch is None else durable.watch.model_dump_json().encode()
    on_top = b"" if durable.on_top is None else canonical(durable.on_top.controller)
    parts = (canonical(durable.controller), on_top, watch)
    return sha256(b"".join(sha256(part).digest() for part in parts)).hexdigest()


class Store:
    """The file in `folder`, for a loop that was started with `config`. `key`: by which it knows its gateway, if any."""

    def __init__(self, folder: Path, config: Controller, key: PublicKey | None = None) -> None:
        self.path = folder / FILE
        self.deaths = Deaths(folder / DEATHS)
        self._given = config
        self._key = key
        self.unexplained: list[Coded] = []  #: what speaks against the file that was read; then it is set aside
        self.unverified: list[Coded] = []  #: why what was read is not used, where nobody has done anything wrong
        self._to_set_aside = False  #: whether the file is still there that could not be verified
        self._started_with, *self._formerly = known_hashes(config)
        self._content: bytes | None = None  #: of the file; None: not known
        self.last: Durable | None = None  #: that was read or written: what a loop that starts now would run
        self._good: Durable | None = None  #: that was decided last
        self.unusable: list[Finding] = []  #: files that `read` could not use, for the line's events

    def read(self, line: Line, say: Callable[[str], None]) -> Kept | None:
        """What the loop is to run, or None: what it is given. A file that is not used is told, with why."""
        if why := self.deaths.why_unreadable():
            self._not_used(self.deaths.path, why)
            say(f"{self.deaths.path} {why}; how often a configuration has ended the loop is counted from now on")
        kept = self._usable(self.path, line, say)
        if kept is None:
            return None
        if reasons := self._why_not_explained(kept, line):
            return self._instead(kept, reasons, line, say)
        self.last = self._good = kept.durable
        found = self._first_that_may_run(kept, line, say)
        if found is not kept:
            self._set_aside(found, say)
        return found

    def _not_used(self, path: Path, reason: str) -> None:
        self.unusable.append(found("file-unusable", Action.NONE, file=str(path), reason=reason))

    def _usable(self, path: Path, line: Line, say: Callable[[str], None]) -> Kept | None:
        try:
            kept = Kept.model_validate_json(read_bytes(path, MOST_BYTES))
        except FileNotFoundError:
            return None
        except (OSError, ValidationError) as error:
            reason = str(error.strerror) if isinstance(error, OSError) else "; ".join(problems(error, Kept)[:5])
            self._not_used(path, reason)
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
        given = {"controller": self._given, "watch": None, "on_top": None, "proof": None, "watch_proof": None}
        return kept.model_copy(update=given)

    def _ways_back(self, kept: Kept, line: Line, say: Callable[[str], None]) -> Iterator[Kept]:
        """What was judged for less stays within it, and epochs go on."""
        yield kept
        if kept.on_top is not None:
            yield kept.model_copy(update={"on_top": None})
        if kept.watch is not None:
            yield kept.model_copy(update={"on_top": None, "watch": None, "watch_proof": None})
        before = self._usable(self.path.with_name(BEFORE), line, say)
        if before is not None and not self._why_not_explained(before, line):
            yield before.model_copy(update={"epoch": kept.epoch, "region": before.region.no_further(kept.region)})

    def _why_not_explained(self, kept: Kept, line: Line) -> list[Coded]:
        """What in the file the gateway has not signed; empty: all that it did not write itself, and for this line."""
        found: list[Coded] = []
        is_given = config_hash(kept.controller) in (self._started_with, *self._formerly)
        if kept.proof is not None or not is_given:  # what is said to be proved counts as confirmed
            found += self._why_not_proven(kept.controller, kept.region, kept.epoch, kept.proof, line)
        if (top := kept.on_top) is not None:
            found += self._why_not_proven(top.controller, top.region, kept.epoch, top.proof, line)
        if kept.watch is not None:
            proof, hash_ = kept.watch_proof, watch_hash(kept.watch)
            if proof is None or not self._holds(proof, line) or proof.statement.claim.watch != hash_:
                found.append(finding("watch-unproven", watch=hash_[:12]))
        return found

    def _why_not_proven(
        self, controller: Controller, region: Region, epoch: int, proof: Proof | None, line: Line
    ) -> list[Coded]:
        """Of one configuration that the loop was not given."""
        hash_ = config_hash(controller)
        if proof is None or not self._holds(proof, line):
            return [finding("configuration-unproven", configuration=hash_[:12])]
        claim = proof.statement.claim
        if claim.configuration not in known_hashes(controller):
            return [finding("configuration-unproven", configuration=hash_[:12])]
        if claim.region is None or not region.within(claim.region) or claim.epoch is None or claim.epoch > epoch:
            return [finding("configuration-beyond-proof", configuration=hash_[:12], epoch=epoch)]
        return []

    def _holds(self, proof: Proof, line: Line) -> bool:
        """Whether the gateway of this line has signed it, whenever that was."""
        statement = proof.statement
        mine = (statement.site, statement.line) == (line.site, line.line)
        return mine and self._key is not None and self._key.verifies(proof.signature, statement.signed_bytes())

    def _instead(self, kept: Kept, reasons: list[Coded], line: Line, say: Callable[[str], None]) -> Kept:
        """What is given, in the place of what is not explained.

        Only where a key says so is the file anything but the gateway's: without one it stays where it is.
        """
        if self._key is not None:
            self.unexplained = [self._unsigned(kept)] if kept.is_of_earlier_version else reasons
            return self._confined(kept, line, say)
        found = self._given_instead(kept, line)
        self.unverified = [finding("kept-not-verifiable", path=str(self.path))]
        self.last, self._to_set_aside = found.durable, True
        say(f"the configuration given is used, no further than a first one: {sentences(self.unverified)}")
        return found

    def _unsigned(self, kept: Kept) -> Coded:
        """That nothing in it is signed; whether a version before wrote it so, or an intruder, it does not tell."""
        aside = str(self.path.with_name(SET_ASIDE))
        return finding("configuration-of-earlier-version", configuration=config_hash(kept.controller)[:12], path=aside)

    def _given_instead(self, kept: Kept, line: Line) -> Kept:
        """What is given, no further than a first configuration; epochs go on."""
        changes = {
            "controller": self._given, "region": first_region(line), "epoch": min(kept.epoch, MOST_EPOCH),
            "watch": None, "on_top": None, "proof": None, "watch_proof": None,
        }  # fmt: skip
        return kept.model_copy(update=changes)

    def _confined(self, kept: Kept, line: Line, say: Callable[[str], None]) -> Kept:
        """What is given takes the place of what nobody has signed, and goes no further than a first configuration."""
        found = self._given_instead(kept, line)
        self._move_aside(found, say)
        self.last = self._good = found.durable
        say(
            f"what was kept is not used, and lies in {self.path.with_name(SET_ASIDE)} now; the configuration given is, "
            f"no further than a first one: {sentences(self.unexplained)}"
        )
        return found

    def _move_aside(self, found: Kept, say: Callable[[str], None]) -> None:
        """The file as it was lies beside, `found` is in its place."""
        self._good = None  # it is nothing to go back to
        try:
            self._keep_aside()
            self.settle(found.durable)
        except OSError as error:
            say(f"{self.path} could not be set aside: {error.strerror}")

    def _keep_aside(self) -> None:
        """A copy of the file as it is; those of before move up, and the oldest goes. Raises OSError."""
        names = [self.path.with_name(SET_ASIDE)]
        names += [names[0].with_stem(f"{names[0].stem}-{k}") for k in range(2, MOST_SET_ASIDE + 1)]
        for older, newer in reversed(list(zip(names[1:], names, strict=False))):
            with suppress(FileNotFoundError):
                newer.replace(older)
        self._write(names[0], read_bytes(self.path, MOST_BYTES).rstrip(b"\n"))

    def _set_aside(self, found: Kept, say: Callable[[str], None]) -> None:
        aside, why = self.path.with_name(SET_ASIDE), self.deaths.last_reason
        self._move_aside(found, say)
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
        if self._to_set_aside:
            with suppress(FileNotFoundError):
                self._keep_aside()
            self._to_set_aside = False
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
            region=durable.region, watch=durable.watch, on_top=durable.on_top, proof=durable.proof,
            watch_proof=durable.watch_proof,
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
