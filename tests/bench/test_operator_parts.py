"""Parts of bench-operator that need no line: what is hostile about its messages, and which run passes for the whole."""

import asyncio

from tests.bench.figures import GOALS
from tests.bench.operator import BUSY, CASES, ROUNDS, bench_of
from tests.bench.operator_attacks import BEFORE, INSIDE, deliver
from tests.bench.operator_windows import Found, Turn
from tests.protocol.operator_support import bench


def test_every_case_has_a_goal_but_for_the_load_that_it_is_compared_with():
    goals = {name.removeprefix("lateness_p99_ratio_") for name in GOALS["operator"] if "ratio" in name}
    assert goals == set(CASES) and BUSY not in goals


def test_a_shortened_run_is_held_against_the_same_goals_and_does_not_pass_for_the_whole():
    part, whole = bench_of(False, ["--rounds", str(ROUNDS - 1)]), bench_of(True, [])
    assert (part.name, whole.name) == ("operator-part", "operator")
    assert part.goals_of == "operator" and part.command == 'make bench-operator ARGS="--rounds 2"'


def test_a_deed_counts_for_the_case_in_which_it_began_and_what_failed_took_for_ever():
    turns = [Turn("readers", 10.0, 20.0, 0.0, 0.0, []), Turn("quiet", 20.0, 30.0, 0.0, 0.0, [])]
    deeds = [
        {"kind": "read", "at_s": at_s, "took_s": took_s, "why": why}
        for at_s, took_s, why in ((9.9, 1.0, ""), (10.0, 2.0, ""), (19.9, 5.0, "refused"), (20.0, 4.0, ""))
    ]
    found = Found(turns, deeds=deeds)
    assert found.took_s("readers", "read") == [2.0, float("inf")]
    assert found.took_s("quiet", "read") == [4.0] and found.took_s("readers", "call") == []


def test_the_server_outlives_all_that_is_hostile_and_serves_others():
    async def story():
        async with bench(spans=1) as b, b.connected("vera") as client:
            for name in (*BEFORE, *INSIDE):
                async with asyncio.timeout(30.0):
                    assert await deliver(name, ("127.0.0.1", b.opcua.server.port)), name
                    assert (await b.read(client, "Line.Limits.TensionMax")).StatusCode.is_good(), name
            async with b.connected("otto"):
                pass
            assert b.gateway.heard == []

    asyncio.run(story())
