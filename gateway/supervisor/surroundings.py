"""What the line is like now, as a verdict needs it: state, what is in service, the model, the newest data that move.

The stores are read in a thread, one after the other: who holds one of them holds up what needs it, and nothing else.
"""

import asyncio
from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

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
from gateway.tasks.threads import Worker
from safety.probation import Standing, look_at
from safety.trial import Trial

PATIENCE_S, LOOK_S = STANDING_S + 1.0, 0.1
NODES = (0.1, 0.5, 1.0)  #: of the fastest speed: where recovery is predicted
MOST_KEPT = 16  #: configurations, and models, that were looked up last: what has a hash never changes

AT_HAND_S = 1.0  #: that whoever looks at a proposal waits for the stores

Content = TypeVar("Content")


class _Wanted(NamedTuple):
    """What the stores are asked for, of a book."""

    in_service: str | None
    model: str | None
    first_as_far: tuple[str, Region] | None
    line_changed_s: float | None


class _OfStores(NamedTuple):
    in_service: Controller
    model: LineModel | None
    baseline: Controller | None
    baseline_region: Region


class _Kept(Generic[Content]):
    """What was found by hash, and why it was not."""

    def __init__(self) -> None:
        self._found: OrderedDict[str, Content | NotKnown] = OrderedDict()

    def look_up(self, hash_: str, find: Callable[[str], Content]) -> Content:
        """In the stores' thread. Raises NotKnown."""
        if isinstance(found := self._found.get(hash_), NotKnown | None):
            try:
                found = find(hash_)
            except NotKnown as error:
                self._keep(hash_, error)
                raise
        self._keep(hash_, found)
        return found

    def at_hand(self, hash_: str) -> Content:
        """As it was found last. Raises NotKnown."""
        found = self._found.get(hash_)
        if found is None or isinstance(found, NotKnown):
            raise NotKnown(str(found or "it was not looked up yet: ask again"))
        return found

    def _keep(self, hash_: str, found: Content | NotKnown) -> None:
        self._found[hash_] = found
        self._found.move_to_end(hash_)
        while len(self._found) > MOST_KEPT:
            self._found.popitem(last=False)


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
        self._stores = Worker("stores")  #: the only thread in which these two are asked
        self._kept_controllers, self._kept_models = _Kept[Controller](), _Kept[LineModel]()
        self._clock = clock
        self._before: Standing | None = None  #: how the line stood before the change
        self._trial = self._new_trial()
        #: Of the line's file: what is told of the others is not looked at, and not missed.
        self._measured = np.array([span.control == "tension" for span in line.spans])

    async def context(self, book: Book) -> tuple[JudgeContext, list[Recording]]:
        """Of a line that runs once it stands, or in some seconds as it is then. Raises NotKnown."""
        await self._stands()
        self._state(book)  # where that is not known, nothing is looked up
        found = await asyncio.to_thread(self._data, self._line.gate.data_max_age_s)
        while True:  # what it is asked for may change meanwhile
            wanted = _wanted(book)
            of_stores = await self._stores.do(self._of_stores, wanted)
            if wanted == _wanted(book):
                break
        now_s = self._clock.now().wall_s
        if book.line_changed is not None:
            changed_s = now_s - self._clock.age(book.line_changed).least_s
            found = [one for one in found if one[1] > changed_s]
        return JudgeContext(
            format=1,
            now=iso(now_s),
            state=self._state(book),
            in_service=of_stores.in_service,
            region=book.judged_for,
            baseline=of_stores.baseline,
            baseline_region=of_stores.baseline_region,
            model=of_stores.model,
            data=[
                DataReference(path=f"{digest}.npz", digest=digest, recorded=iso(end_s)) for _, end_s, digest in found
            ],
            decided=[entry.proposal for entry in book.entries.values() if entry.stage is not Stage.RECEIVED][-4096:],
        ), [one for one, _, _ in found]

    async def at_hand(self, book: Book) -> None:
        """Before `difference`: what it needs of the stores, as far as they answer in time."""
        try:
            async with asyncio.timeout(AT_HAND_S):
                await self._stores.do(self._look_up, _wanted(book))
        except TimeoutError:
            return

    async def close(self) -> None:
        await self._stores.close(self._close_stores)

    async def _stands(self) -> None:
        """Until it does, or does not for longer than that takes at a line that is left alone."""
        for _ in range(round(PATIENCE_S / LOOK_S)):
            frame = self._newest()
            if frame is None or frame.state != LoopState.RUN or self._recent.stands():
                return
            await asyncio.sleep(LOOK_S)

    def difference(self, proposal: Proposal, book: Book) -> list[str]:
        """What it would change, in words and numbers, of what is at hand; where something is not known, that."""
        change, in_service, model = proposal.change, book.in_service, book.model
        try:
            if isinstance(change, GainsChange):
                return of_controllers(self._kept_controllers.at_hand(_known(in_service)), change.controller)
            if isinstance(change, ExperimentChange):
                return of_experiment(change.experiment)
            return of_models(None if model is None else self._kept_models.at_hand(model), change.model)
        except NotKnown as error:
            return [str(error)]

    async def recovery(self, fallback: str, region: Region, book: Book) -> RecoveryPrediction | None:
        """Of the accepted model, in a thread: it takes a while. Raises NotKnown."""
        if book.model is None:
            await self._stores.do(self._controller, fallback)
            return None
        model = await self._stores.do(self._model, book.model)
        controller = await self._stores.do(self._controller, fallback)
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

    def _data(self, most_s: float) -> list[tuple[Recording, float, str]]:
        """With the digest of each. It may block, and takes its time."""
        return [(one, end_s, one.digest()) for one, end_s in self._experiments(most_s)]

    def _of_stores(self, wanted: _Wanted) -> _OfStores:
        """Raises NotKnown."""
        in_service = self._controller(_known(wanted.in_service))
        baseline, region = self._baseline(wanted)
        model = None if wanted.model is None else self._model(wanted.model)
        return _OfStores(in_service, model, baseline, region)

    def _look_up(self, wanted: _Wanted) -> None:
        """What is not there is kept as that."""
        for hash_, look_up in ((wanted.in_service, self._controller), (wanted.model, self._model)):
            try:
                if hash_ is not None:
                    look_up(hash_)
            except NotKnown:
                continue

    def _close_stores(self) -> None:
        self._configurations.close()
        self._models.close()

    def _controller(self, hash_: str) -> Controller:
        return self._kept_controllers.look_up(hash_, self._stored_controller)

    def _model(self, hash_: str) -> LineModel:
        return self._kept_models.look_up(hash_, self._stored_model)

    def _stored_controller(self, hash_: str) -> Controller:
        what = f"the configuration in service, {hash_[:12]}, is"
        try:
            found = self._configurations.get(self._line.site, self._line.line, hash_)
        except ConfigurationsError as error:
            raise NotKnown(f"{what} not known here: {error}") from error
        if found is None:
            raise NotKnown(f"{what} not known here: it was never stored")
        if found.controller is None:
            raise NotKnown(f"{what} damaged in the store")
        return found.controller

    def _baseline(self, wanted: _Wanted) -> tuple[Controller | None, Region]:
        """What was archived on the line as it is; else the first that was kept for as much as what is in service."""
        archived = self._archived(wanted)
        if archived is not None:
            return archived, Region()
        first = wanted.first_as_far
        if first is None or first[0] == wanted.in_service:
            return None, Region()
        return self._controller(first[0]), first[1]

    def _archived(self, wanted: _Wanted) -> Controller | None:
        """On another web it was never judged."""
        site, line, changed_s = self._line.site, self._line.line, wanted.line_changed_s
        try:
            archived = [(id_, one) for id_, one in self._configurations.archives(site, line) if one.name == STABLE]
            if not archived or (changed_s is not None and archived[-1][1].time_s <= changed_s):
                return None
            return self._controller(archived[-1][0])
        except (ConfigurationsError, NotKnown):
            return None

    def _stored_model(self, hash_: str) -> LineModel:
        what = f"the model in service, {hash_[:12]}, is"
        try:
            found = self._models.get(hash_)
        except ModelsError as error:
            raise NotKnown(f"{what} not known here: {error}") from error
        if found is None or (found.site, found.line) != (self._line.site, self._line.line):
            raise NotKnown(f"{what} not known here: it was never stored for this line")
        if found.model is None:
            raise NotKnown(f"{what} damaged in the repository")
        return found.model


def _wanted(book: Book) -> _Wanted:
    return _Wanted(book.in_service, book.model, book.first_as_far, book.line_changed_s)


def _known(in_service: str | None) -> str:
    """Raises NotKnown."""
    if in_service is None:
        raise NotKnown("the loop has not said what controls the line: start it, then propose again")
    return in_service


def _prediction(model: LineModel, fallback: Controller, line: Line, region: Region) -> RecoveryPrediction:
    from safety.recovery_prediction import recovery_prediction  # needs scipy, which takes its time to load

    fastest = line.limits.speed_max_m_per_s
    if region.speed_max_m_per_s is not None:
        fastest = min(fastest, region.speed_max_m_per_s)
    return recovery_prediction(theta_of(model), fallback, line, [share * fastest for share in NODES])
