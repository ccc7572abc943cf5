"""What doctor makes of the computer it runs on, and how it tells."""

import asyncio
import io
import json
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner

from gateway.cli.doctor_check import Check, counted
from gateway.cli.doctor_clocks import clocks
from gateway.cli.doctor_jitter import Punctuality, judged, lateness_check, measure, percentiles
from gateway.cli.doctor_machine import machine
from gateway.cli.doctor_permissions import permissions
from gateway.cli.doctor_running import judged as judged_status
from gateway.cli.doctor_software import names, software, versions
from gateway.cli.doctor_view import table
from gateway.cli.main import app
from gateway.core.line import Line
from gateway.core.line_template import line_template
from gateway.core.messages import BusReport
from gateway.core.status import GatewayStatus
from gateway.mailbox.listener import Listener
from gateway.mailbox.paths import LOOP_SOCKET
from tests.protocol.driver_support import line

pytestmark = pytest.mark.wires


def only(checks: list[Check], subject: str) -> Check:
    (check,) = (check for check in checks if check.subject == subject)
    return check


# the machine


def put(root: Path, path: str, text: str) -> None:
    file = root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)


def test_a_computer_that_says_nothing_of_itself_is_skipped(tmp_path: Path) -> None:
    checks = list(machine(line(), tmp_path, root=tmp_path / "empty"))
    assert [only(checks, subject).verdict for subject in ("frequency", "swap", "throttling")] == ["skipped"] * 3


@pytest.mark.parametrize(
    ("governors", "verdict"),
    [(["performance", "performance"], "OK"), (["performance", "powersave"], "warning"), (["ondemand"], "warning")],
)
def test_every_governor_counts(tmp_path: Path, governors: list[str], verdict: str) -> None:
    for k, governor in enumerate(governors):
        put(tmp_path, f"sys/devices/system/cpu/cpu{k}/cpufreq/scaling_governor", f"{governor}\n")
    assert only(list(machine(line(), tmp_path, root=tmp_path)), "frequency").verdict == verdict


def test_swap_and_throttling(tmp_path: Path) -> None:
    head = "Filename Type Size Used Priority\n"
    put(tmp_path, "proc/swaps", head)
    put(tmp_path, "sys/devices/system/cpu/cpu0/thermal_throttle/core_throttle_count", "0\n")
    checks = list(machine(line(), tmp_path, root=tmp_path))
    assert only(checks, "swap").verdict == only(checks, "throttling").verdict == "OK"
    put(tmp_path, "proc/swaps", f"{head}/dev/sda2 partition 8000000 250000 -2\n")
    put(tmp_path, "sys/devices/system/cpu/cpu0/thermal_throttle/package_throttle_count", "7\n")
    checks = list(machine(line(), tmp_path, root=tmp_path))
    assert (only(checks, "swap").verdict, only(checks, "swap").measured) == ("warning", "250 MB in use")
    assert (only(checks, "throttling").verdict, only(checks, "throttling").measured[:7]) == ("warning", "7 times")


def test_a_raspberry_pi_that_was_throttled(tmp_path: Path) -> None:
    put(tmp_path, "sys/devices/platform/soc/soc:firmware/get_throttled", "50000\n")
    check = only(list(machine(line(), tmp_path, root=tmp_path)), "throttling")
    assert (check.verdict, check.measured) == ("warning", "flags 0x50000")


def changed(of_line: Line, table: str, **values: object) -> Line:
    return of_line.model_copy(update={table: getattr(of_line, table).model_copy(update=values)})


def test_the_disk_is_held_against_what_will_be_kept(tmp_path: Path) -> None:
    data = tmp_path / "not" / "made"
    assert only(list(machine(changed(line(), "history", keep_gb=1e-6), data)), "disk").verdict == "OK"
    full = only(list(machine(changed(line(), "history", keep_gb=1e9), data)), "disk")
    assert full.verdict in ("warning", "FAIL") and str(tmp_path) in full.measured
    assert not data.exists(), "nothing is made"


def test_a_processor_that_is_not_there(tmp_path: Path) -> None:
    check = only(list(machine(changed(line(), "control", cpu=4000), tmp_path)), "processors")
    assert check.verdict == "FAIL" and "control.cpu" in check.todo


# the clocks


@pytest.mark.parametrize(("state", "verdict"), [(0, "OK"), (1, "OK"), (5, "warning"), (-1, "skipped")])
def test_the_wall_clock_is_never_more_than_a_warning(state: int, verdict: str) -> None:
    checks = list(clocks(adjtimex=lambda: (state, 1500)))
    assert only(checks, "wall clock").verdict == verdict


def test_the_clocks_of_this_computer_can_be_read() -> None:
    checks = list(clocks())
    assert only(checks, "monotonic clock").measured.startswith("step ")
    assert only(checks, "wall clock").verdict in ("OK", "warning", "skipped")


# permissions


def test_folders_that_may_be_used(tmp_path: Path) -> None:
    run, data = tmp_path / "run", tmp_path / "data"
    run.mkdir(mode=0o700)
    checks = list(permissions(line(), run, data))
    assert only(checks, "run folder").verdict == only(checks, "data folder").verdict == "OK"
    assert "not made yet" in only(checks, "data folder").measured and not data.exists()


def test_a_run_folder_that_others_may_write_and_a_file_in_the_place_of_a_folder(tmp_path: Path) -> None:
    run, data = tmp_path / "run", tmp_path / "data"
    run.mkdir()
    run.chmod(0o777)
    data.write_text("")
    checks = list(permissions(line(), run, data / "demo"))
    assert (only(checks, "run folder").verdict, only(checks, "data folder").verdict) == ("FAIL", "FAIL")
    assert "chmod 700" in only(checks, "run folder").todo and "is a file" in only(checks, "data folder").measured


def test_a_can_interface_that_is_not_there(tmp_path: Path) -> None:
    of_line = line(can_bus={"interface": "socketcan", "channel": "can7"})
    assert only(list(permissions(of_line, tmp_path, tmp_path, root=tmp_path)), "CAN can7").verdict == "FAIL"


# software


def test_the_names_belong_to_r2rgate_alone(tmp_path: Path) -> None:
    home = {name: tmp_path / name for name in ("gateway", "drivers", "safety")}
    assert [check.verdict for check in names({"gateway": ["r2rgate"]}, home)] == ["OK"]
    (foreign,) = names({"drivers": ["r2rgate", "other"]}, home)
    assert foreign.verdict == "FAIL" and "uninstall other" in foreign.todo
    (elsewhere,) = names({}, home | {"agents": tmp_path / "site-packages" / "agents"})
    assert elsewhere.verdict == "FAIL" and elsewhere.subject == "import agents"


def test_a_pinned_version_is_held() -> None:
    installed = {"a": "1.0", "b": "2.0"}
    required = ["a[x]==1.0", "b==2.1", "c>=3", "a<2,>=1"]
    checks = list(versions(required, installed.get))
    assert [(check.subject, check.verdict) for check in checks] == [("b", "FAIL"), ("c", "FAIL"), ("libraries", "OK")]


def test_what_is_installed_here_is_as_it_should_be() -> None:
    assert {check.verdict for check in software()} == {"OK"}


# jitter


@pytest.mark.parametrize(
    ("p99_share", "skipped", "verdict"),
    [(0.049, 0, "OK"), (0.05, 0, "warning"), (0.199, 0, "warning"), (0.2, 0, "FAIL"), (0.01, 1, "FAIL")],
)
def test_the_rule_for_lateness(p99_share: float, skipped: int, verdict: str) -> None:
    assert lateness_check("g", 0.01, (0.0, 0.01 * p99_share, 0.01), skipped, 100).verdict == verdict


def test_percentiles() -> None:
    assert percentiles([float(k) for k in range(100, 0, -1)], (0.5, 0.99)) == (51.0, 100.0)
    assert percentiles([7.0], (0.5, 0.99)) == (7.0, 7.0)


def test_what_was_not_granted_is_told_with_what_to_do() -> None:
    refused = Punctuality(
        0, [0, 1], 0, ["no real-time priority: needs CAP_SYS_NICE"], "not permitted", 100, 0, 0.0, 0.0, 0.0
    )
    checks = list(judged(line(), refused))
    assert [check.verdict for check in checks] == ["warning", "warning", "warning", "warning", "OK"]
    assert all(check.todo for check in checks[:4])
    granted = Punctuality(60, [1], 40_000, [], "", 100, 0, 0.0, 0.0, 0.0)
    assert {check.verdict for check in judged(line(), granted)} == {"OK"}


def test_the_loops_own_timer_is_measured_in_a_process_of_its_own() -> None:
    found = asyncio.run(measure(changed(line(), "control", period_s=0.005), 0.1))
    assert found.ticks == 20
    assert 0.0 <= found.p50_s <= found.p99_s <= found.max_s


# the loop's word


def example_status() -> GatewayStatus:
    return GatewayStatus.model_validate_json(Path("docs/examples/status.json").read_bytes())


def test_a_running_line_is_judged_by_what_its_loop_says() -> None:
    status = example_status()
    assert all(check.verdict in ("OK", "warning") or check.subject == "lateness" for check in judged_status(status))
    absent = BusReport(
        name="drives", absent=["drive-2"], timeouts=3, malformed=0, reconnects=0, last_error="no heartbeat"
    )
    spans = [status.spans[0].model_copy(update={"drive": "FAULT", "quality": "BAD", "control": "tension"})]
    bad = status.model_copy(update={"buses": [absent], "spans": spans})
    failed = {check.subject for check in judged_status(bad) if check.verdict == "FAIL"}
    assert failed >= {f"bus {absent.name}", spans[0].roller, spans[0].name}


# how it is told

CHECKS = [
    Check("drives", "drive-1", "identity", "OK", "node 1", "vendor 0x520"),
    Check("drives", "drive-1", "state", "FAIL", "fault, error 8250h", "no fault", "find out why " + 20 * "and so on "),
    Check("clocks", "wall clock", "", "warning", "not synchronised [bold]\x1b[31m", "synchronised", "start chrony"),
    Check("machine", "disk", "", "OK", "80 GB free", "20 GB"),
]


def printed(width: int = 80) -> str:
    out = io.StringIO()
    Console(file=out, width=width, highlight=False).print(table("line.toml", CHECKS))
    return out.getvalue()


def test_in_a_pipe_there_are_80_columns_and_no_colours() -> None:
    text = printed()
    assert "\x1b" not in text and max(map(len, text.splitlines())) <= 80
    assert "[bold]" in text, "what a device says is no markup"


def test_what_is_fine_shares_a_row_and_what_is_not_says_what_to_do() -> None:
    text = printed(200)
    assert "OK      drive-1          identity: node 1" in text
    assert "FAIL    drive-1          state: fault, error 8250h" in text
    assert "wanted: no fault" in text and "-> find out why" in text
    assert "80 GB free (wanted: 20 GB)" in text
    assert "2 OK, 1 warning, 1 FAIL" in text


def test_verdicts_are_counted() -> None:
    assert counted(CHECKS) == {"OK": 2, "warning": 1, "FAIL": 1, "skipped": 0}


# the command


@pytest.fixture
def doctor(tmp_path: Path) -> Callable[..., tuple[int, str]]:
    """`r2rgate doctor` on the template line, whose buses nobody is on."""
    text = line_template(2, "line.toml").replace('"udp_multicast"', '"virtual"').replace("port = 43113", "")
    text = text.replace("port = 5020", "port = 1").replace('"239.74.163.2"', f'"{tmp_path.name}"')
    file = tmp_path / "line.toml"
    file.write_text(text)

    def run(*more: str) -> tuple[int, str]:
        folders = ["--run-dir", str(tmp_path / "run"), "--data-dir", str(tmp_path / "data")]
        result = CliRunner().invoke(app, ["doctor", str(file), "--seconds", "0.2", *folders, *more])
        assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
        return result.exit_code, result.stdout

    return run


def test_a_line_without_devices_fails(doctor: Callable[..., tuple[int, str]]) -> None:
    code, text = doctor("--json")
    document = json.loads(text)
    checks = {(check["subject"], check["name"]): check for check in document["checks"]}
    assert code == 1 and document["ok"] is False
    assert checks["io", ""]["verdict"] == "FAIL" and "ping 127.0.0.1" in checks["io", ""]["todo"]
    assert checks["drive-1", ""]["verdict"] == "FAIL" and "does not answer" in checks["drive-1", ""]["measured"]
    assert checks["load-cell-1", ""]["verdict"] == checks["line-plc", ""]["verdict"] == "skipped"
    assert document["counts"]["FAIL"] == sum(check["verdict"] == "FAIL" for check in document["checks"])
    assert all(check["todo"] for check in document["checks"] if check["verdict"] == "FAIL")


def test_a_line_whose_loop_runs_is_left_alone(doctor: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    listener = Listener(tmp_path / "run" / LOOP_SOCKET)
    try:
        code, text = doctor("--json")
    finally:
        listener.close()
    checks = json.loads(text)["checks"]
    assert {check["verdict"] for check in checks if check["group"] in ("buses", "real time")} == {"skipped"}
    assert not any(check["subject"].startswith(("drive", "io")) for check in checks)
    assert [check["verdict"] for check in checks if check["group"] == "the loop's word"] == ["skipped"]
    assert code == int(any(check["verdict"] == "FAIL" for check in checks))


def test_a_file_that_cannot_be_used(tmp_path: Path) -> None:
    file = tmp_path / "line.toml"
    file.write_text("format = 2")
    result = CliRunner().invoke(app, ["doctor", str(file)])
    assert result.exit_code == 2 and "line.toml:1" in result.stderr
    assert CliRunner().invoke(app, ["doctor", str(tmp_path / "none.toml")]).exit_code == 2
