"""The table [agents] of a line's file: what finds knowledge is known by its name."""

import pytest

from gateway.core.line_template import line_template
from tests.unit.line_checks_support import check, problems


def text(embedder: str) -> str:
    return line_template(1).replace("[agents]", f'[agents]\nembedder = "{embedder}"')


@pytest.mark.parametrize("embedder", ["lexical", "minilm", "ollama:nomic-embed-text", "ollama:a:b"])
def test_what_is_an_embedder_is_taken(embedder: str) -> None:
    checked = check(text(embedder))
    assert checked.line.agents.embedder == embedder and checked.warnings == []


@pytest.mark.parametrize(
    ("embedder", "meant"),
    [
        ("lexcial", '"lexical"'),
        ("MiniLM", '"minilm"'),
        ("ollama", '"ollama:MODEL"'),
        ("ollama:", '"ollama:MODEL"'),
        ("bert", ""),
    ],
)
def test_what_is_none_is_refused_with_the_nearest(embedder: str, meant: str) -> None:
    (problem,) = problems(text(embedder))
    assert problem.key == "agents.embedder" and problem.wrong == "is no embedder"
    assert '"ollama:MODEL"' in problem.allowed and problem.nearest == meant
