"""The table of topics: every row of the agents' bus is one key on the wire, and says who asks and who answers."""

import subprocess
import sys
from itertools import combinations

import pytest
import zenoh

from gateway.core.questions import AGENTS
from gateway.core.topics import AGENT_NAMES, AGENT_TOPICS, ASK_UNANSWERED, TOPICS
from gateway.mailbox.port import what_to_start


def test_no_topic_is_another_one_and_each_is_a_key():
    topics = [*TOPICS, *(row.of(agent) for row in AGENT_TOPICS for agent in AGENT_NAMES)]
    keys = [zenoh.KeyExpr(f"site/line/{topic.name}") for topic in topics]
    assert not [(str(a), str(b)) for a, b in combinations(keys, 2) if a.intersects(b)]


@pytest.mark.parametrize("row", AGENT_TOPICS, ids=lambda row: row.name)
def test_what_agents_ask_begins_with_ask_and_what_they_are_asked_with_agents(row):
    assert row.name.startswith("ask/*/" if row.answers == "gateway" else "agents/*/")
    told = row is ASK_UNANSWERED  # by a phase, of an agent that has failed
    assert row.answers == ("gateway" if row.asks == "agent" or told else "agent")
    one = row.of("sysid")
    assert one.name == row.name.replace("*", "sysid")
    assert (one.most_per_s, one.kept) == (row.most_per_s, row.kept)
    served_by = "gateway" if row.answers == "gateway" else "agents"
    assert what_to_start(one) == f"{served_by} not running: start it with `r2rgate {served_by} LINE.toml`"


def test_whoever_answers_questions_is_an_agent_of_the_bus():
    assert set(AGENTS.values()) <= set(AGENT_NAMES)


def test_the_loop_does_not_even_load_the_bus():
    program = "import sys, gateway.loop.process; sys.exit(any(name.split('.')[0] == 'zenoh' for name in sys.modules))"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
