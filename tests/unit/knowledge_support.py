"""The records of a line as a gateway leaves them, for tests of what is known of it."""

from pathlib import Path
from types import TracebackType
from typing import Self

from gateway.core.audit_record import Who
from gateway.core.controller import config_hash
from gateway.core.experiment import Abort, Experiment, Leg, experiment_hash
from gateway.core.line_model import LineModel, model_hash, parse_model
from gateway.core.proposal import ExperimentChange, Proposal, canonical, proposal_hash
from gateway.core.verdict import RuleFinding, Verdict, verdict_hash
from gateway.core.verdict import canonical as canonical_verdict
from gateway.supervisor import baselines, configurations, models
from gateway.supervisor.audit import Audit
from gateway.supervisor.baselines import Measured, MeasuredRun, begin_baselines
from gateway.supervisor.configurations import Origin, begin_configurations
from gateway.supervisor.models import begin_repository
from gateway.supervisor.proposal_records import iso
from tests.unit.deployer_support import FIRST, LINE, controller, proposal

BEGIN_S = 1_767_600_000.0
DAY_S = 86_400.0
SITE = (LINE.site, LINE.line)
MARGIN = RuleFinding(
    rule="delay margin", passed=True, text="the loop stands 8.0 ms", value=0.008, limit=0.004, margin=0.004, unit="s"
)  # fmt: skip
SHORT = RuleFinding(
    rule="corners: chatter", passed=False, text="torque moves by 7 Nm rms", value=7.0, limit=5.0, margin=-2.0, unit="Nm"
)  # fmt: skip
COOL = RuleFinding(rule="cool-down", passed=False, text="wait", value=1.0, limit=30.0, margin=-29.0, unit="s")


class Records:
    """Of a line in a folder; each thing happens a day after the one before. A context manager."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.now_s = BEGIN_S
        self.in_service = config_hash(FIRST)
        self._number = self._epoch = 0
        self._audit = Audit(folder, wall_clock=lambda: self.now_s)
        self._audit.start()
        self._store(FIRST)
        self._record("found-in-service", configuration=self.in_service, last_known_good=self.in_service, epoch=0)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._audit.close()

    def deployed(self, reason: str = "a test", rolled_back: str = "") -> Proposal:
        """A configuration that was kept, or rolled back for a reason."""
        one = self._proposed(reason)
        hash_, changes = proposal_hash(one), config_hash(controller(self._number))
        self._epoch += 1
        self._accepted(one)
        self._record("deploying", proposal=hash_, epoch=self._epoch, region={})
        self._record("deployed", proposal=hash_, epoch=self._epoch)
        self._store(controller(self._number))
        if rolled_back:
            self._record("rolled-back", proposal=hash_, to=self.in_service, region={}, because=rolled_back)
            return one
        self._record("keeping", proposal=hash_, epoch=self._epoch)
        self._record("kept", proposal=hash_, epoch=self._epoch, last_known_good=changes)
        self.in_service = changes
        return one

    def refused(self, finding: RuleFinding = SHORT, reason: str = "a test") -> Proposal:
        one = self._proposed(reason)
        verdict = self._verdict(one, finding)
        self._record("refused", {"verdict": canonical_verdict(verdict)}, proposal=proposal_hash(one),
                     verdict=verdict_hash(verdict), because=finding.text)  # fmt: skip
        return one

    def rejected(self, comment: str) -> Proposal:
        one = self._proposed("a test")
        self._accepted(one, approve=False)
        self._record("rejected", proposal=proposal_hash(one), because=comment)
        return one

    def experiment(self, because: str = "") -> Proposal:
        asked = Experiment(
            format=1, description="to see what moves", amplitude_n=[1.0] * LINE.n, dwell_s=0.1,
            legs=[Leg(duration_s=8.0, speed_m_per_s=0.05)], abort=Abort(deviation_n=6.0),
        )  # fmt: skip
        one = self._proposed("a test", asked)
        self._accepted(one)
        self._record("experiment-begins", proposal=proposal_hash(one))
        self._record("experiment-ends", proposal=proposal_hash(one), because=because)
        return one

    def model(self, stiffness_n: float = 2400.0, method: str = "test", source: str = "test") -> LineModel:
        """Accepted, without a proposal."""
        self.now_s += DAY_S
        example = parse_model(Path("docs/examples/line-model.json").read_bytes())
        parameters = example.parameters.model_copy(update={"stiffness_n": stiffness_n})
        made = example.model_copy(
            update={"site": LINE.site, "line": LINE.line, "parameters": parameters, "intervals": {}, "posterior": None,
                    "method": method, "data": example.data.model_copy(update={"source": source})}
        )  # fmt: skip
        with begin_repository(self.folder / models.FILE_NAME) as store:
            for one in store.entries(*SITE):
                if one.state == "accepted":
                    store.mark(one.id, "superseded", self.now_s, "by a test")
            store.mark(store.store(made, self.now_s).id, "accepted", self.now_s, "from an experiment")
        assert model_hash(made)
        return made

    def measured(self, rmse_n: float, because: str = "", **conditions: object) -> None:
        self.now_s += DAY_S
        found = {"gap": 0.25, "spans": {"1": {"rmse_n": rmse_n, "overshoot_pct": 1.0, "settling_s": None}}}
        diagnosis = {"diagnosis": {"follows": "newer-model", "by": "adaptation", "because": because}} if because else {}
        run = MeasuredRun(*SITE, self.in_service, None, "measurement", self.now_s, Measured(rmse_n, 2.0, 0.5, 9.0),
                          {"found": found | diagnosis, **conditions})  # fmt: skip
        with begin_baselines(self.folder / baselines.FILE_NAME) as database:
            database.add(run)

    def archived(self, id_: str, name: str) -> None:
        with begin_configurations(self.folder / configurations.FILE_NAME) as store:
            store.archive(*SITE, id_, name, self.now_s, "anna", "it has run for a month")

    def _proposed(self, reason: str, experiment: Experiment | None = None) -> Proposal:
        self.now_s += DAY_S
        self._number += 1
        one = proposal(self._number, self.in_service, self.now_s).model_copy(update={"reason": reason})
        changes = config_hash(controller(self._number))
        if experiment is not None:
            one = one.model_copy(update={"change": ExperimentChange(experiment=experiment)})
            changes = experiment_hash(experiment)
        self._record(
            "proposed", {"proposal": canonical(one)}, proposal=proposal_hash(one), change=one.kind, author=one.author,
            base=one.base, changes=changes, created=one.created, expires=one.expires, expires_s=self.now_s + 600.0,
        )  # fmt: skip
        return one

    def _accepted(self, one: Proposal, approve: bool = True) -> None:
        verdict = self._verdict(one, MARGIN)
        self._record("accepted", {"verdict": canonical_verdict(verdict)}, proposal=proposal_hash(one),
                     verdict=verdict_hash(verdict))  # fmt: skip
        if approve:
            self._record("approved", proposal=proposal_hash(one))

    def _verdict(self, one: Proposal, finding: RuleFinding) -> Verdict:
        return Verdict(
            format=1, proposal=proposal_hash(one), payload=proposal_hash(one), context="0" * 64, line="0" * 64,
            kind=one.kind, seed=1, accepted=finding.passed, findings=[finding], judged=iso(self.now_s),
            program_version="0",
        )  # fmt: skip

    def _store(self, one) -> None:
        with begin_configurations(self.folder / configurations.FILE_NAME) as store:
            store.store(*SITE, one, Origin(self.now_s, "rules", "a test"))

    def _record(self, kind: str, blobs: dict[str, bytes] | None = None, **what) -> None:
        self._audit.append_and_wait(kind, Who(name="a test"), {"at_s": self.now_s, **what}, blobs)
