"""What the line is like now, as a verdict needs it: state, what is in service, the model, the newest data that move."""

import asyncio
from collections.abc import Callable

import numpy as np

from gateway.core.controller import Controller
from gateway.core.deployment import RecoveryPrediction, Region
from gateway.core.differences import of_controllers, of_experiment, of_models
from gateway.core.doubts import in_words
from gateway.core.judge_context import DataReference, JudgeContext, LineState
from gateway.core.line import Line
from gateway.core.line_model import LineModel, theta_of
from gateway.core.proposal import ExperimentChange, GainsChange, Proposal
from gateway.core.recording import Recording
from gateway.core.states import LoopState
from gateway.core.steady_clock import SteadyClock
from gateway.core.telemetry import Frame
from gateway.supervisor.configurations import STABLE, Configurations, ConfigurationsError
from gateway.supervisor.deployer_sides import NotKnown
from gateway.supervisor.lifecycle import Book, Stage
from gateway.supervisor.model_store import ModelsError
from gateway.supervisor.models import Models
from gateway.supervisor.proposal_records import iso
from gateway.supervisor.recent import STANDING_S, WINDOW_S, Recent
from safety.probation import Standing, look_at
from safety.trial import Trial

PATIENCE_S, LOOK_S = STANDING_S + 1.0, 0.1
NODES = (0.1, 0.5, 1.0)  #: of the fastest speed: where recovery is predicted


class LineSurroundings:
    """Of a gateway: its telemetry, the experiments in its history, and its stores."""

    def __init__(
        self,
        line: Line,
        newest: Callable[[], Frame | None],
        recent: Recent,
        experiments: Callable[[float], list[tuple[Recording, float]]],
        configurations: Configurations,
        models: Models,
        clock: SteadyClock,
    ) -> None:
        self._line = line
        self._newest = newest
        self._recent = recent
        #: Of so many seconds, the newest first, each with the Unix time of its end by the clock of now; it may block.
        self._experiments = experiments
        self._configurations = configurations
        self._models = models
        self._clock = clock
        self._before: Standing | None = None  #: how the line stood before the change
        self._trial = self._new_trial()
        #: Of the line's file: what is told of the others is not looked at, and not missed.
        self._measured = np.array([span.control == "tension" for span in line.spans])

    async def context(self, book: Book) -> tuple[JudgeContext, list[Recording]]:
        """Of a line that runs once it stands, or in some seconds as it is then. Raises NotKnown."""
        await self._stands()
        found = await asyncio.to_thread(self._experiments, self._line.gate.data_max_age_s)
        now_s = self._clock.now().wall_s
        if book.line_changed is not None:
            changed_s = now_s - self._clock.age(book.line_changed).least_s
            found = [one for one in found if one[1] > changed_s]
        baseline, baseline_region = self._baseline(book)
        return JudgeContext(
            format=1,
            now=iso(now_s),
            state=self._state(book),
            in_service=self._controller(book.in_service),
            region=book.judged_for,
            baseline=baseline,
            baseline_region=baseline_region,
            model=self._model(book),
            data=[
                DataReference(path=f"{one.digest()}.npz", digest=one.digest(), recorded=iso(end_s))
                for one, end_s in found
            ],
            decided=[entry.proposal for entry in book.entries.values() if entry.stage is not Stage.RECEIVED][-4096:],
        ), [one for one, _ in found]

    async def _stands(self) -> None:
        """Until it does, or does not for longer than that takes at a line that is left alone."""
        for _ in range(round(PATIENCE_S / LOOK_S)):
            frame = self._newest()
            if frame is None or frame.state != LoopState.RUN or self._recent.stands():
                return
            await asyncio.sleep(LOOK_S)

    def difference(self, proposal: Proposal, book: Book) -> list[str]:
        """What it would change, in words and numbers; where something is not known, that."""
        change = proposal.change
        try:
            if isinstance(change, GainsChange):
                return of_controllers(self._controller(book.in_service), change.controller)
            if isinstance(change, ExperimentChange):
                return of_experiment(change.experiment)
            return of_models(self._model(book), change.model)
        except NotKnown as error:
            return [str(error)]

    async def recovery(self, fallback: str, region: Region, book: Book) -> RecoveryPrediction | None:
        """Of the accepted model, in a thread: it takes a while. Raises NotKnown."""
        model, controller = self._model(book), self._controller(fallback)
        if model is None:
            return None
        return await asyncio.to_thread(_prediction, model, controller, self._line, region)

    def begin_probation(self) -> None:
        """From now on the line is measured against how it has stood until now."""
        self._before = self._recent.standing()
        self._recent.forget()
        self._trial = self._new_trial()

    def change_taken(self) -> None:
        """What was measured until now says nothing of the change."""
        self._recent.forget()
        self._trial = self._new_trial()

    def against_keeping(self, now_s: float) -> str:
        now = self._recent.standing()
        found = None if now is None else look_at(now, self._before, self._line.gate, self._measured)
        return self._trial.look(found, self._recent.newest_s, now_s)

    def unseen(self) -> str:
        probation_s, ran_s = self._line.gate.probation_s, self._recent.ran_s
        ran = f"it has controlled the line for {ran_s:.0f} s of {probation_s:g} s" if ran_s < probation_s else ""
        if self._trial.blind:
            return "; ".join(filter(None, (ran, self._trial.missing())))
        if ran:
            return ran
        return self._trial.missing() if self._trial.stood else f"the line has not stood for {STANDING_S:g} s in a row"

    def _new_trial(self) -> Trial:
        return Trial(self._line.gate.probation_s, WINDOW_S)

    def _state(self, book: Book) -> LineState:
        frame, change = self._newest(), book.on_the_line
        if frame is None:
            raise NotKnown("the loop has not told how the line stands: start it, then propose again")
        running = change is not None and change.stage is Stage.RUNNING
        return LineState(
            state=LoopState(frame.state).name,
            tension_n=[float(value) for value in frame.tension_setpoint_n],
            speed_m_per_s=float(frame.speed_setpoint_m_per_s),
            moving=frame.state == LoopState.RUN and not self._recent.stands(),
            experiment=running,
            on_probation=change is not None and not running,
            doubts=in_words(frame.doubts),
            since_change_s=None if book.changed is None else self._clock.age(book.changed).least_s,
        )

    def _controller(self, hash_: str | None) -> Controller:
        if hash_ is None:
            raise NotKnown("the loop has not said what controls the line: start it, then propose again")
        try:
            controller = self._configurations.find(hash_, self._line.site, self._line.line).controller
        except ConfigurationsError as error:
            raise NotKnown(f"the configuration in service, {hash_[:12]}, is not known here: {error}") from error
        if controller is None:
            raise NotKnown(f"the configuration in service, {hash_[:12]}, is damaged in the store")
        return controller

    def _baseline(self, book: Book) -> tuple[Controller | None, Region]:
        """What was archived on the line as it is; else the first that was kept for as much as what is in service."""
        archived = self._archived(book)
        if archived is not None:
            return archived, Region()
        first = book.first_as_far
        if first is None or first[0] == book.in_service:
            return None, Region()
        return self._controller(first[0]), first[1]

    def _archived(self, book: Book) -> Controller | None:
        """On another web it was never judged."""
        site, line, changed_s = self._line.site, self._line.line, book.line_changed_s
        try:
            archived = [one.time_s for _, one in self._configurations.archives(site, line) if one.name == STABLE]
            if not archived or (changed_s is not None and archived[-1] <= changed_s):
                return None
            return self._configurations.find(STABLE, site, line).controller
        except ConfigurationsError:
            return None

    def _model(self, book: Book) -> LineModel | None:
        if book.model is None:
            return None
        try:
            model = self._models.find(book.model, self._line.site, self._line.line).model
        except ModelsError as error:
            raise NotKnown(f"the model in service, {book.model[:12]}, is not known here: {error}") from error
        if model is None:
            raise NotKnown(f"the model in service, {book.model[:12]}, is damaged in the repository")
        return model


def _prediction(model: LineModel, fallback: Controller, line: Line, region: Region) -> RecoveryPrediction:
    from safety.recovery_prediction import recovery_prediction  # needs scipy, which takes its time to load

    fastest = line.limits.speed_max_m_per_s
    if region.speed_max_m_per_s is not None:
        fastest = min(fastest, region.speed_max_m_per_s)
    return recovery_prediction(theta_of(model), fallback, line, [share * fastest for share in NODES])
