"""Attempts for which the loop is started anew or a copy of the audit is rewritten; the line is put back afterwards."""

import random
import shutil
import tempfile
import time
from pathlib import Path

from gateway.core.deployment import first_region
from gateway.core.messages import Arm, Start
from gateway.loop.process import SET_ASIDE
from gateway.mailbox.paths import LOOP_DATA
from gateway.mailbox.port import Unreachable
from tests.bench.intrusions_families import Attempt
from tests.bench.intrusions_files import CELLS, HARMLESS, KEPT, NOT_STARTED, PROOF, SPOILS_OF_ALL, WIRING, rewrite
from tests.closed_loop.gate_line import GateLine

TOLD_S = 20.0  #: for what no record explains to be told
UP_S = 15.0
LOOK_S = 0.1


class Restarts:
    """Of one line, in RUN. `older`: an earlier copy of what the loop keeps."""

    def __init__(self, line: GateLine, older: Path) -> None:
        self._line = line
        self._older = older

    def with_files(self, attempt: Attempt) -> tuple[list[str], set[str]]:
        """What was wrong with a loop that was started on spoiled files, and the codes that were told."""
        line, before = self._line, self._line.configuration()
        rng = random.Random(attempt.steps[0]["seed"])
        with tempfile.TemporaryDirectory() as saved:
            self._save(Path(saved))
            self._end_loop()
            began_wall_s = time.time()
            SPOILS_OF_ALL[attempt.spoils](rng, line.folder, self._older)
            line.start_loop(proved=False)
            if attempt.spoils in WIRING:
                wrong, told = self._found_of_wiring(attempt.spoils)
            else:
                wrong, told = self._found(before.hash, before.region, attempt.spoils in HARMLESS)
                wrong += self._against_alarms(began_wall_s)
            self._end_loop()
            self._put_back(Path(saved))
        line.start_loop()
        self._is_up()
        self._settled()
        if line.in_service() != before.hash:
            wrong.append("what was kept is not in service again with its files put back")
        line.arm_and_start()
        return wrong, told

    def _found(self, before: str, region: object, may_be_explained: bool) -> tuple[list[str], set[str]]:
        line, wrong = self._line, list[str]()
        if not self._is_up():
            return [], {"the loop refused to start"}  # nothing runs
        found = line.configuration()
        if (found.hash, found.region) == (before, region):
            return [], set()
        if not found.region.within(first_region(line.line)):
            wrong.append("what nobody explains goes further than a first configuration")
        told = self._told()
        if not told and not may_be_explained:
            wrong.append("nobody was told that something else controls the line")
        if told and line.order(Arm()).ok:
            wrong.append("what nobody explains was armed")
        return wrong, told

    def _found_of_wiring(self, spoils: str) -> tuple[list[str], set[str]]:
        """What nobody has proved is not started, and told; what a record does not explain is told."""
        line, wrong = self._line, list[str]()
        if not self._is_up():
            return ["the loop did not start"], set()
        line.look_on(line.status, lambda status: status is not None and status.loop.running)
        line.look_on(lambda: line.order(Arm()), lambda reply: reply.ok, TOLD_S)  # once what was killed in RUN rests
        started = line.order(Start())
        told = {one.code for one in started.findings}
        if started.ok == (spoils in NOT_STARTED):
            wrong.append(
                f"start was {'done' if started.ok else 'refused'}: {'; '.join([started.text, *started.reasons])}"
            )
        until_s = time.monotonic() + TOLD_S
        while (
            spoils == "proof: one that no record knows"
            and "wiring-proof-unexplained" not in told
            and time.monotonic() < until_s
        ):
            told |= {one.code for one in getattr(line.status(), "unexplained", ())}
            time.sleep(LOOK_S)
        if not told and spoils != "cells: emptied":
            wrong.append("nobody was told of the wiring")
        return wrong, told

    def _against_alarms(self, since_wall_s: float) -> list[str]:
        """What the loop has set aside since stands in the alarms."""
        data = self._line.folder / "data" / LOOP_DATA
        if not any(path.stat().st_mtime >= since_wall_s for path in data.glob("configuration-set-aside*")):
            return []
        until_s = time.monotonic() + TOLD_S
        while time.monotonic() < until_s:
            if (status := self._line.status()) is not None:
                told = [one for event in status.events if event.kind == SET_ASIDE and event.wall_s >= since_wall_s
                        for one in event.findings]  # fmt: skip
                shown = any(one.name == "unexplained-change" and one.active for one in status.alarms)
                if told and shown and all(one in status.unexplained for one in told):
                    return []
            time.sleep(LOOK_S)
        return ["what was set aside stands in no alarm"]

    def _told(self) -> set[str]:
        until_s = time.monotonic() + TOLD_S
        while time.monotonic() < until_s:
            status = self._line.status()
            found = {one.code for one in getattr(status, "unexplained", ())}
            if "configuration-unexplained" in found:
                return found
            time.sleep(LOOK_S)
        return set()

    def _settled(self) -> None:
        """The gateway has seen what is in service again."""
        until_s = time.monotonic() + TOLD_S
        while time.monotonic() < until_s:
            status = self._line.status()
            found = {one.code for one in getattr(status, "unexplained", ())}
            if status is not None and status.loop.running and "configuration-unexplained" not in found:
                return
            time.sleep(LOOK_S)

    def _is_up(self) -> bool:
        until_s = time.monotonic() + UP_S
        while time.monotonic() < until_s:
            try:
                self._line.configuration()
                return True
            except (Unreachable, AssertionError):
                time.sleep(LOOK_S)
        return False

    def _end_loop(self) -> None:
        try:
            self._line.kill("loop")
        except ProcessLookupError:
            pass
        self._line.children.end("loop")

    def _save(self, to: Path) -> None:
        for path in self._paths():
            if path.is_file():
                shutil.copy(path, to / path.name)

    def _put_back(self, saved: Path) -> None:
        for path in self._paths():
            if (saved / path.name).is_file():
                shutil.copy(saved / path.name, path)
            else:
                path.unlink(missing_ok=True)

    def _paths(self) -> list[Path]:
        data = self._line.folder / "data" / LOOP_DATA
        names = (KEPT, "configuration-before.json", "started-with.json", "deaths.json", PROOF, CELLS)
        return [self._line.folder / "controller.json", *(data / name for name in names)]


def with_audit(line: GateLine, attempt: Attempt) -> list[str]:
    """Chain and anchor of a copy are rewritten together: what was noted elsewhere must find it."""
    try:
        from gateway.cli.audit_against import head_in, why_not_contained
        from gateway.core.audit_head import parse_head
    except ImportError:
        return ["no head leaves the machine: a chain and an anchor that are made anew are taken for sound"]
    rng = random.Random(attempt.steps[0]["seed"])
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        copy.mkdir()
        for path in line.gateway_data.glob("audit*"):
            if path.is_file() and not path.name.endswith(".lock"):
                shutil.copy(path, copy / path.name)
        head = parse_head(head_in(copy))
        rewrite(rng, attempt.rewrites, copy, Path(folder) / "anew")
        why = why_not_contained(Path(folder) / "anew", head)
    return [] if why else ["an audit that was made anew was taken for the one whose head was noted"]
