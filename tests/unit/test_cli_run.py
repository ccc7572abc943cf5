"""`run` and what it looks after: what it says of a child that ends, when it gives up, and what it refuses at once."""

import io
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner

from gateway.cli import tended
from gateway.cli.line_commands import known_maps
from gateway.cli.main import app
from gateway.cli.plant_fit import misfits
from gateway.cli.tended import FIRST_PAUSE_S, LAST_LINES, LONGEST_PAUSE_S, Child, Exit
from gateway.cli.together import EXIT_S, NOTES_S, Notices, new_recording, run_together
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.line_template_wiring import Wiring
from gateway.mailbox.listener import Listener
from gateway.mailbox.paths import LOOP_SOCKET
from sim_plant.plant import load_plant

ROOT = Path(__file__).parents[2]
PLANT = ROOT / "sim_plant" / "plants" / "s_real.toml"
TEXT = line_template(6)

Scripts = dict[str, str]
WAITS = "import signal; signal.sigwait([signal.SIGTERM])"


@pytest.fixture
def scripts(monkeypatch: pytest.MonkeyPatch) -> Iterator[Scripts]:
    """In place of r2rgate's processes: a line of Python for each child, by its name; it finds its arguments in argv."""
    playing: Scripts = {"agents": WAITS, "operator": WAITS}
    begun: list[subprocess.Popen[str]] = []

    def start(arguments: list[str], log: Path) -> subprocess.Popen[str]:
        with log.open("a") as sink:
            code = [sys.executable, "-c", playing[arguments[0]], *arguments[1:]]
            begun.append(subprocess.Popen(code, stdout=sink, stderr=sink, text=True))
        return begun[-1]

    monkeypatch.setattr(tended, "start", start)
    before = [(number, signal.getsignal(number)) for number in (signal.SIGINT, signal.SIGTERM)]
    yield playing
    for number, handler in before:
        signal.signal(number, handler)
    for process in begun:
        process.kill()
        process.wait()


def ended(child: Child, at_s: float) -> Exit:
    """Start the child, wait for its end, and look again."""
    assert child.tend(at_s) is None
    process = child._process  # noqa: SLF001
    assert process is not None
    process.wait(10.0)
    found = child.tend(at_s)
    assert found is not None
    return found


def test_an_exit_is_told_with_code_and_the_last_words_of_this_start(scripts: Scripts, tmp_path: Path) -> None:
    log = tmp_path / "loop.log"
    log.write_text("words of an earlier start\n")
    child = Child("loop", list, log)
    scripts["loop"] = "print('tab\\there'); raise SystemExit(7)"
    first = ended(child, 100.0)
    assert (first.code, first.is_final) == (7, False)
    assert first.lines() == [
        "loop has ended with exit code 7; it is started again",
        f"  the end of {log}:",
        "    tab    here",
    ]
    scripts["loop"] = "import os; [print(i, flush=True) for i in range(50)]; os.kill(os.getpid(), 9)"
    second = ended(child, 101.0)
    assert second.headline() == "loop was killed by SIGKILL, 2 times by now; it is started again"
    assert second.tail == [str(i) for i in range(50)][-LAST_LINES:]


@pytest.mark.parametrize(("code", "final"), [(0, False), (1, False), (2, True), (3, True), (-9, False)])
def test_only_what_a_start_cannot_mend_is_final(code: int, final: bool, tmp_path: Path) -> None:
    assert Exit("loop", code, 1, 0.0, tmp_path, []).is_final is final


def test_pauses_grow_to_a_limit_and_shrink_after_a_long_life(scripts: Scripts, tmp_path: Path) -> None:
    child = Child("loop", list, tmp_path / "loop.log")
    scripts["loop"] = "raise SystemExit(1)"
    now_s, pause_s = 100.0, FIRST_PAUSE_S
    for _ in range(7):
        ended(child, now_s)
        assert child.tend(now_s + 0.99 * pause_s) is None
        assert child._process is None  # noqa: SLF001
        now_s, pause_s = now_s + pause_s, min(2.0 * pause_s, LONGEST_PAUSE_S)
    scripts["loop"] = WAITS
    assert child.tend(now_s) is None
    assert child.tend(now_s + LONGEST_PAUSE_S + 1.0) is None
    assert child._pause_s == FIRST_PAUSE_S  # noqa: SLF001


def run(folder: Path, plant: Path | None = None) -> int:
    line = load_line(TEXT, "line.toml")
    return run_together(folder / "line.toml", line, folder / "c.json", plant, folder, folder)


@pytest.mark.parametrize("code", [2, 3])
def test_a_refused_child_ends_all_with_its_words_and_its_code(
    code: int, scripts: Scripts, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rests = tmp_path / "rests"
    # The gateway refuses as soon as the loop is up; the loop notes that it was brought to rest.
    scripts["loop"] = (
        "import signal, sys, pathlib; signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM]);"
        f"pathlib.Path({str(tmp_path / 'up')!r}).touch(); signal.sigwait([signal.SIGTERM]);"
        f"pathlib.Path({str(rests)!r}).touch()"
    )
    scripts["gateway"] = (
        f"import pathlib\nwhile not pathlib.Path({str(tmp_path / 'up')!r}).exists(): pass\n"
        f"print('no such thing'); raise SystemExit({code})"
    )
    assert run(tmp_path) == code
    told = capsys.readouterr().err
    assert (
        f"gateway has ended with exit code {code}\n  the end of {tmp_path / 'logs' / 'gateway.log'}:\n    no such thing"
        in told
    )
    assert rests.exists()


@pytest.mark.parametrize("name", ["agents", "operator"])
@pytest.mark.parametrize("code", [2, 3])
def test_what_the_line_does_without_is_told_when_it_is_refused_and_ends_nothing(
    code: int, name: str, scripts: Scripts, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scripts["gateway"] = scripts["loop"] = WAITS
    # The first start is refused, the second asks the parent to end, as Ctrl-C does.
    scripts[name] = (
        "import os, pathlib, signal\n"
        f"again = pathlib.Path({str(tmp_path / 'again')!r})\n"
        "if again.exists():\n    os.kill(os.getppid(), signal.SIGINT); signal.sigwait([signal.SIGTERM])\n"
        f"again.touch(); raise SystemExit({code})"
    )
    assert run(tmp_path) == 0
    assert f"{name} has ended with exit code {code}; it is started again\n" in capsys.readouterr().err


def test_a_crash_is_told_and_the_child_comes_back(
    scripts: Scripts, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scripts["gateway"] = WAITS
    # The first start crashes, the second asks the parent to end, as Ctrl-C does.
    scripts["loop"] = (
        "import os, pathlib, signal\n"
        f"again = pathlib.Path({str(tmp_path / 'again')!r})\n"
        "if again.exists():\n    os.kill(os.getppid(), signal.SIGINT); signal.sigwait([signal.SIGTERM])\n"
        "again.touch(); raise ValueError('no luck')"
    )
    assert run(tmp_path) == 0
    told = capsys.readouterr().err
    assert "loop has ended with exit code 1; it is started again\n" in told
    assert "    ValueError: no luck" in told
    assert told.count("has ended") == 1


def test_each_start_of_the_simulated_line_records_into_a_folder_of_its_own(scripts: Scripts, tmp_path: Path) -> None:
    scripts["gateway"] = scripts["loop"] = WAITS
    scripts["sim"] = (
        "import os, pathlib, signal, sys\n"
        "pathlib.Path(sys.argv[3]).mkdir(parents=True); print('open', flush=True)\n"
        f"if len(list(pathlib.Path({str(tmp_path / 'sim')!r}).glob('recording-*'))) < 3: raise SystemExit(1)\n"
        "os.kill(os.getppid(), signal.SIGINT); signal.sigwait([signal.SIGTERM])"
    )
    assert run(tmp_path, PLANT) == 0
    assert len(list(tmp_path.glob("sim/recording-*"))) == 3


def test_recordings_of_one_second_differ(tmp_path: Path) -> None:
    names = {new_recording(tmp_path) for _ in range(2)}
    for name in names:
        name.mkdir()
    assert new_recording(tmp_path) not in names


def test_the_screen_shows_what_was_not_granted_at_first_and_an_exit_for_longer(tmp_path: Path) -> None:
    notices = Notices(Console(force_terminal=True), 100.0, ["designed anew"])
    refused = "memory not locked: needs CAP_IPC_LOCK"
    notices.hear(["loop of demo/line-1 is SILENT", "pinned to processor 1; memory locked", refused], 101.0)
    assert notices.lines(101.0) == ["designed anew", f"loop: {refused}"]
    notices.tell(Exit("sim", 1, 4, 100.0 + NOTES_S, tmp_path / "sim.log", ["KeyError: 1"]))
    headline = "sim has ended with exit code 1, 4 times by now; it is started again"
    later_s = 100.0 + NOTES_S + 1.0
    assert notices.lines(later_s) == [headline, f"  the end of {tmp_path / 'sim.log'}:", "    KeyError: 1"]
    assert notices.lines(later_s + EXIT_S) == [f"{headline} (1 min ago; {tmp_path / 'sim.log'})"]


def test_the_screen_shows_where_people_reach_the_line_and_where_they_do_not(tmp_path: Path) -> None:
    notices = Notices(Console(force_terminal=True), 100.0)
    page, opcua = "page at http://127.0.0.1:8480", "OPC UA at opc.tcp://127.0.0.1:4840"
    said = [f"no {opcua}, it is tried again every 10 s: Address already in use", f"operator of demo/line-1: {page}"]
    notices.hear_of_operator(said, 150.0)
    notices.hear_of_operator(said, 150.2)
    assert notices.lines(151.0) == [f"no {opcua}, {page}", f"operator: {said[0]}"]
    assert notices.lines(150.1 + NOTES_S) == [f"no {opcua}, {page}"]  # why is told for a while
    said = [*said, f"{opcua} now"]
    notices.hear_of_operator(said, 180.0)
    assert notices.lines(180.1) == [f"{opcua}, {page}"]
    notices.hear_of_operator([*said, said[0]], 190.0)
    assert notices.lines(190.1)[0] == f"no {opcua}, {page}"
    nobody = "nobody can come in yet: `r2rgate users add LINE.toml NAME --role ROLE` lets somebody"
    notices.hear_of_operator([*said, said[0], nobody], 191.0)
    assert f"operator: {nobody}" in notices.lines(191.0 + 10.0 * NOTES_S)
    notices.hear_of_operator([*said, said[0], nobody, "somebody can come in now"], 192.0)
    assert not any("can come in" in text for text in notices.lines(192.0))
    notices.tell(Exit("operator", 2, 1, 220.0, tmp_path / "operator.log", ["there is neither"], is_needed=False))
    assert notices.lines(221.0)[0] == "operator has ended with exit code 2; it is started again"
    notices.hear_of_operator([f"operator of demo/line-1: {page}, {opcua}"], 222.0)
    assert notices.lines(222.0)[0] == f"{page}, {opcua}"


def test_without_a_terminal_each_is_printed_once(capsys: pytest.CaptureFixture[str]) -> None:
    notices = Notices(Console(force_terminal=False), 100.0)
    for now_s in (101.0, 102.0):
        notices.hear(["no real-time help granted"], now_s)
    notices.hear(["no real-time help granted", "too late to matter"], 100.0 + NOTES_S + 1.0)
    assert capsys.readouterr().err == "loop: no real-time help granted\n"


def test_a_plant_that_does_not_fit_is_named_with_the_line() -> None:
    plant, file = load_plant(PLANT), Path("line.toml")
    assert misfits(load_line(TEXT, "line.toml"), file, plant, PLANT) == []
    small = load_line(line_template(4), "line.toml")
    assert misfits(small, file, plant, PLANT) == [f"line.toml has 4 spans, {PLANT} has 6 spans"]
    other = load_line(TEXT.replace("43113", "43114").replace("5020", "5021"), "line.toml")
    assert misfits(other, file, plant, PLANT) == [
        "line.toml has drive-1 to drive-6 on udp_multicast 239.74.163.2 port 43114, "
        f"{PLANT} on udp_multicast 239.74.163.2 port 43113 (for the plant to fit: [wires.canopen] "
        'interface = "udp_multicast" channel = "239.74.163.2" port = 43114)',
        f"line.toml has load-cell-1 to line-plc on Modbus TCP port 5021, {PLANT} on Modbus TCP port 5020 "
        "(for the plant to fit: [wires.modbus] port = 5021)",
    ]
    opcua = load_line(line_template(6, "line.toml", Wiring(plc="opcua")), "line.toml")
    assert misfits(opcua, file, plant, PLANT) == [
        f"line.toml has line-plc on OPC UA port 4840, {PLANT} on Modbus TCP port 5020 "
        '(for the plant to fit: [wires] plc = "opcua")'
    ]
    mixed = PLANT.with_name("mixed.toml")
    assert misfits(opcua, file, load_plant(mixed), mixed) == []
    text = line_template(6, "line.toml", Wiring(drives="rack", load_cells="rack", plc="rack"))
    found = misfits(load_line(text, "line.toml", known_maps()), file, plant, PLANT)
    assert '(for the plant to fit: [wires] drives = "rack")' in found[0]


@pytest.fixture
def line_file(tmp_path: Path) -> Path:
    path = tmp_path / "a line.toml"
    path.write_text(TEXT, encoding="utf-8")
    return path


def refused(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 2, result.output
    assert len(result.output.splitlines()) == 1
    return result.output


@pytest.mark.parametrize("where", ["file", "proc"])
def test_places_that_cannot_be_written_are_refused_in_one_sentence(where: str, line_file: Path, tmp_path: Path) -> None:
    bad = line_file / "x" if where == "file" else Path("/proc/r2rgate-nowhere")
    good = tmp_path / "good"
    for command in ("run", "gateway"):
        said = refused(command, line_file, "--data-dir", bad, "--run-dir", good)
        assert f"the folder {bad}/" in said and "cannot be used" in said and "--data-dir" in said
    said = refused("run", line_file, "--data-dir", good, "--run-dir", bad)
    assert f"the folder {bad} cannot be used" in said and "--run-dir" in said
    assert str(bad) in refused("gateway", line_file, "--data-dir", good, "--run-dir", bad)
    assert f"the folder {bad} cannot be used" in refused("demo", "--out", bad)
    assert f"--out {bad / 'c.json'} cannot be written" in refused("design", line_file, "--out", bad / "c.json")


def test_design_makes_the_folder_and_suggestions_can_be_pasted(line_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "new one" / "c.json"
    said = refused("loop", line_file, "--controller", out)
    assert f"r2rgate design '{line_file}' --out '{out}' writes one" in said
    assert (
        CliRunner().invoke(app, ["design", str(line_file), "--law", "lqi", "--untuned", "--out", str(out)]).exit_code
        == 0
    )
    assert out.exists()


def test_run_refuses_a_plant_that_does_not_fit(line_file: Path, tmp_path: Path) -> None:
    line_file.write_text(line_template(4), encoding="utf-8")
    said = refused("run", line_file, "--plant", PLANT, "--data-dir", tmp_path, "--run-dir", tmp_path)
    assert said.startswith(f"line and plant do not fit: {line_file} has 4 spans, {PLANT} has 6 spans")
    assert "cannot be read" in refused("run", line_file, "--plant", tmp_path / "none.toml")


def test_run_starts_nothing_where_the_line_runs_already(line_file: Path, tmp_path: Path) -> None:
    listener = Listener(tmp_path / LOOP_SOCKET)
    try:
        result = CliRunner().invoke(
            app, ["run", str(line_file), "--run-dir", str(tmp_path), "--data-dir", str(tmp_path / "data")]
        )
    finally:
        listener.close()
    assert result.exit_code == 3
    assert "a loop of this line runs already" in result.output
    assert not (tmp_path / "data").exists()


def test_a_controller_that_does_not_fit_ends_run_with_the_loops_sentence(line_file: Path, tmp_path: Path) -> None:
    """All of it for real: the loop refuses, `run` ends with its words and its code."""
    small = tmp_path / "small.toml"
    small.write_text(line_template(1), encoding="utf-8")
    controller = tmp_path / "c.json"
    assert (
        CliRunner().invoke(app, ["design", str(small), "--law", "lqi", "--untuned", "--out", str(controller)]).exit_code
        == 0
    )
    before = controller.read_bytes()
    folders = ["--run-dir", tmp_path / "r", "--data-dir", tmp_path / "d"]
    command = [sys.executable, "-m", "gateway.cli", "run", line_file, "--controller", controller, *folders]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, env=os.environ)
    assert result.returncode == 2, result.stderr
    assert "loop has ended with exit code 2" in result.stderr
    assert "it is for 1 span, the line has 6" in result.stderr
    assert controller.read_bytes() == before


def test_run_says_how_faults_are_asked_of_its_simulated_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    notices = Notices(Console(file=io.StringIO()), 100.0)
    notices.hear_of_sim(["warming up"])
    for _ in range(2):
        notices.hear_of_sim(['{"ready": true, "control": "/data/a line/recording-1/control.sock"}'])
    notices.hear_of_sim(['{"ready": true, "control": null}'])
    said = capsys.readouterr().err
    assert said.count("fault inject --control '/data/a line/recording-1'") == 1
    assert notices.lines(101.0) == said.splitlines()
