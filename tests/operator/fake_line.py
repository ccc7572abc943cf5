"""A gateway that is none, behind a real mailbox: tensions that move, a proposal that waits, alarms, a past.

`python -m tests.operator.fake_line [SPANS]` shows the page with it on http://127.0.0.1:8480 until Ctrl-C; anybody may
log in as `viewer`, `operator` or `engineer` with the password `demonstration`.
"""

import asyncio
import json
import math
import sys
import threading
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

from gateway.core.alarms import ALARMS, AcknowledgeAlarm, AlarmStatus, ShelveAlarm
from gateway.core.asked_before import AskedTold, Before, NoteBefore, ShowAsked
from gateway.core.courses import CoursesTold, DrawnCourse, ShowCourses
from gateway.core.decisions import (
    QUERY,
    Decide,
    ListProposals,
    ProposalLine,
    ProposalList,
    ProposalShown,
    RollBackNow,
    shown_hash,
)
from gateway.core.finding import Finding
from gateway.core.line import Line
from gateway.core.line_past import PAST_QUERY, RecordsAfter, RecordsTold, RecordTold, TensionsBetween, TensionsTold
from gateway.core.messages import Reply
from gateway.core.people import FOR_PERSON, ROLES, ForPerson, Role, why_may_not
from gateway.core.proposal import Proposal, proposal_hash
from gateway.core.status import GatewayStatus
from gateway.core.topics import (
    GATEWAY_ASKED,
    GATEWAY_COURSES,
    GATEWAY_FOR_PERSON,
    GATEWAY_PAST,
    GATEWAY_PROPOSALS,
    GATEWAY_STATUS,
)
from gateway.core.verdict import Verdict, verdict_hash
from gateway.mailbox.port import Mailbox
from gateway.mailbox.unix import UnixMailbox
from gateway.operator.line_side import TOPICS, LineSide
from gateway.operator.page.app import page_app
from gateway.operator.page.serve import serve_page
from gateway.wording.catalogue import sentence
from tests.unit.supervisor_support import line_of, short_folder

EXAMPLES = Path("docs/examples")
PASSWORD = "demonstration"
IN_SERVICE = "c6d8cf9c18f6d8b1da935a6124c0cd14f017292be653fbbb0dbf92362e1c9e54"

ASKED = Before(
    interaction="0123456789abcdef", agent="initial-control", task="Which of the tuned controllers is proposed.",
    chosen="LQI with Kalman filter", by_rules=True, instead="",
)  # fmt: skip
NOTES = [
    NoteBefore(
        key="control/integral-action", title="Integral action and constant disturbances", tier=1, overruled_by=[],
        passage="A controller without integral action leaves an error wherever friction takes a constant torque.",
        speaks_to_a_model=False,
    ),
    NoteBefore(
        key="practice/bearing-friction", title="Friction of idler bearings", tier=2, overruled_by=["line/friction"],
        passage="Old grease makes an idler turn hard when the line is cold; it takes tension from span to span.",
        speaks_to_a_model=True,
    ),
]  # fmt: skip


async def check(name: str, password: str) -> Role | None:
    """Whoever is called like a role has it."""
    return role_of(name) if password == PASSWORD else None


def role_of(name: str) -> Role | None:
    return next((role for role in ROLES if role == name), None)


def alarm(name: str = "device-absent", **changes: object) -> AlarmStatus:
    """A row of the table that has just come; `changes` are of its status."""
    row = next(one for one in ALARMS if one.name == name)
    told = {key: getattr(row, key) for key in ("name", "priority", "means", "cause", "consequence", "action")}
    state = {
        "text": "drive of roller-3 has not answered for 1.2 s",
        "active": True,
        "acknowledged": False,
        "first_out": True,
        "since_wall_s": time.time() - 30.0,
        "ended_wall_s": None,
        "acknowledged_by": "",
        "shelved_until_wall_s": None,
    }
    return AlarmStatus.model_validate(told | state | changes)


class FakeGateway:
    """Answers as the gateway does. `said`: what people have said, by whom."""

    def __init__(self, line: Line, mailbox: Mailbox) -> None:
        self.line = line
        self.said: list[ForPerson] = []
        self.against: list[Finding] = []  #: what speaks against whatever is said
        self.alarms: list[AlarmStatus] = []
        self.state = "RUN"
        self.epoch = 3
        self.stage = "waiting"
        self.absent: list[str] = []  #: from the first bus
        self.drawn = False  #: courses were asked for
        self.no_courses = ""  #: why there are none
        self.notes = list(NOTES)
        self.no_log = ""  #: why nothing can be told of what was asked
        self.records: list[str] = []  #: of the audit, behind the two that there are
        self.approvals = 1  #: that a change takes
        self.first = ""  #: who has approved it, where it takes two
        self.drives: dict[int, str] = {}  #: by span, those that are not ENABLED
        self.off_n: dict[int, float] = {}  #: by span, away from its set-point
        self.answers = threading.Event()  #: while it is not set, what people say is heard and not answered
        self.answers.set()
        now = datetime.now(UTC).replace(microsecond=0)
        example = json.loads((EXAMPLES / "proposal.json").read_text())
        example |= {"created": now.isoformat(), "expires": (now + timedelta(minutes=42)).isoformat()}
        example["evidence"] = [*example["evidence"], {"what": f"interaction {ASKED.interaction}"}]
        self.proposal = Proposal.model_validate(example)
        self.verdict = Verdict.model_validate_json((EXAMPLES / "verdict.json").read_text())
        self.setpoints = (line.recipes[0].tension_n * 10)[: line.n]
        for topic, handler in (
            (GATEWAY_STATUS, self._status),
            (GATEWAY_PROPOSALS, self._proposals),
            (GATEWAY_PAST, self._past),
            (GATEWAY_COURSES, self._courses),
            (GATEWAY_ASKED, self._asked),
            (GATEWAY_FOR_PERSON, self._for_person),
        ):
            mailbox.serve(topic, handler)

    @property
    def hash(self) -> str:
        return proposal_hash(self.proposal)

    @property
    def shown(self) -> str:
        return shown_hash(self.hash, verdict_hash(self.verdict), IN_SERVICE, self.epoch, None)

    def status(self) -> GatewayStatus:
        status = json.loads((EXAMPLES / "status.json").read_text())
        now_s = time.time()
        status |= {"wall_s": now_s, "unwind_speed_m_per_s": 0.01 + 1e-4 * math.sin(now_s)}
        status |= {"speed_setpoint_m_per_s": 0.01}
        status["events"] = [one | {"wall_s": now_s - 400.0 + i} for i, one in enumerate(status["events"])]
        ways = {"timeouts": 0, "malformed": 0, "reconnects": 0, "last_error": ""}
        status["buses"] = [ways | {"name": bus.name, "absent": []} for bus in self.line.buses]
        status["buses"][0]["absent"] = self.absent
        status["loop"]["state"] = self.state
        status["spans"] = [self._span(status["spans"][0], i, now_s) for i in range(self.line.n)]
        status["alarms"] = [one.model_dump() for one in self.alarms]
        return GatewayStatus.model_validate(status)

    def _span(self, example: dict[str, object], i: int, now_s: float) -> dict[str, object]:
        setpoint = self.setpoints[i]
        error = self.off_n.get(i, 0.0) + 0.3 * math.sin(now_s * (0.3 + 0.07 * i) + i)
        names = {"name": self.line.spans[i].name, "roller": self.line.rollers[i].name, "number": i + 1}
        values = {"tension_n": setpoint + error, "setpoint_n": setpoint, "error_n": error, "speed_m_per_s": 0.01}
        return example | names | values | {"drive": self.drives.get(i, "ENABLED")}

    async def _status(self, _: bytes) -> bytes:
        return self.status().model_dump_json().encode()

    async def _proposals(self, payload: bytes) -> bytes:
        query = QUERY.validate_json(payload)
        if isinstance(query, ListProposals):
            return self._list().model_dump_json().encode()
        if not self.hash.startswith(query.proposal):
            text = f"no proposal begins with {query.proposal}"
            return Reply(ok=False, state="", text=text).model_dump_json().encode()
        shown = ProposalShown(
            format=1,
            stage=self.stage,
            why="",
            proposal_hash=self.hash,
            shown=self.shown if self.stage == "waiting" else None,
            epoch=self.epoch,
            difference=["gain_state changes by 12.4 %", "predictor.gain_state changes by 3.1 %"],
            proposal=self.proposal,
            verdict=self.verdict,
            approvals=self.approvals,
            approved_by=self.first or None,
        )
        return shown.model_dump_json().encode()

    async def _courses(self, payload: bytes) -> bytes:
        """The first answer is that they are being drawn, as the gateway's is."""
        if self.no_courses:
            return Reply(ok=False, state="", text=self.no_courses).model_dump_json().encode()
        asked, drawing, self.drawn = ShowCourses.model_validate_json(payload), not self.drawn, True
        courses = [] if drawing else [self._course("tension", 1.0, 12.0), self._course("velocity", 1.4, 0.0)]
        return CoursesTold(
            format=1, proposal=asked.proposal, verdict=verdict_hash(self.verdict), model="ab" * 32, drawing=drawing,
            courses=courses,
        ).model_dump_json().encode()  # fmt: skip

    async def _asked(self, payload: bytes) -> bytes:
        if self.no_log:
            return Reply(ok=False, state="", text=self.no_log).model_dump_json().encode()
        proposal = ShowAsked.model_validate_json(payload).proposal
        told = AskedTold(format=1, proposal=proposal, asked=[ASKED], notes=self.notes, missing=[])
        return told.model_dump_json().encode()

    def _course(self, scenario: str, swing_n: float, step_n: float) -> DrawnCourse:
        """After 0.3 s a step or a push, and what two laws make of it."""
        times = [0.04 * k for k in range(130)]
        since = [max(0.0, t - 0.3) for t in times]
        asked = [[setpoint + (step_n if t > 0.3 else 0.0) for t in times] for setpoint in self.setpoints]

        def ends(setpoint: float, damping: float, push_n: float) -> list[float | None]:
            swings = [step_n * math.cos(7.0 * t) + push_n * math.sin(7.0 * t) for t in since]
            left = [math.exp(-damping * t) * one for t, one in zip(since, swings, strict=True)]
            return [setpoint + (step_n - one if t > 0.3 else 0.0) for t, one in zip(times, left, strict=True)]

        return DrawnCourse(
            scenario=scenario, time_s=times, setpoint_n=asked,
            tension_n={
                "in service": [ends(one, 1.6, 3.0 * swing_n) for one in self.setpoints],
                "proposed": [ends(one, 4.0, swing_n) for one in self.setpoints],
            },
        )  # fmt: skip

    def _list(self) -> ProposalList:
        line = ProposalLine(
            proposal=self.hash,
            kind="gains",
            author="agents",
            stage=self.stage,
            why="",
            created=self.proposal.created,
            expires=self.proposal.expires,
            epoch=self.epoch if self.stage == "probation" else None,
        )
        before = line.model_copy(update={"proposal": "ab" * 32, "stage": "kept", "epoch": 2})
        return ProposalList(
            format=1,
            site=self.line.site,
            line=self.line.line,
            in_service=IN_SERVICE,
            last_known_good=IN_SERVICE,
            epoch=self.epoch,
            model=None,
            since_change=2,
            proposals=[line, before],
        )

    async def _past(self, payload: bytes) -> bytes:
        query = PAST_QUERY.validate_json(payload)
        told = self._records(query) if isinstance(query, RecordsAfter) else self._tensions(query)
        return told.model_dump_json().encode()

    def _records(self, query: RecordsAfter) -> RecordsTold:
        now_s = time.time()
        kinds = (("deployed", 240.0, "gateway", "controller c6d8cf9c18f6 was deployed as number 2, on probation"),
                 ("kept", 180.0, "gateway", "controller c6d8cf9c18f6, number 2, was kept"))  # fmt: skip
        kinds += tuple(("operated", 0.0, "operator", text) for text in self.records)
        records = [
            RecordTold(sequence=i, wall_s=now_s - ago, kind=kind, who=who, text=text, what={"secret": "of the audit"})
            for i, (kind, ago, who, text) in enumerate(kinds, 1)
            if query.after is None or i > query.after
        ]
        return RecordsTold(format=1, last=len(kinds), records=records)

    def _tensions(self, query: TensionsBetween) -> TensionsTold:
        points = min(query.points, 6000 // self.line.n)  # an answer has a greatest length
        step_s = (query.to_wall_s - query.from_wall_s) / points
        times = [query.from_wall_s + i * step_s for i in range(points)]
        spans = range(self.line.n)
        moved = [[self.setpoints[i] + 0.3 * math.sin(t * (0.3 + 0.07 * i) + i) for t in times] for i in spans]
        return TensionsTold(
            format=1,
            wall_s=times,
            tension_n=[list(one) for one in moved],
            setpoint_n=[[self.setpoints[i]] * len(times) for i in spans],
            speed_m_per_s=[0.01] * len(times),
        )

    async def _for_person(self, payload: bytes) -> bytes:
        reply = self._heard(FOR_PERSON.validate_json(payload))
        await asyncio.to_thread(self.answers.wait)
        return reply.model_dump_json().encode()

    def _heard(self, asked: ForPerson) -> Reply:
        self.said.append(asked)
        said = asked.said
        if reason := why_may_not(asked.person, said.command):
            return Reply(ok=False, state=self.state, text=reason, reasons=[reason])
        if self.against:
            reasons = [sentence(one) for one in self.against]
            return Reply(ok=False, state=self.state, text="not armed", reasons=reasons, findings=self.against)
        if isinstance(said, Decide):
            return self._decided(said, asked.person.name)
        if isinstance(said, AcknowledgeAlarm):
            seen = {"acknowledged": True, "acknowledged_by": asked.person.name}
            self.alarms = [one.model_copy(update=seen) if one.name == said.alarm else one for one in self.alarms]
        elif isinstance(said, ShelveAlarm):
            until = {"shelved_until_wall_s": time.time() + said.for_s if said.for_s else None}
            self.alarms = [one.model_copy(update=until) if one.name == said.alarm else one for one in self.alarms]
        elif isinstance(said, RollBackNow):
            self.stage = "rolled-back" if self.stage == "probation" else self.stage
        self.state = {"stop": "STOP", "hold": "HOLD", "start": "RUN", "arm": "READY"}.get(said.command, self.state)
        return Reply(ok=True, state=self.state, text=f"{said.command}: done")

    def _decided(self, said: Decide, name: str) -> Reply:
        if self.stage != "waiting" or said.shown != self.shown:
            reason = "what was shown is no longer what it is; look at it again"
            return Reply(ok=False, state=self.state, text="the decision does not count", reasons=[reason])
        if said.approve and self.approvals > 1 and self.first in ("", name):
            self.first = name
            return Reply(ok=True, state=self.state, text="your approval is on record, as the first of two")
        self.stage = "probation" if said.approve else "rejected"
        self.epoch += said.approve
        return Reply(ok=True, state=self.state, text="approved" if said.approve else "rejected")


async def show(spans: int) -> None:
    line = line_of(spans)
    with short_folder() as folder:
        served, asked = UnixMailbox(), UnixMailbox()
        gateway = FakeGateway(line, served)
        if spans > 1:
            gateway.alarms = [alarm("tension-off", text="tension of span 2 is 8.0 N above its set-point of 36.0 N")]
            gateway.off_n[1] = 8.0
        await served.listen(folder / "gateway.sock")
        asked.connect(TOPICS, folder / "gateway.sock")
        side = LineSide(asked)
        watching = asyncio.create_task(side.watch())
        try:
            await serve_page(page_app(line, side, check, role_of, time.monotonic), line.operator.page)
        finally:
            watching.cancel()
            await asyncio.gather(watching, return_exceptions=True)
            await asyncio.gather(asked.close(), served.close())


if __name__ == "__main__":
    asyncio.run(show(int(sys.argv[1]) if len(sys.argv) > 1 else 6))
