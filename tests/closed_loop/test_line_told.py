"""What a commissioned line tells its agents: what the chain has left in the gate's stores, over a real bus, and found.

The line is commissioned in stepped time, so that models, deployments and measurements are those of a whole gate.
"""

import asyncio
from pathlib import Path

import numpy as np
import pytest

from agents.line_on_bus import LineOnBus
from agents.rag.library import open_library
from agents.rag.stages import Asked
from gateway.cli.commission import commission
from gateway.cli.commission_stepped import SteppedGate, impatient
from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, task_of
from gateway.core.controller import config_hash
from gateway.core.line_model import model_hash
from gateway.mailbox.bus import connect, open_router
from gateway.supervisor.agents_cases import AgentsCases
from gateway.supervisor.experiments import MOST_EXPERIMENTS
from gateway.supervisor.knowledge.stored import known_in
from gateway.supervisor.line_desk import LineDesk
from tests.bench.control_plants import random_plant
from tests.closed_loop.recorded import demonstration_line
from tests.unit.supervisor_support import short_folder

pytestmark = [pytest.mark.wires, pytest.mark.long, pytest.mark.timeout(900)]

LINE, SEED = impatient(demonstration_line(2)), 72_000
STIFFNESS = ("what is the stiffness of the web on this line", "How stiff is the web of this line?")


def test_a_commissioned_line_tells_what_it_has_become(tmp_path):
    loop = SteppedLoop(LINE, design_lqi(task_of(LINE)), random_plant(SEED, LINE.n), SEED)
    recipe = LINE.recipes[0]
    loop.begin_in_production(np.array(recipe.tension_n), recipe.speed_m_per_s)

    async def story(sockets: Path) -> None:
        async with SteppedGate(loop, tmp_path, SEED) as side:
            await commission(LINE, side, most_redesigns=1)
            now = await side.now()
            assert now.model is not None

            def newest(_: float):
                return list(reversed(side.experiments))[:MOST_EXPERIMENTS]

            bus = await open_router(LINE, sockets)
            LineDesk(LINE, side.gate, tmp_path, newest, AgentsCases(side.gate.audit.append)).serve_on(bus)
            agents = await connect(sockets, LINE.site, LINE.line)
            try:
                line = LineOnBus(agents, "sysid")
                model = await line.model()
                assert model is not None and model_hash(model) == model_hash(now.model)
                assert config_hash(await line.controller()) == config_hash(now.in_service)
                told = [one.digest() for one in await line.recordings()]
                assert told == [one.digest() for one, _ in newest(0.0)] and model.data.digest in told
                known = await line.knowledge()
            finally:
                await agents.close()
                await bus.close()
        assert known == known_in(tmp_path, LINE).documents  # as `r2rgate ask` has it without a gateway
        kinds = {one.name.partition("-")[0] for one in known}
        assert {"line", "in", "recent", "model", "deployment", "experiment"} <= kinds
        with (await open_library(tmp_path / "knowledge", 3, generated=known)).index as index:
            for question in STIFFNESS:
                hit = (await index.ask(Asked(question))).hits[0]
                assert hit.document.name.startswith("model-") and "stiffness of the web" in hit.passage.text
                assert f"{model.parameters.stiffness_n:.4g} N" in hit.passage.text

    with short_folder() as sockets:
        asyncio.run(story(sockets))
