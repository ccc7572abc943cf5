"""The chain from the line's file to adapted configurations, on the line that runs, with the cases on each of them."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path

from gateway.cli.asked_agents import AskedAgents
from gateway.cli.commission import commission
from gateway.cli.commission_changes import LineNow
from gateway.cli.commission_live import TOPICS, LiveGate
from gateway.cli.commission_result import Commissioned
from gateway.cli.commission_side import GateSide
from gateway.cli.demo_cases import Window, again_after_stops, run_with_repeats
from gateway.cli.demo_failed import DemoFailed
from gateway.cli.demo_line import Setup
from gateway.cli.demo_operator import Operator
from gateway.cli.demo_stepped import SteppedAside
from gateway.cli.within_region import beyond
from gateway.commissioning.past import Step, past_of
from gateway.core.controller import Controller, config_hash
from gateway.core.decisions import ProposalShown
from gateway.core.deployment import Region
from gateway.core.messages import Reply, SelectRecipe
from gateway.core.proposal import GainsChange
from gateway.core.recording import Recording
from gateway.core.scenario import PAPER
from gateway.mailbox.bus import BusUnavailable, connect
from gateway.mailbox.paths import GATEWAY_SOCKET
from gateway.mailbox.unix import UnixMailbox
from gateway.mailbox.zenoh_mailbox import ZenohMailbox

FASTEST_M_PER_S = max(case.speed_end_m_per_s for case in PAPER)
ADAPTATIONS = 2  #: as the paper's table has them for both cases
MOST_DECISIONS = 3  #: on one proposal, where carrying it out is refused for the moment

#: What is going on, by the stage that a proposal has come to.
DOING = {
    "received": "the gate judges it",
    "probation": "it controls the line, on probation",
    "keeping": "it is being kept",
    "running": "the experiment runs",
}

Measure = Callable[[Controller, ProposalShown], Awaitable[None]]
Decide = Callable[[ProposalShown], Awaitable[None]]


class Measured:
    """A gate behind which each configuration that is kept is measured before the chain goes on. See GateSide."""

    def __init__(self, side: GateSide, decide: Decide, measure: Measure, tell: Callable[[str], None]) -> None:
        self._side = side
        self._decide = decide
        self._measure = measure
        self._tell = tell
        self._told: tuple[str, str] | None = None
        self._measured: set[str] = set()  #: hashes of configurations

    async def proposals(self) -> list[ProposalShown]:
        return await self._side.proposals()

    async def now(self) -> LineNow:
        return await self._side.now()

    async def state(self) -> str:
        return await self._side.state()

    async def folder(self) -> Path:
        return await self._side.folder()

    async def recordings(self) -> list[Recording]:
        return await self._side.recordings()

    async def propose(self, payload: bytes) -> Reply:
        return await self._side.propose(payload)

    async def is_back(self, why: str) -> bool:
        return await self._side.is_back(why)

    async def ready(self) -> None:
        await self.measure_kept()
        await self._side.ready()

    async def wait_for(self, proposal: str) -> None:
        shown = next(one for one in await self._side.proposals() if one.proposal_hash == proposal)
        if shown.stage == "waiting":
            await self._decide(shown)
            return
        if self._told != (proposal, shown.stage) and shown.stage in DOING:
            self._told = proposal, shown.stage
            self._tell(f"  {DOING[shown.stage]}")
        await self._side.wait_for(proposal)

    async def measure_kept(self) -> None:
        """What is in service, where it is a redesign that has been kept and not been measured.

        A first configuration is judged for smaller steps than those of the cases.
        """
        kept = [
            one for one in await self._side.proposals() if one.stage == "kept" and past_of(one).step is Step.REDESIGN
        ]
        for shown in reversed(kept):
            if isinstance(shown.proposal.change, GainsChange):
                controller = shown.proposal.change.controller
                if config_hash(controller) not in self._measured:
                    await self._measure(controller, shown)
                    self._measured.add(config_hash(controller))
                return


@dataclass
class Chain:
    """What has been done, as far as the demonstration saw it."""

    windows: list[Window] = field(default_factory=list[Window])
    left_out: list[str] = field(default_factory=list[str])  #: cases that a configuration was not judged for
    shown: list[ProposalShown] = field(default_factory=list[ProposalShown])
    commissioned: Commissioned | None = None
    approved_over: dict[str, str] = field(default_factory=dict[str, str])  #: by proposal what was read of it


async def carry_out(operator: Operator, setup: Setup, stepped: SteppedAside) -> Chain:
    """On a line that runs. The operator approves what the gate lets through."""
    chain, decided = Chain(), dict[str, int]()
    period_s = setup.line.control.period_s

    async def decide(shown: ProposalShown) -> None:
        proposal = shown.proposal_hash
        operator.progress.step(f"  the gate lets it through by {_rules(shown)} rules; {proposal[:12]} waits")
        decided[proposal] = decided.get(proposal, 0) + 1
        try:
            chain.approved_over[proposal] = await operator.approve(proposal)
        except DemoFailed as refused:
            if decided[proposal] == MOST_DECISIONS:
                raise
            operator.progress.step(f"  {refused}")

    async def measure(config: Controller, shown: ProposalShown) -> None:
        name = name_of(len({config_hash(window.config) for window in chain.windows}))
        operator.progress.step(f"  kept. {name} is measured: {len(PAPER)} cases of {PAPER[0].duration_s:g} s")
        stepped.ask(config)
        found: list[Window] = []
        for case in PAPER:
            if against := beyond(case, _region(shown)):
                chain.left_out.append(f"{name}, {case.heading.lower()}: {against}")
            else:
                found.append(await run_with_repeats(operator, config, case, period_s))
        chain.windows += found

    chain.windows = await _initial(operator, setup, stepped)
    bus = await _bus(operator, setup)
    mailbox = UnixMailbox()
    mailbox.connect(TOPICS, operator.run_folder / GATEWAY_SOCKET)
    side = Measured(
        LiveGate(setup.line, mailbox, operator.progress.step, operator.watch), decide, measure, operator.progress.step
    )

    async def adapt() -> Commissioned:
        found = await commission(
            setup.line,
            side,
            operator.progress.step,
            wanted_m_per_s=FASTEST_M_PER_S,
            adaptations=ADAPTATIONS,
            most_redesigns=ADAPTATIONS,
            decider=AskedAgents(setup.line, bus, asyncio.get_running_loop(), tell=operator.progress.step),
        )
        await side.measure_kept()
        return found

    showing = asyncio.create_task(operator.keep_showing())
    try:
        chain.commissioned = await again_after_stops(operator, adapt, "the chain goes on after a stop")
        chain.shown = await side.proposals()
    finally:
        showing.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await showing
        await bus.close()
        await mailbox.close()
    return chain


async def _bus(operator: Operator, setup: Setup) -> ZenohMailbox:
    """On which the agents are asked."""
    try:
        return await connect(operator.run_folder, setup.line.site, setup.line.line)
    except BusUnavailable as error:
        raise DemoFailed(f"the agents cannot be asked: {error}") from error


def _rules(shown: ProposalShown) -> int:
    return 0 if shown.verdict is None else len(shown.verdict.findings)


def _region(shown: ProposalShown) -> Region | None:
    return None if shown.verdict is None else shown.verdict.region


async def _initial(operator: Operator, setup: Setup, stepped: SteppedAside) -> list[Window]:
    """Both cases under what the loop was started with, and back to where the line stood."""
    operator.progress.step(f"Initial, what the loop was started with, is measured: {len(PAPER)} cases")
    stepped.ask(setup.config)
    period_s, recipe = setup.line.control.period_s, setup.line.recipes[0]
    windows = [await run_with_repeats(operator, setup.config, case, period_s) for case in PAPER]
    operator.progress.step(f"back to {recipe.name}, from where the chain goes on: settling at its set-points")
    await operator.order(SelectRecipe(name=recipe.name))
    await operator.wait_settled(recipe.tension_n, recipe.speed_m_per_s)
    return windows


def name_of(place: int) -> str:
    """Of a configuration, in the paper's words: `place` from 0 in the order in which they were kept."""
    return "Initial" if place == 0 else f"Adapt{place}"
