"""What may run under what: a model of the loop's decisions that shares no code with it, and its book of the disk.

`Runs` is what a loop that starts next runs. `may` holds every one that a process which dies now may leave: what was
decided last; what was decided before, until the disk has had the time to follow; and what is under way.
"""

from collections import Counter
from dataclasses import dataclass, field, replace

from pydantic import TypeAdapter

from gateway.core.controller import config_hash
from gateway.core.controller_laws import MpcConfig
from gateway.core.deployment import RecoveryPrediction, Region
from gateway.core.line import Line
from gateway.core.messages import (
    AbortExperiment,
    Command,
    Deploy,
    Keep,
    Narrow,
    Renew,
    Reply,
    Rollback,
    RunExperiment,
    SelectRecipe,
    SetSpeed,
    SetTension,
    WatchGood,
)
from gateway.loop.kept import Durable

Watch = tuple[str, int] | None  #: the fallback, and how many periods of torque it keeps in mind


def watch_key(watch: RecoveryPrediction | None) -> Watch:
    return None if watch is None else (watch.fallback, len(watch.nodes[0].inputs))


def narrower(a: Region, b: Region) -> Region:
    """As far as both go. Written out here: a model does not ask what it checks."""
    fields = {}
    for name in Region.model_fields:
        limits = [limit for limit in (getattr(a, name), getattr(b, name)) if limit is not None]
        fields[name] = min(limits) if limits else None
    return Region(**fields)


@dataclass(frozen=True)
class Law:
    """A configuration, by its hash, and what it was judged for."""

    hash: str
    region: Region = Region()
    predictive: bool = False


@dataclass(frozen=True)
class Runs:
    epoch: int
    good: Law
    watch: Watch = None
    top: Law | None = None

    @property
    def key(self) -> tuple[str, str | None, Watch]:
        """What can end a process: the configurations and what watches them."""
        return (self.good.hash, self.top and self.top.hash, self.watch)


RUNS = TypeAdapter(Runs)


def runs_of(durable: Durable) -> Runs:
    top = durable.on_top
    return Runs(
        durable.epoch,
        _law(durable.controller, durable.region),
        watch_key(durable.watch),
        None if top is None else _law(top.controller, top.region),
    )


def first_law(config: object, line: Line) -> Law:
    """Given, and judged by nobody."""
    limits, gate = line.limits, line.gate
    speed_m_per_s = min(gate.first_speed_max_m_per_s, limits.speed_max_m_per_s)
    return _law(
        config,
        Region(
            speed_max_m_per_s=speed_m_per_s,
            tension_step_max_n=min(gate.first_step_max_n, limits.tension_step_max_n),
            speed_step_max_m_per_s=min(speed_m_per_s, limits.speed_step_max_m_per_s),
        ),
    )


def _law(config: object, region: Region) -> Law:
    return Law(config_hash(config), region, isinstance(config, MpcConfig))


@dataclass
class Begun:
    """An experiment, with what it was begun under."""

    under: Law
    judged: bool


@dataclass
class Model:
    running: Law
    good: Law
    other: bool = False  #: another configuration runs than the last known good one, be it the same in every word
    epoch: int = 0
    watch: Watch = None
    lease_s: float = 0.0
    until_s: float | None = None  #: the lease's end; None: nothing is on probation
    experiment: Begun | None = None
    may: list[Runs] = field(default_factory=list[Runs])
    ahead_of: list[tuple[Command, Runs]] = field(default_factory=list[tuple[Command, Runs]])  #: of those under way
    goods: set[tuple[str, Watch]] = field(default_factory=set[tuple[str, Watch]])  #: that were ever decided
    ends: Counter[object] = field(default_factory=Counter[object])  #: by an exception, in a row
    epochs: dict[int, str] = field(default_factory=dict[int, str])  #: what each has been used for

    def __post_init__(self) -> None:
        self.may, self.given = [self.durable], self.good.hash
        self.goods.add((self.good.hash, self.watch))

    @property
    def durable(self) -> Runs:
        on_top = self.other and self.until_s is None
        return Runs(self.epoch, self.good, self.watch, self.running if on_top else None)

    @property
    def stays_on_top(self) -> bool:
        """Whether what runs would not become what is gone back to, were it kept."""
        return self.running.predictive and not self.good.predictive

    @property
    def good_if_kept(self) -> Law:
        return self.good if self.stays_on_top else self.running

    def ahead(self, command: Command) -> Runs | None:
        """What would be on the disk before `command` is done, were that now; None: it writes nothing ahead."""
        match command:
            case Deploy():
                return replace(self.durable, epoch=command.deployment.epoch)
            case WatchGood() if self.until_s is None:
                return replace(self.durable, watch=watch_key(command.watch))
            case Narrow() if self.until_s is None:  # done, and then what would have told it has ended the process
                return self._narrowed(command.region)
            case Keep() if self.until_s is not None:
                top = self.running if self.stays_on_top else None
                return Runs(self.epoch, self.good_if_kept, watch_key(command.watch), top)
            case _:
                return None

    def carried_out(self, command: Command, reply: Reply, now_s: float) -> None:
        """Between two periods. What was granted is on the disk before: nothing older may be found from now on."""
        if not reply.ok:
            return
        match command:
            case Deploy():
                self._deploy(command, now_s)
            case Renew():
                assert self.until_s is not None, "a lease is renewed though nothing is on probation"
                self.until_s = now_s + self.lease_s
            case Keep():
                assert self.until_s is not None, "kept, though nothing is on probation"
                self.other, self.good = self.stays_on_top, self.good_if_kept
                self.watch, self.until_s = watch_key(command.watch), None
                self.goods.add((self.good.hash, self.watch))
                self.may = [self.durable]
            case WatchGood():
                assert self.until_s is None, "watched anew on probation"
                self.watch = watch_key(command.watch)
                self.goods.add((self.good.hash, self.watch))
                # A narrow that was done while this was being written is not on the disk with it: the disk follows.
                written = [ahead for of, ahead in self.ahead_of if of is command and ahead.watch == self.watch]
                self.may = [*written, self.durable]
            case Narrow():
                self._narrow(command.region)
            case Rollback():
                assert not self.other, "taken back, and not the last known good runs"
            case RunExperiment():
                assert self.experiment is None, "a second experiment"
                self.experiment = Begun(self.running, command.proposal is not None)
            case AbortExperiment() | SetSpeed() | SetTension() | SelectRecipe():
                self.experiment = None
            case _:
                pass

    def _deploy(self, command: Deploy, now_s: float) -> None:
        given = command.deployment
        assert self.until_s is None, "deployed, though something is on probation"
        assert given.epoch == self.epoch + 1, f"epoch {given.epoch} after {self.epoch}"
        assert given.epoch not in self.epochs, f"epoch {given.epoch} is used twice"
        self.epochs[given.epoch] = given.hash
        before = replace(self.durable, epoch=given.epoch)
        self.epoch = given.epoch
        self.running, self.other = _law(given.controller, given.region), True
        self.lease_s, self.until_s = given.lease_s, now_s + given.lease_s
        # What was kept on top until now is given up with this, and stays on the disk until that follows: nobody has
        # taken it back, and it is what runs where the deployment is not done after all.
        self.may = [before, self.durable]

    def _narrowed(self, region: Region) -> Runs:
        def within(law: Law) -> Law:
            return replace(law, region=narrower(law.region, region))

        top = within(self.running) if self.durable.top is not None else None
        return Runs(self.epoch, within(self.good), None, top)

    def _narrow(self, region: Region) -> None:
        assert self.until_s is None, "narrowed on probation"
        self.good = replace(self.good, region=narrower(self.good.region, region))
        self.running = replace(self.running, region=narrower(self.running.region, region))
        self.watch = None
        self.goods.add((self.good.hash, None))
        self.may.append(self.durable)

    def rolled_back(self) -> None:
        """By whomever."""
        assert self.other, "taken back, though the last known good runs"
        self.running, self.other, self.until_s = self.good, False, None
        self.may.append(self.durable)

    def under_way(self, commands: list[Command]) -> None:
        """These are not answered yet: what they write ahead may be found."""
        self.ahead_of = [one for one in self.ahead_of if any(one[0] is command for command in commands)]
        for command in commands:
            if (ahead := self.ahead(command)) is None:
                continue
            self.ahead_of.append((command, ahead))
            if ahead not in self.may:
                self.may.append(ahead)

    def settled(self) -> None:
        """The disk has had the time to follow, or somebody was told that it has."""
        self.may, self.ahead_of = [self.durable], []

    def begin_anew(self, found: Runs) -> None:
        """The next process runs `found`. Raises AssertionError where it must not."""
        assert any(self._allows(before, found) for before in self.may), (
            f"the next loop runs {found}; it may run {self.may}, {dict(self.ends)}"
        )
        assert found.epoch >= max(self.epochs, default=0), f"epoch {found.epoch} after {max(self.epochs)}"
        self.good, self.watch, self.epoch = found.good, found.watch, found.epoch
        self.running, self.other = found.top or found.good, found.top is not None
        self.until_s, self.experiment = None, None
        self.may = [self.durable]

    def _allows(self, before: Runs, found: Runs) -> bool:
        """`before`, unless it has ended two processes in a row; then what there is to go back to, for no more."""
        if self.ends[before.key] < 2:
            return found == before
        ever = (found.good.hash, found.watch) in self.goods
        lives = self.ends[found.key] < 2 or found.good.hash == self.given
        no_further = narrower(found.good.region, before.good.region) == found.good.region
        return ever and lives and no_further and found.top is None and found.epoch == before.epoch
