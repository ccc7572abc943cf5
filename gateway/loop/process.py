"""The loop process: one line, one controller, its links, its command socket; no other socket and no database."""

import asyncio
import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from drivers.device_map import load_maps
from drivers.port import Link
from drivers.registry import build_links, drive_tells, map_files, speed_steps_m_per_s
from gateway.core.controller import Controller, ControllerRefused
from gateway.core.line import Line
from gateway.core.signals import Outputs
from gateway.core.states import Phase
from gateway.core.topics import LOOP_BUSES, LOOP_COMMAND, LOOP_EVENT, LOOP_HELLO, LOOP_SHOWN, LOOP_TELEMETRY
from gateway.loop.arming import release_links
from gateway.loop.cycle import Cycle
from gateway.loop.door import Door
from gateway.loop.identity import Identity
from gateway.loop.kept import Kept, Store, fingerprint
from gateway.loop.memory import RestCollector
from gateway.loop.pacer import TimerPacer, monotonic
from gateway.loop.realtime import become_punctual, freeze_collector, stay_awake
from gateway.loop.runner import Runner
from gateway.loop.voice import Voice
from gateway.loop.watch import Watch
from gateway.loop.wiring import Wiring
from gateway.mailbox.keys import KeyUnusable, PublicKey, public_key
from gateway.mailbox.listener import AlreadyRunning
from gateway.mailbox.loop_proof import NoKey, keep_key, new_key, read_key
from gateway.mailbox.one_process import hold_alone
from gateway.mailbox.paths import GATEWAY_DATA, GATEWAY_SOCKET, LOOP_DATA, LOOP_SOCKET
from gateway.mailbox.seal import LineName
from gateway.mailbox.unix import UnixMailbox
from gateway.tasks.cleanup import finish, finish_all
from gateway.wording.catalogue import sentences
from safety.actions import Action, Finding, found

RESTING_PERIODS = 5
PERSISTED_S = 2.0  #: that a loop which ends waits for its disk
SET_ASIDE = "configuration-set-aside"  #: kind of event
#: Messages that are taken within 25 ms of all who write to it: whoever floods it takes little of a period.
MOST_PER_WINDOW = 20


def run_loop(
    line: Line,
    config: Controller,
    run_folder: Path,
    say: Callable[[str], None],
    data_folder: Path,
    *,
    simulated: bool = False,
) -> None:
    """Run until SIGTERM or SIGINT, which stop the line first.

    The last known good configuration outlives the loop in its part of `data_folder`, the line's. `simulated`: the line
    is, for certain; then it takes experiments.

    Raises AlreadyRunning before anything is sent, CannotListen, PathTooLong, and LinksRefused
    when the drivers cannot carry the line.
    """

    def gateways_key() -> PublicKey | None:
        try:
            return public_key(line.site, line.line, data_folder / GATEWAY_DATA)
        except KeyUnusable as error:
            say(f"no command of the gateway can be taken: {error}")
            return None

    asyncio.run(_main(line, config, run_folder, data_folder, say, gateways_key, simulated))


async def _main(
    line: Line,
    config: Controller,
    run_folder: Path,
    data_folder: Path,
    say: Callable[[str], None],
    gateways_key: Callable[[], PublicKey | None],
    simulated: bool,
) -> None:
    key = gateways_key()
    own = data_folder / LOOP_DATA
    store = Store(own, config, key)
    mailbox = UnixMailbox(most_per_window=MOST_PER_WINDOW)
    # First the socket, whose lock makes this the only loop of the line; only then are the buses touched. Whoever asks
    # waits in the kernel until there are answers: up to `_open` nothing gives the event loop a turn.
    await mailbox.listen(run_folder / LOOP_SOCKET)
    try:
        alone = hold_alone(own, "loop", say)
    except AlreadyRunning:
        await mailbox.close()
        raise
    mailbox.connect({LOOP_TELEMETRY, LOOP_EVENT, LOOP_BUSES}, run_folder / GATEWAY_SOCKET)
    links = build_links(line)
    voice = Voice(mailbox, links, line.control.period_s)
    watch = Watch(line, speed_steps_m_per_s(line), drive_tells(line))
    wiring = Wiring(line, map_files(line), own)
    wiring.read(say)
    cycle = Cycle(
        line, config, links, watch, monotonic, voice.record, voice.announce, voice.tell, simulated=simulated,
        wiring=wiring,
    )  # fmt: skip
    try:
        store.write_given(config)
    except OSError as error:
        say(f"the gateway cannot know what this loop was given: {store.path.parent}: {error.strerror}")
    begin(cycle, store.read(line, say), say)
    runner = Runner(cycle, store)
    # A gateway that is started for the first time makes its key later than this loop has looked for it.
    door = Door(
        runner, LineName(line.site, line.line), lambda: key or gateways_key(), monotonic, voice.tell, is_open=False,
        period_s=line.control.period_s,
    )  # fmt: skip
    voice.stopper = lambda: door.stopper
    identity = _identity(run_folder, cycle, say)
    ending = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, ending.set)
    try:
        mailbox.serve(LOOP_SHOWN, identity.answer)
        mailbox.serve(LOOP_COMMAND, door.command)
        mailbox.serve(LOOP_HELLO, door.introduce)
        for trouble in await _open(links):
            say(trouble)
            voice.tell_start("bus", trouble)
        for unusable in [*store.unusable, *wiring.unusable, *_unusable_maps()]:
            voice.tell_start("file", unusable.text, findings=[unusable])
        door.open()
        running = cycle.configurations.running
        if store.unexplained:
            told = [found(one.code, Action.NONE, **one.parameters) for one in store.unexplained]
            voice.tell_start(SET_ASIDE, sentences(store.unexplained), findings=told)
        if store.unverified:
            told = [found(one.code, Action.NONE, **one.parameters) for one in store.unverified]
            voice.tell_start("configuration-not-used", sentences(store.unverified), findings=told)
        if against := cycle.wiring.against:  # so that nobody learns of it from a start that is refused
            told = [found(one.code, Action.NONE, **one.parameters) for one in against]
            voice.tell_start("wiring", sentences(against), findings=told)
            say(sentences(against))
        voice.tell_start(
            "start", f"loop of {line.site}/{line.line}, {running.config.kind} controller {running.hash[:12]}"
        )
        say(f"loop of {line.site}/{line.line} is SILENT, commands on {run_folder / LOOP_SOCKET}")
        freeze_collector()
        # Last: what starts up must not take a processor from another line's loop.
        granted, refused = become_punctual(line.control.cpu, line.control.priority)
        sleepy = stay_awake()
        (refused if sleepy else granted).append(sleepy or "processors stay awake")
        for sentence in ["; ".join(granted) or "no real-time help granted", *refused]:
            say(sentence)
        await run_until(runner, line, ending, store)
    finally:
        await finish_all(link.close() for link in links)
        runner.close()
        door.close()
        identity.close()
        await mailbox.close()
        alone.close()


def begin(cycle: Cycle, kept: Kept | None, say: Callable[[str], None]) -> None:
    """Before the first period: what runs is what the loop before has kept, or what this one is given; measured.

    What cannot be used is told. A controller that takes longer than a period has for it is not armed. What no verdict
    has let through goes no further than a first configuration.
    """
    _begin(cycle, kept, say)
    cycle.confine_unconfirmed()


def _begin(cycle: Cycle, kept: Kept | None, say: Callable[[str], None]) -> None:
    if kept is not None:
        try:
            cycle.resume(kept, say)
            return
        except ControllerRefused as refused:
            say(f"what was kept is not used, the configuration given is, no further: {refused}")
            cycle.go_no_further(kept)
    if unfit := cycle.measure_given():
        say(f"the line cannot be armed with the controller given: {unfit}")


def _unusable_maps() -> list[Finding]:
    """Device maps with mistakes. None of this line's: with such a one it would have been refused."""
    return [
        found("file-unusable", Action.NONE, file=problems[0].file, reason=str(problems[0]))
        for problems in load_maps().unusable.values()
    ]


def _identity(run_folder: Path, cycle: Cycle, say: Callable[[str], None]) -> Identity:
    """With the key that lies in the run folder, or a new one; where it cannot lie there, that is tried again."""
    try:
        key = read_key(run_folder)
    except NoKey:
        key = new_key()
    try:
        keep_key(run_folder, key)
    except NoKey as error:
        say(f"this loop cannot show who it is yet, and the gateway takes nothing of it until it can: {error}")
    return Identity(key, cycle, lambda: keep_key(run_folder, key))


async def _open(links: list[Link]) -> list[str]:
    """Open every bus. One that cannot be opened leaves its devices absent, and arming is refused; returns why."""
    troubles: list[str] = []
    for link in links:
        try:
            await link.open()
        except OSError as error:
            troubles.append(str(error))
    return troubles


async def run_until(runner: Runner, line: Line, ending: asyncio.Event, store: Store | None = None) -> None:
    """Periods until `ending`, then until the line rests. An exception ends it with torque off, and is raised."""
    pacer = TimerPacer(line.control.period_s)
    collector = RestCollector()
    try:
        while not ending.is_set():
            await runner.period(await pacer.wait())
            collector.note_phase(runner.cycle.machine.phase)
        await runner.end()
        deadline_s = monotonic() + line.longest_stop_s
        resting = 0  # periods; what is handed over acts with the next, and the drives say so with the one after
        while resting < RESTING_PERIODS and monotonic() < deadline_s:
            await runner.period(await pacer.wait())
            resting = resting + 1 if runner.at_rest else 0
    except BaseException as error:
        await finish(_torque_off(runner.cycle, pacer))
        await finish(runner.over(PERSISTED_S))
        if store is not None and isinstance(error, Exception):
            _count_death(runner.cycle, store, error)
        raise
    else:
        await _come_to_rest(runner, store)
    finally:
        pacer.close()


async def _come_to_rest(runner: Runner, store: Store | None) -> None:
    """After the last period of an orderly end: devices released, the disk as it was decided."""
    cycle = runner.cycle
    try:
        if cycle.machine.phase is Phase.OFF:
            await release_links(cycle)
    finally:
        await runner.over(PERSISTED_S)
        if store is not None and cycle.account.ran:
            with suppress(OSError):
                store.deaths.forgive(fingerprint(cycle.configurations.durable))


def _count_death(cycle: Cycle, store: Store, error: Exception) -> None:
    """Of what a loop that starts anew would run: what was on probation is gone with this process.

    A failing link or command says nothing of a configuration, and nor does one that has never run the line.
    """
    if cycle.configurations.probation is None and cycle.account.ran and cycle.containment.speaks_of_configuration:
        with suppress(OSError):
            died = store.last or cycle.configurations.durable
            store.deaths.count(fingerprint(died), f"{type(error).__name__}: {error}")


async def _torque_off(cycle: Cycle, pacer: TimerPacer) -> None:
    """The last thing a broken loop does: tell all drives at once to take torque off. Watchdogs stand behind it."""
    for link in cycle.links:
        with suppress(Exception):
            link.write(Outputs(cycle.line.n))
    tick = await pacer.wait()
    for link in cycle.links:
        with suppress(Exception):
            link.trigger(tick.now_s)
    await finish_all(link.release() for link in cycle.links)
