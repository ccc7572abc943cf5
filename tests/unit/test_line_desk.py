"""What agents are told of the line: what is stored of it, whole, and nothing for who asks otherwise."""

import asyncio
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from agents.line_on_bus import LineNotTold, LineOnBus
from gateway.core.controller import config_hash
from gateway.core.line_model import LineModel, model_hash, parse_model
from gateway.core.line_queries import KnowledgePart, OfKnowledge, OfRecording
from gateway.core.messages import Reply
from gateway.core.packed_recording import most_samples, packed
from gateway.core.recording import ARRAYS, Recording
from gateway.core.topics import (
    ASK_CONTROLLER,
    ASK_KNOWLEDGE,
    ASK_MODEL,
    ASK_RECORDING,
    ASK_RECORDINGS,
    AgentTopic,
)
from gateway.mailbox.inprocess import Hub, InProcessMailbox
from gateway.mailbox.port import MAX_PAYLOAD
from gateway.supervisor import configurations, line_desk, models
from gateway.supervisor.agents_cases import AgentsCases
from gateway.supervisor.configurations import Origin, begin_configurations
from gateway.supervisor.gate import Gate
from gateway.supervisor.line_desk import LineDesk
from gateway.supervisor.models import begin_repository
from tests.support.gateway_key import to_loop_over
from tests.unit.deployer_support import FIRST, LINE, Death, FakeJudge, FakeLoop, FakeSurroundings, controller

NOW_S = 1_700_000_000.0
ROWS = (ASK_MODEL, ASK_CONTROLLER, ASK_RECORDINGS, ASK_RECORDING, ASK_KNOWLEDGE)
MODEL = parse_model(Path("docs/examples/line-model.json").read_bytes())


def recording(samples: int, seed: int = 0, n: int = LINE.n) -> Recording:
    """Of noise, which does not compress."""
    generator = np.random.default_rng(seed)
    arrays = {name: generator.standard_normal((samples, n)) for name in ARRAYS}
    arrays |= {"time_s": np.arange(samples) * 0.01, "unwind_speed_m_per_s": generator.standard_normal(samples)}
    return Recording(**(arrays | {"controlled": np.ones(samples, dtype=bool)}), period_s=0.01, source=f"noise {seed}")


async def no_pause(_: float) -> None: ...


class Desk:
    """A desk with a real gate and stores; nothing runs behind it."""

    def __init__(self, folder: Path) -> None:
        self.hub = Hub()
        self.bus = InProcessMailbox(self.hub)
        self.recordings: list[tuple[Recording, float]] = []
        self.read = 0
        self.folder = folder
        self.gate = Gate(
            LINE, InProcessMailbox(self.hub), to_loop_over(InProcessMailbox(self.hub), LINE), folder, FakeJudge(),
            lambda configurations, models: FakeSurroundings(FakeLoop(Death())), lambda *_, **__: None, lambda: 1.0,
            lambda: NOW_S,
        )  # fmt: skip
        cases = AgentsCases(self.gate.audit.append)
        LineDesk(LINE, self.gate, folder, self._experiments, cases).serve_on(InProcessMailbox(self.hub))
        self.line = LineOnBus(self.bus, "sysid", no_pause)

    def _experiments(self, _: float) -> list[tuple[Recording, float]]:
        self.read += 1
        return self.recordings

    async def opened(self) -> None:
        while self.gate.deployer is None:
            await self.gate.look()

    def in_service(self, configuration: str | None, model: str | None) -> None:
        assert self.gate.deployer is not None
        self.gate.deployer.book.in_service, self.gate.deployer.book.model = configuration, model

    async def ask(self, row: AgentTopic, payload: bytes) -> bytes:
        return await self.bus.request(row.of("code"), payload, 60.0)


def at_desk(story, folder: Path) -> None:
    async def whole() -> None:
        desk = Desk(folder)
        try:
            async with asyncio.timeout(120.0):
                await story(desk)
        finally:
            await desk.gate.close()

    asyncio.run(whole())


def stored_model(folder: Path, **changes) -> LineModel:
    model = MODEL.model_copy(update={"site": LINE.site, "line": LINE.line, **changes})
    with begin_repository(folder / models.FILE_NAME) as store:
        store.store(model, NOW_S)
    return model


def test_the_model_in_service_or_by_hash_is_told_whole_and_of_no_other_line(tmp_path):
    async def story(desk: Desk) -> None:
        await desk.opened()
        assert await desk.line.model() is None  # none has been accepted
        model, strange = stored_model(desk.folder), stored_model(desk.folder, line="another")
        desk.in_service(None, model_hash(model))
        assert await desk.line.model() == model == await desk.line.model(model_hash(model))
        for hash_ in (model_hash(strange), "0" * 64):
            with pytest.raises(LineNotTold, match=f"no model {hash_[:12]} was ever stored"):
                await desk.line.model(hash_)

    at_desk(story, tmp_path)


def test_the_configuration_in_service_or_by_hash_is_told(tmp_path):
    async def story(desk: Desk) -> None:
        await desk.opened()
        with pytest.raises(LineNotTold, match="start it"):
            await desk.line.controller()
        with begin_configurations(desk.folder / configurations.FILE_NAME) as store:
            for one in (FIRST, controller(2)):
                store.store(LINE.site, LINE.line, one, Origin(NOW_S, "rules", "a test"))
        desk.in_service(config_hash(FIRST), None)
        assert await desk.line.controller() == FIRST
        assert await desk.line.controller(config_hash(controller(2))) == controller(2)
        with pytest.raises(LineNotTold, match="no configuration 000000000000 was ever stored"):
            await desk.line.controller("0" * 64)

    at_desk(story, tmp_path)


def test_recordings_come_in_parts_that_fit_and_are_what_they_were(tmp_path):
    async def story(desk: Desk) -> None:
        long, short = recording(4000, 1), recording(3, 2)
        desk.recordings = [(short, NOW_S), (long, NOW_S - 60.0)]
        found = await desk.line.recordings()
        assert [one.digest() for one in found] == [short.digest(), long.digest()]
        assert [one.source for one in found] == ["noise 2", "noise 1"]
        assert desk.read == 1, "the list; the parts are of what was read for it"
        ask = OfRecording(digest=long.digest(), part=99)
        reply = Reply.model_validate_json(await desk.ask(ASK_RECORDING, ask.model_dump_json().encode()))
        assert not reply.ok and "allowed: 0 to" in reply.reasons[0]
        for digest in ("0" * 64, recording(4000, 3).digest()):
            unknown = OfRecording(digest=digest, part=0).model_dump_json().encode()
            reply = Reply.model_validate_json(await desk.ask(ASK_RECORDING, unknown))
            assert not reply.ok and "ask for the list" in reply.reasons[0]
        assert desk.read == 1, "who guesses has nothing read"

    at_desk(story, tmp_path)


def test_two_who_read_other_recordings_at_a_time_have_nothing_read_again(tmp_path):
    async def story(desk: Desk) -> None:
        found = [recording(4000, 1), recording(4000, 2)]
        desk.recordings = [(one, NOW_S) for one in found]
        await desk.ask(ASK_RECORDINGS, b"")
        for part in range(2):
            for one in found:
                ask = OfRecording(digest=one.digest(), part=part).model_dump_json().encode()
                size = most_samples(LINE.n, MAX_PAYLOAD)
                assert await desk.ask(ASK_RECORDING, ask) == packed(one.part(part * size, (part + 1) * size))
        desk.recordings = desk.recordings[:1]
        await desk.ask(ASK_RECORDINGS, b"")
        gone = OfRecording(digest=found[1].digest(), part=0).model_dump_json().encode()
        assert not Reply.model_validate_json(await desk.ask(ASK_RECORDING, gone)).ok
        assert desk.read == 2, "once for each list"

    at_desk(story, tmp_path)


@pytest.mark.parametrize("n", [1, 6, 60])
def test_a_part_of_a_recording_fits_into_a_message_whatever_its_numbers(n):
    size = most_samples(n, MAX_PAYLOAD)
    assert size >= 90 and len(packed(recording(size, n=n))) <= MAX_PAYLOAD


def test_knowledge_comes_in_parts_once_and_again_when_something_has_changed(tmp_path, monkeypatch):
    async def story(desk: Desk) -> None:
        await desk.opened()
        first = await desk.line.knowledge_since(None)
        assert first is not None and {"line", "line-limits", "in-service"} <= {one.name for one in first.documents}
        assert await desk.line.knowledge_since(first.revision) is None
        stored_model(desk.folder)
        desk.in_service(config_hash(FIRST), None)
        second = await desk.line.knowledge_since(first.revision)
        assert second is not None and second.revision != first.revision
        monkeypatch.setattr(line_desk, "MAX_PAYLOAD", 10_000)
        payload = OfKnowledge().model_dump_json().encode()
        parts = KnowledgePart.model_validate_json(await desk.ask(ASK_KNOWLEDGE, payload)).parts
        assert parts > 1 and await desk.line.knowledge() == second.documents
        ask = OfKnowledge(revision=first.revision, part=1)
        answer = await desk.ask(ASK_KNOWLEDGE, ask.model_dump_json().encode())
        assert "begin anew" in Reply.model_validate_json(answer).reasons[0]

    at_desk(story, tmp_path)


def test_while_the_gate_is_shut_what_needs_it_is_refused_with_the_reason(tmp_path):
    async def story(desk: Desk) -> None:
        for asked in (desk.line.model, desk.line.controller, desk.line.knowledge):
            with pytest.raises(LineNotTold, match="the gate is shut"):
                await asked()
        assert await desk.line.recordings() == []

    at_desk(story, tmp_path)


def test_without_a_gateway_who_asks_is_told_so():
    async def story() -> None:
        with pytest.raises(LineNotTold, match="start it with `r2rgate gateway LINE.toml`"):
            await LineOnBus(InProcessMailbox(Hub()), "code", no_pause).recordings()

    asyncio.run(story())


ASKS = st.one_of(
    st.binary(max_size=200),
    st.sampled_from([b'{"hash": "' + b"0" * 64 + b'"}', b"{}", b"[" * 5000, b'{"part": -1}', b'{"revision": 7}',
                     b'{"hash": "../audit.sqlite"}', b'{"digest": "' + b"f" * 64 + b'", "part": 999999}']),
    st.dictionaries(
        st.sampled_from(["format", "hash", "digest", "part", "revision", "command"]),
        st.one_of(st.none(), st.integers(), st.text(max_size=70), st.floats()), max_size=4,
    ).map(lambda fields: json.dumps(fields).encode()),
)  # fmt: skip


@pytest.mark.slow
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(payload=ASKS)
def test_whatever_is_asked_nothing_fails_and_nothing_is_written(tmp_path, payload):
    async def story(desk: Desk) -> None:
        await desk.opened()
        before = {file.name: file.read_bytes() for file in desk.folder.glob("*.sqlite")}
        for row in ROWS:
            answer = await desk.ask(row, payload)
            assert answer.startswith(b"{") or row is ASK_RECORDING
        assert desk.bus.counters.handler_errors == 0
        assert {file.name: file.read_bytes() for file in desk.folder.glob("*.sqlite")} == before

    at_desk(story, tmp_path)
