"""The formats that others rely on: a published JSON schema and an example each, held against the code.

`python -m tests.unit.test_formats` writes the schemas anew.
"""

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter

from gateway.cli.demo_result import DemoResult
from gateway.cli.design_result import DesignResult
from gateway.cli.eval_result import EvalResult
from gateway.cli.identify_result import IdentifyResult
from gateway.cli.rehearse_result import RehearseResult
from gateway.core.audit_export import AuditLine, wrong_in
from gateway.core.controller import ControllerConfig, parse_controller
from gateway.core.experiment import Experiment, parse_experiment
from gateway.core.judge_context import JudgeContext, parse_context
from gateway.core.line_model import LineModel, parse_model
from gateway.core.messages import Command, Event, Reply
from gateway.core.proposal import Proposal, parse_proposal
from gateway.core.scenario import Scenario, scenario_of
from gateway.core.verdict import Verdict
from sim_plant.plant import Plant, plant_of
from tests.bench.figures import BenchResult

DOCS = Path("docs")


def _json(adapter: TypeAdapter[Any]) -> Callable[[bytes], object]:
    return lambda payload: adapter.validate_json(payload)


def _audit(payload: bytes) -> None:
    if wrong := list(wrong_in(payload.splitlines())):
        raise ValueError("; ".join(wrong))


#: name: (schema, how a program reads the example, the example's ending)
FORMATS: dict[str, tuple[TypeAdapter[Any], Callable[[bytes], object], str]] = {
    "controller": (TypeAdapter(ControllerConfig), parse_controller, "json"),
    "line-model": (TypeAdapter(LineModel), parse_model, "json"),
    "plant": (TypeAdapter(Plant), lambda payload: plant_of(tomllib.loads(payload.decode())), "toml"),
    "scenario": (TypeAdapter(Scenario), lambda payload: scenario_of(tomllib.loads(payload.decode())), "toml"),
    "demo-result": (TypeAdapter(DemoResult), _json(TypeAdapter(DemoResult)), "json"),
    "rehearse": (TypeAdapter(RehearseResult), _json(TypeAdapter(RehearseResult)), "json"),
    "design": (TypeAdapter(DesignResult), _json(TypeAdapter(DesignResult)), "json"),
    "identify": (TypeAdapter(IdentifyResult), _json(TypeAdapter(IdentifyResult)), "json"),
    "eval": (TypeAdapter(EvalResult), _json(TypeAdapter(EvalResult)), "json"),
    "bench": (TypeAdapter(BenchResult), _json(TypeAdapter(BenchResult)), "json"),
    "audit-export": (TypeAdapter(AuditLine), _audit, "jsonl"),
    "experiment": (TypeAdapter(Experiment), parse_experiment, "json"),
    "proposal": (TypeAdapter(Proposal), parse_proposal, "json"),
    "judge-context": (TypeAdapter(JudgeContext), parse_context, "json"),
    "verdict": (TypeAdapter(Verdict), _json(TypeAdapter(Verdict)), "json"),
    "command": (TypeAdapter(Command), _json(TypeAdapter(Command)), "json"),
    "reply": (TypeAdapter(Reply), _json(TypeAdapter(Reply)), "json"),
    "event": (TypeAdapter(Event), _json(TypeAdapter(Event)), "json"),
}


def schema_text(name: str) -> str:
    return json.dumps(FORMATS[name][0].json_schema(), indent=2) + "\n"


def schema_path(name: str) -> Path:
    return DOCS / "schemas" / f"{name}.schema.json"


@pytest.mark.parametrize("name", FORMATS)
def test_the_published_schema_is_the_code(name):
    assert schema_path(name).read_text() == schema_text(name), "python -m tests.unit.test_formats writes it anew"


@pytest.mark.parametrize("name", FORMATS)
def test_the_example_is_accepted_and_an_unknown_key_in_it_is_not(name):
    _, read, ending = FORMATS[name]
    payload = (DOCS / "examples" / f"{name}.{ending}").read_bytes()
    read(payload)
    strange = b"colour = 1\n" + payload if ending == "toml" else payload.replace(b"{", b'{"colour": 1, ', 1)
    with pytest.raises(Exception, match="colour"):
        read(strange)


if __name__ == "__main__":
    for format_name in FORMATS:
        schema_path(format_name).write_text(schema_text(format_name))
