"""`r2rgate experiment`: what is designed can be run, what is run is followed to its end, and what is wrong is said."""

import asyncio
import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gateway.cli import experiment_commands
from gateway.cli.experiment_run import follow_on
from gateway.cli.main import app
from gateway.core.experiment import Abort, Experiment, Leg, parse_experiment
from gateway.core.line_template import line_template
from gateway.core.messages import AbortExperiment, parse_command
from gateway.core.status import EventStatus, GatewayStatus
from gateway.loop.pacer import Tick
from gateway.loop.runner import Runner
from gateway.mailbox.port import Unreachable
from tests.closed_loop.conftest import stepped
from tests.closed_loop.test_experiment import producing
from tests.support.gateway_key import door_of, signer_of

EXAMPLE = Path("docs/examples/experiment.json")
SHORT = Experiment(
    format=1,
    amplitude_n=[1.0] * 6,
    dwell_s=0.1,
    legs=[Leg(duration_s=2.0)],
    abort=Abort(deviation_n=10.0, saturated_share=0.9, reversal_share=0.9),
)


class Beside:
    """A gateway beside a loop in stepped time, whose clock is the waiting of whoever asks."""

    def __init__(self, loop):
        self.loop = loop
        self.status_text = json.loads(Path("docs/examples/status.json").read_text())
        self.running = self.tells = True
        self.then = {}  #: what happens after so many looks
        self.looks = 0

    async def status(self):
        told = [EventStatus(wall_s=100.0 + self.loop.now_s, kind=kind, text=text) for kind, text in self.loop.told]
        told = told if self.tells else []
        old = EventStatus(wall_s=1.0, kind="experiment-end", text="an old one")
        document = self.status_text | {"wall_s": 100.0, "events": [e.model_dump() for e in [old, *told][-20:]]}
        document["loop"]["running"] = self.running
        return GatewayStatus.model_validate_json(json.dumps(document))

    async def request(self, command):
        return self.loop.command(command)

    async def sleep(self, seconds):
        self.looks += 1
        self.then.get(self.looks, lambda: None)()
        self.loop.step(round(seconds / 0.01))


def followed(beside):
    shown = []
    return asyncio.run(follow_on(beside, SHORT, shown.append, beside.sleep)), shown


def test_a_run_is_followed_to_its_end():
    ended, shown = followed(Beside(producing()))
    assert ended.complete and "complete" in ended.text
    assert ended.history == json.loads(Path("docs/examples/status.json").read_text())["historian"]["path"]
    assert shown[0].startswith("experiment experiment runs for 2 s")
    assert "experiment experiment: 50 %" in shown


def test_an_abort_and_a_refusal_are_told():
    beside = Beside(producing())
    beside.then[3] = lambda: beside.loop.command(AbortExperiment())
    ended, _ = followed(beside)
    assert not ended.complete and ended.begun and "operator's abort" in ended.text
    ended, _ = followed(Beside(stepped()))
    assert not ended.complete and not ended.begun and "needs a running line" in ended.text


def test_a_loop_that_is_gone_and_an_end_that_is_never_told_are_said():
    beside = Beside(producing())
    beside.then[2] = lambda: setattr(beside, "running", False)
    with pytest.raises(Unreachable, match="the loop does not run any more; whether the experiment goes on"):
        followed(beside)
    silent = Beside(producing())
    silent.tells = False
    with pytest.raises(Unreachable, match="no end was told 10 s after it was due"):
        followed(silent)


def test_the_loops_socket_takes_an_experiment_as_json():
    loop = producing()
    given = json.dumps({"command": "experiment", "experiment": json.loads(EXAMPLE.read_text())}).encode()
    command = parse_command(given)

    async def story():
        runner = Runner(loop.cycle)
        door = door_of(runner, loop.line, loop.cycle.clock)
        payload = signer_of(loop.line, loop.cycle.clock).sealed(command, door.nonce)
        answer = asyncio.ensure_future(door.command(payload))
        while not answer.done():
            await runner.period(Tick(loop.now_s + 0.01, loop.now_s + 0.01, 0))
            await asyncio.sleep(0.001)
        door.close()
        return json.loads(answer.result())

    reply = asyncio.run(story())
    assert reply["ok"], reply
    assert loop.cycle.experiments.run is not None


@pytest.mark.slow
def test_the_example_is_what_design_writes_today(tmp_path):
    line = tmp_path / "line.toml"
    line.write_text(line_template(6, "line.toml"))
    out = tmp_path / "experiment.json"
    arguments = ["experiment", "design", str(line), "--data-dir", str(tmp_path), "--out", str(out)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    written, example = parse_experiment(out.read_bytes()), parse_experiment(EXAMPLE.read_bytes())
    assert written.model_copy(update={"abort": example.abort}) == example
    assert written.abort.deviation_n == pytest.approx(example.abort.deviation_n, rel=0.05)
    for word in ("amplitude: 0.5 N", "dwell: 100 ms", "duration:", "speeds:", "foreseen", "it ends itself when"):
        assert word in result.output
    line.write_text(line_template(2, "line.toml"))
    result = CliRunner().invoke(app, [*arguments, "--json", "--recipe", "velocity"])
    assert json.loads(result.output)["expected_half_widths"]["stiffness_per_length"] < 0.005


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--recipe", "paper"), "there is no recipe 'paper'; known: tension, velocity"),
        (("--speed", "0.5"), "legs at 0.5 m/s; allowed: above 0, to 0.12 m/s"),
        (("--controller", "nowhere.json"), "there is no controller configuration at nowhere.json"),
    ],
)
def test_what_cannot_be_designed_is_refused_in_one_sentence(arguments, said, tmp_path):
    line = tmp_path / "line.toml"
    line.write_text(line_template(6, "line.toml"))
    out = tmp_path / "experiment.json"
    command = ["experiment", "design", str(line), "--data-dir", str(tmp_path), "--out", str(out), *arguments]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 2 and said in result.output and not out.exists()


def test_what_is_no_experiment_is_not_sent(tmp_path, monkeypatch):
    file = tmp_path / "experiment.json"
    file.write_text('{"format": 1, "dwell": 1}')
    result = CliRunner().invoke(app, ["experiment", "run", str(file), "--run-dir", str(tmp_path)])
    assert result.exit_code == 2 and "dwell_s: Field required" in result.output
    file.write_bytes(EXAMPLE.read_bytes())
    result = CliRunner().invoke(app, ["experiment", "run", str(file), "--run-dir", str(tmp_path)])
    assert result.exit_code == experiment_commands.UNREACHABLE and "r2rgate gateway" in result.output


def test_the_loops_help_says_what_simulated_means():
    result = CliRunner().invoke(app, ["loop", "--help"])
    assert "--simulated" in result.output


def test_run_says_simulated_only_of_the_line_that_it_starts(monkeypatch, tmp_path):
    from gateway.cli import together

    class Tended:
        def __init__(self, name, arguments, log, is_needed=True):
            self.name = name
            seen[name] = arguments()

        def end(self, patience_s):
            ended.append(self.name)

    def stop(children, notices):
        raise InterruptedError

    for plant in (None, Path("plant.toml")):
        seen, ended = {}, []
        monkeypatch.setattr(together, "Child", Tended)
        monkeypatch.setattr(together, "_tend", stop)
        monkeypatch.setattr(together, "_Ending", lambda: type("Ending", (), {"asked": False})())
        line = producing().line
        with pytest.raises(InterruptedError):
            together.run_together(tmp_path / "line.toml", line, tmp_path / "c.json", plant, tmp_path, tmp_path)
        assert ("--simulated" in seen["loop"]) == (plant is not None)
        assert ended[0] == "loop" and len(ended) == len(seen)  # the line stops before anything else is waited for
