"""Whether the line is wired as it was proved to be: the stored proof, and what it is held against.

The proof lies in one file beside the kept configuration, all of it or the one before. It is held against the line's
file, the device maps and the serial numbers of the devices each time that these are prepared, and `start` asks for it.
"""

import time
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from drivers.port import Link
from gateway.core.deployment import WiringStatus
from gateway.core.finding import Finding
from gateway.core.json_problems import problems
from gateway.core.line import Line
from gateway.core.wiring_proof import (
    Answer,
    CellProved,
    DriveProved,
    WatchdogProved,
    WiringProof,
    device_identities,
    more_than,
    proof_hash,
    why_not_proved,
    wiring_hash,
)
from gateway.files import MOST_BYTES, read_bytes, written_beside
from safety import actions
from safety.actions import Action, found

FILE = "wiring-proof.json"
CONTRADICTED = "contradicted-cells.json"  #: beside it, by span, what was found of them since they were proved
_FINDINGS = TypeAdapter(dict[int, Finding])


class Wiring:
    """Of `line`, whose device maps are `maps`, by name. `folder` None: nothing is kept."""

    def __init__(self, line: Line, maps: Mapping[str, bytes], folder: Path | None = None) -> None:
        self._line = line
        self._maps = maps
        self.path = None if folder is None else folder / FILE
        self._serials: dict[str, str] | None = None  #: of today; None: no device has been prepared yet
        self.proof: WiringProof | None = None
        self._written: WiringProof | None = None
        self._anew: frozenset[str] = frozenset()  #: devices that it proves anew; empty: all
        self.unusable: list[actions.Finding] = []  #: a file that `read` could not use, for the line's events
        self.contradicted: dict[int, Finding] = {}  #: by span, load cells that were, since they were proved
        self.behind = False  #: the disk does not know of all of them, or still of one that is proved anew
        self.unkept = ""  #: why the disk did not take them when it was tried last
        self._unread = False  #: the file of those could not be used
        self._unproved: list[Finding] = []  #: what else speaks against it
        self.against: list[Finding] = []  #: what speaks against closing the loop on it; empty: it is proved
        self._hold_against()

    def read(self, say: Callable[[str], None]) -> None:
        """The proof on the disk. A file that is not used is told, with why; the line is not proved then."""
        if self.path is None:
            return
        try:
            self.proof = WiringProof.model_validate_json(read_bytes(self.path, MOST_BYTES))
        except FileNotFoundError:
            self.proof = None
        except (OSError, ValidationError) as error:
            self.proof = None
            reason = str(error.strerror) if isinstance(error, OSError) else "; ".join(problems(error, WiringProof)[:5])
            self.unusable.append(found("file-unusable", Action.NONE, file=str(self.path), reason=reason))
            say(f"{self.path} is not used, and the wiring counts as not proved: {reason}")
        self._read_contradicted(self.path.with_name(CONTRADICTED), say)
        self._hold_against()

    def _read_contradicted(self, path: Path, say: Callable[[str], None]) -> None:
        """A file that is not used stood for a cell that nobody has looked at: nothing is proved then."""
        try:
            found_ = _FINDINGS.validate_json(read_bytes(path, MOST_BYTES))
            spans = {cell.span for cell in self._line.load_cells}
            self.contradicted = {span: one for span, one in found_.items() if span in spans}
        except FileNotFoundError:
            return
        except (OSError, ValidationError) as error:
            self.proof, self._unread = None, True
            reason = str(error.strerror) if isinstance(error, OSError) else "it is not as this program wrote it"
            self.unusable.append(found("file-unusable", Action.NONE, file=str(path), reason=reason))
            say(f"{path} is not used, and the wiring counts as not proved until it is proved again: {reason}")

    def look(self, links: Iterable[Link]) -> bool:
        """The devices have been prepared: their serial numbers are those of today.

        Returns whether one of them is another than at the look before, as far as devices tell a number.
        """
        before = self._serials
        self._serials = {name: serial for link in links for name, serial in link.serials.items()}
        self._hold_against()
        return before is not None and before != self._serials

    def _hold_against(self) -> None:
        serials = self._serials
        if serials is None:  # until they are known they may be those that were proved
            serials = {} if self.proof is None else {one.device: one.serial for one in self.proof.devices}
        self._unproved = why_not_proved(self.proof, self._line, self._maps, serials)
        self.against = [*self._unproved, *self.contradicted.values()]

    def contradict(self, found: Iterable[actions.Finding]) -> None:
        """Load cells show what torques and the cells beside them say is not so: what was proved of them is over."""
        told = {int(one.parameters["span"]): one.as_data() for one in found}
        news = {span: one for span, one in told.items() if span not in self.contradicted}
        if news:  # the numbers are those that stopped the line
            self.contradicted = self.contradicted | news
            self.behind = True
            self.against = [*self._unproved, *self.contradicted.values()]  # no hash is made within a period

    def settle(self, contradicted: Mapping[int, Finding]) -> bool:
        """The disk knows which cells are contradicted. Takes its time: never in a period. False: it does not."""
        if self.path is None:
            return True
        path = self.path.with_name(CONTRADICTED)
        try:
            if contradicted:
                path.parent.mkdir(parents=True, exist_ok=True)
                written_beside(path, _FINDINGS.dump_json(dict(contradicted)) + b"\n", 0o600).replace(path)
            else:
                path.unlink(missing_ok=True)
        except OSError as error:
            self.unkept = f"{path}: {error.strerror or error}"
            return False
        return True

    def status(self) -> WiringStatus:
        """For whoever looks on."""
        if self.against or self.proof is None:
            return WiringStatus(unproved=self.against)
        hash_ = proof_hash(self.proof)
        if self._serials is None:
            return WiringStatus(not_read=True, proof=hash_)
        return WiringStatus(proved_wall_s=self.proof.wall_s, proof=hash_)

    def today(self) -> str:
        """The hash of the wiring as it is now."""
        return wiring_hash(self._line, self._maps, self._serials or {})

    def proof_of(
        self,
        drives: list[DriveProved],
        cells: list[CellProved],
        watchdogs: list[WatchdogProved],
        answers: list[Answer],
    ) -> WiringProof:
        """That what is wired now has shown this."""
        return WiringProof(
            wiring=self.today(), wall_s=time.time(),
            devices=device_identities(self._line, self._maps, self._serials or {}),
            drives=drives, cells=cells, watchdogs=watchdogs, answers=answers,
        )  # fmt: skip

    def more_than(self, only: Collection[str]) -> list[Finding]:
        """What speaks against proving nothing but the devices of `only` anew; empty: nothing else has changed."""
        return more_than(only, self.proof, self._line, self._maps, self._serials or {})

    def write(self, proof: WiringProof, only: Collection[str] = ()) -> None:
        """On the disk when it returns. Takes its time: never in a period. Raises OSError.

        Of it the devices of `only` were proved anew; empty: all.
        """
        self._written, self._anew = proof, frozenset(only)
        if self.path is None:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        written_beside(self.path, proof.model_dump_json().encode() + b"\n", 0o600).replace(self.path)

    def take_written(self) -> str:
        """From now on the line is proved by what was written last. Returns which that is, in words.

        Also which devices tell no serial number: nobody sees that one of them is exchanged for another of its kind.
        """
        assert self._written is not None
        self.proof, self._written = self._written, None
        proved = {cell.span for cell in self._line.load_cells if cell.name in self._anew}
        left = {span: one for span, one in self.contradicted.items() if self._anew and span not in proved}
        self.behind |= left != self.contradicted or self._unread  # a file that nobody can read goes, too
        self._unread = False
        self.contradicted = left
        self._hold_against()
        nameless = ", ".join(one.device for one in self.proof.devices if not one.serial)
        unseen = f"; these tell no serial number, prove again when one is exchanged: {nameless}" if nameless else ""
        return f"the wiring is proved: {self.proof.wiring[:12]}{unseen}"
