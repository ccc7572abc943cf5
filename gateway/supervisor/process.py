"""The gateway process: one socket, one historian, one service over them, until it is told to stop.

It may start before the loop, outlive it, and die without the loop noticing.
"""

import asyncio
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from gateway.core.line import Line
from gateway.core.recording import Recording
from gateway.core.steady_clock import SteadyClock
from gateway.core.topics import LOOP_COMMAND, LOOP_HELLO, LOOP_SHOWN
from gateway.mailbox.listener import AlreadyRunning, CannotListen, PathTooLong
from gateway.mailbox.one_process import hold_alone
from gateway.mailbox.paths import GATEWAY_DATA, GATEWAY_SOCKET, LOOP_DATA, LOOP_SOCKET
from gateway.mailbox.port import ANSWERED, Counters, Peer
from gateway.mailbox.seal import LineName, Signer
from gateway.mailbox.to_loop import ToLoop
from gateway.mailbox.unix import UnixMailbox
from gateway.supervisor.access_desk import AccessDesk
from gateway.supervisor.agents_bus import AgentsBus
from gateway.supervisor.agents_cases import AgentsCases
from gateway.supervisor.agents_desk import AgentsDesk
from gateway.supervisor.alarms import Alarms
from gateway.supervisor.asked_desk import AskedDesk
from gateway.supervisor.bounded import with_left_out
from gateway.supervisor.configurations import Configurations
from gateway.supervisor.courses_desk import CoursesDesk
from gateway.supervisor.deployer_sides import JudgeSide
from gateway.supervisor.dry_runs import DryRuns
from gateway.supervisor.experiments import MOST_EXPERIMENTS, recent_experiments
from gateway.supervisor.gate import Gate
from gateway.supervisor.gateway_key import gateway_key, seeds_secret
from gateway.supervisor.head_told import HeadTold
from gateway.supervisor.historian import Historian
from gateway.supervisor.history import HistoryError
from gateway.supervisor.interactions import Interactions
from gateway.supervisor.judging import NICEST, JudgeWorkers
from gateway.supervisor.line_desk import LineDesk
from gateway.supervisor.memory import GivenBack
from gateway.supervisor.models import Models
from gateway.supervisor.operated import Operated
from gateway.supervisor.past import Past
from gateway.supervisor.peers import GATEWAY, know_users
from gateway.supervisor.persons_desk import PersonsDesk
from gateway.supervisor.retention import retention_of
from gateway.supervisor.service import Gateway
from gateway.supervisor.store import boot_id
from gateway.supervisor.surroundings import LineSurroundings
from gateway.supervisor.true_loop import TrueLoop
from gateway.tasks.supervisor import Supervisor, TaskFault, wait
from gateway.wording.catalogue import sentence

EXIT_OK, EXIT_NOT_FLUSHED, EXIT_CANNOT_LISTEN, EXIT_ALREADY_RUNNING = 0, 1, 2, 3
WATCH_S = 0.25
SHOWN_TIME_S = 1.0  #: for the loop to show who it is


def run_gateway(line: Line, run_folder: Path, data_folder: Path) -> int:
    """Serve until SIGTERM or SIGINT. Returns the process's exit code."""
    try:
        judge = JudgeWorkers(line, secret=seeds_secret(data_folder / GATEWAY_DATA))
        return asyncio.run(serve(line, run_folder, data_folder, judge, give_back=GivenBack().look))
    except AlreadyRunning as error:
        print(f"a gateway runs here already, this one ends: {error}", file=sys.stderr)
        return EXIT_ALREADY_RUNNING
    except (CannotListen, PathTooLong) as error:
        print(f"the gateway cannot start: {error}", file=sys.stderr)
        return EXIT_CANNOT_LISTEN


class Judging(JudgeSide, Protocol):
    def begin(self) -> None:
        """So that the first verdict does not wait for it."""
        ...

    async def close(self) -> None: ...


async def serve(
    line: Line,
    run_folder: Path,
    data_folder: Path,
    judge: Judging,
    clock: Callable[[], float] = time.monotonic,
    wall_clock: Callable[[], float] = time.time,
    watch_s: float = WATCH_S,
    give_back: Callable[[], None] = lambda: None,
) -> int:
    """All of it, in one event loop; `give_back`, of memory, has its turn with the others. `data_folder`: the line's.

    Raises AlreadyRunning, CannotListen and PathTooLong.
    """
    own, stop = data_folder / GATEWAY_DATA, asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    mailbox = UnixMailbox()
    mailbox.connect((LOOP_COMMAND, LOOP_HELLO, LOOP_SHOWN), run_folder / LOOP_SOCKET)
    historian = Historian(
        own, line.site, line.line, line.n, retention=retention_of(line.history), clock=clock,
        wall_clock=wall_clock,
    )  # fmt: skip
    key, key_trouble = gateway_key(line.site, line.line, own)
    to_loop = ToLoop(mailbox, Signer(key, LineName(line.site, line.line), clock))

    def loop_begins() -> None:
        to_loop.forget()
        gateway.loop_begins()
        gate.loop_begins()

    true_loop = TrueLoop(
        run_folder, lambda challenge: _shown(mailbox, challenge), clock,
        lambda kind, text, **data: gateway.note(kind, text, **data), loop_begins,
    )  # fmt: skip
    gateway = Gateway(line, mailbox, to_loop, historian, mailbox.counters, clock, wall_clock, true_loop)
    tasks = Supervisor(lambda fault, error: _tell_fault(gateway, fault, error), clock)
    gateway.task_faults = lambda: tasks.faults
    clocks = SteadyClock(clock, wall_clock, boot_id())

    def experiments(most_s: float) -> list[tuple[Recording, float]]:
        try:
            return recent_experiments(historian.path, most_s, clocks, MOST_EXPERIMENTS)
        except HistoryError:
            return []  # there is no history yet

    def around(configurations: Configurations, models: Models) -> LineSurroundings:
        return LineSurroundings(line, gateway.newest, gateway.recent, experiments, configurations, models, clocks)

    await know_users()
    # First the socket, whose lock makes this the only instance; only then is the history touched.
    await mailbox.listen(run_folder / GATEWAY_SOCKET)
    try:
        alone = hold_alone(own, "gateway", _say)
    except AlreadyRunning:
        await mailbox.close()
        raise
    historian.start()
    judge.begin()
    gate = Gate(line, mailbox, to_loop, own, judge, around, gateway.note, clock, wall_clock, data_folder / LOOP_DATA)
    true_loop.record = lambda what, left_out: gate.audit.append("false-loop", GATEWAY, with_left_out(what, left_out))
    gate.loop.has_answered = true_loop.has_answered
    gateway.on_event, gateway.change, gateway.unexplained = gate.hear, gate.change, gate.unexplained
    gateway.not_to_be_armed, gateway.hold_against_records = gate.not_to_be_armed, gate.hold_against_records
    gateway.unconfirmed, gateway.wiring = gate.unconfirmed, gate.wiring
    gate.stop_asked = lambda: gateway.stop_asked
    heads = HeadTold(gate.audit.state, lambda text: print(text, flush=True), clock)
    gateway.audit_head = lambda: heads.head
    alarms = Alarms(mailbox, own, gate.audit.append, gateway.note, clock, wall_clock, gate.shelvings)
    gateway.alarms = alarms.status
    operated = Operated(gate.audit.append, clock, gateway.note)
    gateway.on_record = operated.keep_local
    PersonsDesk(mailbox, gateway.command, gate.decide, alarms.say, operated, clock, gateway.note)
    gate.roles = AccessDesk(mailbox, gate.audit.append, clock).roles
    # One process for what nobody's verdict may wait for.
    beside = JudgeWorkers(line, nicer=NICEST, secret=seeds_secret(own, of="dry runs"))
    courses = CoursesDesk(mailbox, lambda: gate.deployer, beside)
    past = Past(line, mailbox, own, lambda: historian.path)
    dry_runs = DryRuns(line, beside)
    cases = AgentsCases(gate.audit.append, clock)
    log = Interactions(own)
    desk = AgentsDesk(gateway.status, gate, dry_runs, log, gateway.note, cases)
    AskedDesk(mailbox, lambda: gate.deployer, log)
    line_desk = LineDesk(line, gate, own, experiments, cases)
    bus = AgentsBus(line, run_folder, (desk, line_desk), gateway.note, cases, clock)
    gateway.agents_bus = bus.status
    handlers = _Handlers(mailbox.counters)
    turns = {
        "gate": gate.look,
        "lease": gate.hold,
        "agents' cases": cases.look,
        "alarms' file": alarms.keep,
        "opening the agents' bus": bus.keep_open,
        "who the loop is": true_loop.prove,
    }
    looking = [asyncio.create_task(tasks.repeat(name, turn, watch_s, stop)) for name, turn in turns.items()]
    gateway.note("gateway-up", "the gateway has started")
    if key_trouble is not None:
        gateway.note("gateway-key", sentence(key_trouble), findings=[key_trouble])
    print(f"gateway of {line.site}/{line.line}: {run_folder / GATEWAY_SOCKET}, history {historian.path}", flush=True)
    try:
        while not stop.is_set():
            tasks.turn("watching the loop", gateway.watch)
            tasks.turn("alarms", lambda: alarms.look(gateway.status(), gate.audit.state()))
            tasks.turn("audit's head", heads.look)
            tasks.turn("agents' bus", bus.watch)
            tasks.turn("handlers of messages", handlers.look)
            tasks.turn("memory", give_back)
            await wait(stop, watch_s)
    finally:
        stop.set()
        await asyncio.gather(*looking)
        await tasks.end(
            {
                "alarms' file": alarms.keep,
                "closing the agents' bus": bus.close,
                "records of what was said": operated.close,
                "closing courses": courses.close,
                "closing dry runs": dry_runs.close,
                "closing the past": past.close,
                "closing the gate": gate.close,
                "closing the judge": judge.close,
                "asking who the loop is": true_loop.close,
                "closing the mailbox": mailbox.close,
            }
        )
        gateway.note("gateway-down", "the gateway has been stopped")
        flushed = await asyncio.to_thread(historian.close)
        alone.close()
    if not flushed:
        print("the disk did not answer in time: the last seconds of history are lost", file=sys.stderr)
    return EXIT_OK if flushed else EXIT_NOT_FLUSHED


async def _shown(mailbox: UnixMailbox, challenge: bytes) -> tuple[bytes, Peer | None]:
    """What the loop's socket answers, and who answers there. Raises Unreachable."""
    return await mailbox.request(LOOP_SHOWN, challenge, SHOWN_TIME_S), ANSWERED.get()


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


class HandlerFailed(Exception):
    """A handler of a message has raised; its sender was told, or nobody was. The text has topic, type and text."""


class _Handlers:
    """Of a mailbox: an exception of one ends no connection, and must not be silent either."""

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self._seen = 0

    def look(self) -> None:
        """Raises HandlerFailed where one has raised since the last look."""
        seen, self._seen = self._seen, self._counters.handler_errors
        if self._seen != seen:
            raise HandlerFailed(self._counters.last_error)


def _tell_fault(gateway: Gateway, fault: TaskFault, error: BaseException | None) -> None:
    """Into the history's events and, with where it was raised, into the process's log."""
    data = {"task": fault.task, "error": fault.error, "times": fault.times}
    if error is None:
        gateway.note("task-mended", f"{fault.task}: works again, after {fault.times} failures", **data)
        return
    told = f"{fault.task}: {fault.error}: {fault.text}"
    gateway.note("task-failed", told, **data)
    where = "".join(traceback.format_exception(error))
    print(f"a task of the gateway failed, and goes on: {told}\n{where}", file=sys.stderr, flush=True)
