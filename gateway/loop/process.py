"""The loop process: one line, one controller, its links, its command socket; no other socket and no database."""

import asyncio
import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from drivers.port import Link
from drivers.registry import build_links, speed_steps_m_per_s
from gateway.core.controller import Controller, ControllerRefused
from gateway.core.line import Line
from gateway.core.signals import Outputs
from gateway.core.states import Phase
from gateway.core.topics import LOOP_BUSES, LOOP_COMMAND, LOOP_EVENT, LOOP_TELEMETRY
from gateway.loop.arming import release_links
from gateway.loop.cycle import Cycle
from gateway.loop.kept import Kept, Store, fingerprint
from gateway.loop.memory import RestCollector
from gateway.loop.pacer import TimerPacer, monotonic
from gateway.loop.realtime import become_punctual, freeze_collector, stay_awake
from gateway.loop.runner import Runner
from gateway.loop.voice import Voice
from gateway.loop.watch import Watch
from gateway.mailbox.paths import GATEWAY_SOCKET, LOOP_SOCKET
from gateway.mailbox.unix import UnixMailbox
from gateway.tasks.cleanup import finish, finish_all

RESTING_PERIODS = 5
PERSISTED_S = 2.0  #: that a loop which ends waits for its disk


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

    The last known good configuration outlives the loop in `data_folder`. `simulated`: the line is, for certain; then
    it takes experiments.

    Raises AlreadyRunning before anything is sent, CannotListen, PathTooLong, and LinksRefused
    when the drivers cannot carry the line.
    """
    asyncio.run(_main(line, config, run_folder, say, Store(data_folder, config), simulated))


async def _main(
    line: Line, config: Controller, run_folder: Path, say: Callable[[str], None], store: Store, simulated: bool
) -> None:
    mailbox = UnixMailbox()
    # First the socket, whose lock makes this the only loop of the line; only then are the buses touched.
    await mailbox.listen(run_folder / LOOP_SOCKET)
    mailbox.connect({LOOP_TELEMETRY, LOOP_EVENT, LOOP_BUSES}, run_folder / GATEWAY_SOCKET)
    links = build_links(line)
    voice = Voice(mailbox, links, line.control.period_s)
    watch = Watch(line, speed_steps_m_per_s(line))
    cycle = Cycle(line, config, links, watch, monotonic, voice.record, voice.announce, voice.tell, simulated=simulated)
    try:
        store.write_given(config)
    except OSError as error:
        say(f"the gateway cannot know what this loop was given: {store.path.parent}: {error.strerror}")
    begin(cycle, store.read(line, say), say)
    runner = Runner(cycle, store)
    ending = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, ending.set)
    try:
        for trouble in await _open(links):
            say(trouble)
            voice.tell("bus", trouble)
        mailbox.serve(LOOP_COMMAND, runner.command)
        running = cycle.configurations.running
        voice.tell("start", f"loop of {line.site}/{line.line}, {running.config.kind} controller {running.hash[:12]}")
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
        await mailbox.close()


def begin(cycle: Cycle, kept: Kept | None, say: Callable[[str], None]) -> None:
    """Before the first period: what runs is what the loop before has kept, or what this one is given; measured.

    What cannot be used is told. A controller that takes longer than a period has for it is not armed.
    """
    if kept is not None:
        try:
            cycle.resume(kept, say)
            return
        except ControllerRefused as refused:
            say(f"what was kept is not used, the configuration given is, no further: {refused}")
            cycle.go_no_further(kept)
    if unfit := cycle.measure_given():
        say(f"the line cannot be armed with the controller given: {unfit}")


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
