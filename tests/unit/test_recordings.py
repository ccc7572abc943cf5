"""Recordings into files and back, exactly; and files that are none, refused with the place."""

import csv
import io
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from typer.testing import CliRunner

from gateway.cli import recordings_export
from gateway.cli.recordings import read_recording, recording_of_history
from gateway.cli.recordings_csv import read_csv, write_csv
from gateway.cli.recordings_export import export
from gateway.cli.recordings_mcap import TOPIC, read_mcap, schema, write_mcap
from gateway.cli.recordings_table import RecordingRefused, heads
from gateway.core.recording import ARRAYS, Recording, recording_of
from gateway.core.signals import DriveState, Quality
from gateway.core.states import LoopState, Phase
from gateway.core.telemetry import frame_dtype
from tests.unit.supervisor_support import frame_of
from tests.unit.test_historian import WALL_AHEAD_S, writer_of

FINITE = st.floats(allow_nan=False, allow_infinity=False)
VALUE = st.one_of(FINITE, st.just(float("nan")))


@st.composite
def recordings(draw: st.DrawFn) -> Recording:
    n, k = draw(st.integers(1, 3)), draw(st.integers(2, 4))

    def array(value: st.SearchStrategy[float], *shape: int) -> NDArray[np.float64]:
        count = int(np.prod(shape))
        return np.array(draw(st.lists(value, min_size=count, max_size=count))).reshape(shape)

    return Recording(
        time_s=array(FINITE, k),
        tension_n=array(VALUE, k, n),
        tension_setpoint_n=array(VALUE, k, n),
        speed_m_per_s=array(VALUE, k, n),
        torque_nm=array(VALUE, k, n),
        torque_actual_nm=array(VALUE, k, n),
        unwind_speed_m_per_s=array(VALUE, k),
        controlled=np.array(draw(st.lists(st.booleans(), min_size=k, max_size=k))),
        period_s=draw(st.floats(1e-4, 10.0)),
        source="of a test",
    )


def same(a: Recording, b: Recording) -> bool:
    """To the bit, but for which NaN it is."""

    def equal(x: NDArray[np.float64], y: NDArray[np.float64]) -> bool:
        signs = np.signbit(x[~np.isnan(x)]) == np.signbit(y[~np.isnan(y)])
        return x.dtype == y.dtype and np.array_equal(x, y, equal_nan=True) and bool(signs.all())

    arrays = [name for name in ARRAYS if name != "controlled"]
    return (
        all(equal(getattr(a, name), getattr(b, name)) for name in arrays)
        and np.array_equal(a.controlled, b.controlled)
        and a.period_s == b.period_s
    )


def csv_text(recording: Recording) -> str:
    target = io.StringIO()
    write_csv(recording, target)
    return target.getvalue()


def small(spans: int = 2, samples: int = 3) -> Recording:
    frames = np.zeros(samples, frame_dtype(spans))
    frames["time_s"] = 10.0 + 0.01 * np.arange(samples)
    frames["tension_n"] = 20.0 + np.arange(spans)
    frames["tension_quality"] = Quality.GOOD
    frames["state"] = LoopState.RUN
    return recording_of(frames, 0.01, "small")


def test_what_the_proof_of_the_wiring_does_is_not_under_control() -> None:
    frames = np.zeros(3, frame_dtype(2))
    frames["state"] = LoopState.RUN
    frames["phase"] = (Phase.RUNNING, Phase.PROVING, Phase.TENSIONING)
    assert recording_of(frames, 0.01, "small").controlled.tolist() == [True, False, True]


@settings(max_examples=60)
@given(recordings())
def test_csv_gives_back_exactly_what_it_was_given(
    tmp_path_factory: pytest.TempPathFactory, recording: Recording
) -> None:
    path = tmp_path_factory.mktemp("csv") / "a.csv"
    path.write_text(csv_text(recording), encoding="utf-8")
    found = read_recording(path)
    assert same(found, recording) and found.source == "a.csv"


@settings(max_examples=60)
@given(recordings())
def test_mcap_gives_back_exactly_what_it_was_given(
    tmp_path_factory: pytest.TempPathFactory, recording: Recording
) -> None:
    pytest.importorskip("mcap")
    path = tmp_path_factory.mktemp("mcap") / "a.mcap"
    with path.open("wb") as target:
        write_mcap(recording, target)
    found = read_recording(path)
    assert same(found, recording) and found.source == "a.mcap"


@given(st.permutations(heads(2)))
def test_columns_stand_in_any_order(tmp_path_factory: pytest.TempPathFactory, order: list[str]) -> None:
    rows = list(csv.reader(csv_text(small()).splitlines()[1:]))
    place = [rows[0].index(name) for name in order]
    path = tmp_path_factory.mktemp("csv") / "a.csv"
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([[row[k] for k in place] for row in rows])
    assert same(read_csv(path, 0.01), small())


def test_another_loggers_file_needs_no_more_than_speeds_and_torques(tmp_path: Path) -> None:
    path = tmp_path / "theirs.csv"
    path.write_text("time_s,speed_1_m_per_s,torque_1_nm,unwind_speed_m_per_s\r\n0,1e-1,20,0.1\r\n0.01,,21,0.1\r\n")
    found = read_csv(path)
    assert found.n == 1 and found.period_s == 0.01 and found.controlled.all()
    assert np.isnan(found.tension_n).all() and np.isnan(found.speed_m_per_s[1, 0])
    assert found.torque_nm[:, 0].tolist() == [20.0, 21.0]


HEADER = "time_s,tension_1_n,speed_1_m_per_s,torque_1_nm,unwind_speed_m_per_s,controlled"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", ["empty"]),
        (HEADER, ["0 samples"]),
        (f"{HEADER}\n0,1,1,1,1,1", ["1 samples"]),
        (HEADER.replace("tension_1_n", "tension_1_N") + "\n", ["line 1", "column 2", "'tension_1_N'", "tension_1_n?"]),
        (HEADER.replace("tension_1_n", "tensoin_1_n") + "\n", ["column 2", "mean tension_1_n?"]),
        (HEADER.replace("torque_1_nm", "torque_nm_1") + "\n", ["column 4", "mean torque_1_nm?"]),
        (HEADER.replace("speed_1_m_per_s", "speed_1_rpm") + "\n", ["column 3", "'speed_1_rpm'", "speed_K_m_per_s"]),
        (HEADER.replace("tension_1_n", "temperature") + "\n", ["column 2", "allowed are time_s"]),
        (HEADER.replace("tension_1_n", "time_s") + "\n", ["column 2", "time_s is there twice", "column 1"]),
        (HEADER.replace("torque_1_nm,", "") + "\n", ["needed for 1 spans and missing: torque_1_nm"]),
        (HEADER.replace("torque_1_nm", "torque_2_nm") + "\n", ["2 spans", "speed_2_m_per_s, torque_1_nm"]),
        (HEADER.replace(",", ";") + "\n", ["line 1", "divided by commas"]),
        (f"{HEADER}\n0,1,1,1,1,1\n0.01,1,1,1,1", ["line 3", "5 cells, the header 6"]),
        (f"{HEADER}\n0,1,1,1,1,1\n0.01,1,fast,1,1,1", ["line 3, column speed_1_m_per_s", "'fast'", "be a number"]),
        (f"{HEADER}\n0,1,inf,1,1,1\n", ["line 2, column speed_1_m_per_s", "'inf'"]),
        (f"{HEADER}\n0,1,1_0,1,1,1\n", ["line 2, column speed_1_m_per_s", "'1_0'"]),
        (f"{HEADER}\n,1,1,1,1,1\n", ["line 2, column time_s", "is empty"]),
        (f"{HEADER}\n0,1,1,1,1,RUN\n", ["line 2, column controlled", "'RUN'", "0 or 1"]),
        (f"# period_s = 0\n{HEADER}\n", ["line 1", "period_s is '0'", "above 0"]),
        (f"# period_s = ten\n{HEADER}\n", ["line 1", "'ten'"]),
        (f'{HEADER}\n0,"1,1,1,1,1\n', ["no CSV"]),
    ],
)  # fmt: skip
def test_a_csv_that_is_none_is_refused_with_the_place(tmp_path: Path, text: str, expected: list[str]) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(RecordingRefused) as refused:
        read_csv(path)
    assert "bad.csv" in str(refused.value)
    for part in expected:
        assert part in str(refused.value)


def test_what_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.csv"
    path.write_bytes(b"time_s,\xff\xfe")
    with pytest.raises(RecordingRefused, match=r"byte 7 is no UTF-8"):
        read_csv(path)
    with pytest.raises(RecordingRefused, match=r"should end in .csv or .mcap"):
        read_recording(tmp_path / "a.xlsx")
    with pytest.raises(RecordingRefused, match="No such file"):
        read_recording(tmp_path / "absent.csv")


@settings(max_examples=80)
@given(st.integers(0, 600), st.sampled_from(list('0;x,\n"#-')))
def test_a_spoiled_csv_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, place: int, sign: str) -> None:
    text = csv_text(small())
    path = tmp_path_factory.mktemp("csv") / "a.csv"
    path.write_text(text[: place % len(text)] + sign + text[place % len(text) + 1 :])
    try:
        read_csv(path)
    except RecordingRefused as refused:
        assert "a.csv" in str(refused)


def mcap_of(path: Path, messages: list[bytes], topic: str = TOPIC, metadata: dict[str, str] | None = None) -> Path:
    from mcap.writer import Writer

    with path.open("wb") as target:
        writer = Writer(target)
        writer.start()
        channel = writer.register_channel(topic=topic, message_encoding="json", schema_id=0)
        if metadata is not None:
            writer.add_metadata("r2rgate.recording", metadata)
        for k, data in enumerate(messages):
            writer.add_message(channel, k, data, k)
        writer.finish()
    return path


def message(**changes: object) -> bytes:
    each = dict.fromkeys(("tension_n", "tension_setpoint_n", "speed_m_per_s", "torque_nm", "torque_actual_nm"), [1.0])
    return json.dumps({"time_s": 1.0, "unwind_speed_m_per_s": 0.1, "controlled": True, **each, **changes}).encode()


@pytest.mark.parametrize(
    ("messages", "expected"),
    [
        ([message()], ["1 samples"]),
        ([message(), b"{"], ["message 2", "no JSON"]),
        ([message(), b"[]"], ["message 2", "an object"]),
        ([message(), message(extra=1)], ["message 2", "not known here: extra"]),
        ([message(), b"{}"], ["message 2", "missing: controlled"]),
        ([message(), message(speed_m_per_s=[1.0, 2.0])], ["message 2, speed_m_per_s", "a list of 1 numbers"]),
        ([message(), message(torque_nm=["1"])], ["message 2, torque_nm"]),
        ([message(), message(torque_nm=[True])], ["message 2, torque_nm"]),
        ([message(), message(time_s=None)], ["message 2, time_s"]),
        ([message(), message(controlled=1)], ["message 2, controlled"]),
        ([message(speed_m_per_s=[]), message()], ["message 1, speed_m_per_s", "1 to 60"]),
    ],
)
def test_an_mcap_that_is_none_is_refused_with_the_place(
    tmp_path: Path, messages: list[bytes], expected: list[str]
) -> None:
    pytest.importorskip("mcap")
    with pytest.raises(RecordingRefused) as refused:
        read_mcap(mcap_of(tmp_path / "bad.mcap", messages))
    assert all(part in str(refused.value) for part in ["bad.mcap", *expected])


def test_an_mcap_of_others_or_damaged_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    with pytest.raises(RecordingRefused, match=r"no topic /r2rgate/recording; its topics: /camera"):
        read_mcap(mcap_of(tmp_path / "a.mcap", [b""], "/camera"))
    with pytest.raises(RecordingRefused, match="format '2'"):
        read_mcap(mcap_of(tmp_path / "b.mcap", [message()], metadata={"format": "2"}))
    with pytest.raises(RecordingRefused, match="period_s is '-1'"):
        read_mcap(mcap_of(tmp_path / "c.mcap", [message()] * 2, metadata={"format": "1", "period_s": "-1"}))
    (tmp_path / "d.mcap").write_bytes(b"no MCAP at all")
    with pytest.raises(RecordingRefused, match="d.mcap"):
        read_mcap(tmp_path / "d.mcap")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
def test_a_file_that_was_cut_is_refused(tmp_path: Path, share: float) -> None:
    pytest.importorskip("mcap")
    path = tmp_path / "cut.mcap"
    with path.open("wb") as target:
        write_mcap(small(samples=50), target)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(RecordingRefused, match="cut.mcap"):
        read_mcap(path)


def test_every_message_is_as_its_schema_says(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    from mcap.reader import make_reader

    path = tmp_path / "a.mcap"
    recording = replace(small(), tension_n=np.full((3, 2), np.nan))
    with path.open("wb") as target:
        write_mcap(recording, target)
    with path.open("rb") as file:
        for said, channel, found in make_reader(file, validate_crcs=True).iter_messages():
            assert said is not None and said.encoding == "jsonschema" and json.loads(said.data) == schema(2)
            assert channel.topic == TOPIC and channel.message_encoding == "json"
            sample = json.loads(found.data)
            assert set(sample) == set(schema(2)["required"]) and sample["tension_n"] == [None, None]
            assert found.log_time == round(1e9 * sample["time_s"])


def history_of(path: Path, samples: int = 20, begin_s: float = 0.0, boot: str = "boot") -> None:
    writer = writer_of(path, boot)
    good = np.full(6, Quality.GOOD, np.int8)
    state = np.full(6, DriveState.ENABLED, np.int8)
    frames = [
        frame_of(k, begin_s + 0.01 * k, tension_quality=good, drive_state=state, state=LoopState.RUN, held=0)
        for k in range(samples)
    ]
    writer.store(frames, [], begin_s + WALL_AHEAD_S)
    writer.disconnect()


def test_a_time_of_history_is_a_recording(tmp_path: Path) -> None:
    history_of(tmp_path / "h")
    found = recording_of_history(tmp_path / "h", WALL_AHEAD_S + 0.05, WALL_AHEAD_S + 10.0)
    assert found.samples == 15 and found.n == 6 and found.period_s == 0.01 and found.controlled.all()
    assert np.allclose(found.time_s, 0.05 + 0.01 * np.arange(15)) and np.isfinite(found.tension_n).all()


def test_a_time_without_samples_or_over_a_restart_is_refused(tmp_path: Path) -> None:
    history_of(tmp_path / "h", begin_s=100.0)
    with pytest.raises(RecordingRefused, match="0 samples"):
        recording_of_history(tmp_path / "h", WALL_AHEAD_S, WALL_AHEAD_S + 1.0)
    with pytest.raises(RecordingRefused, match="there is no history"):
        recording_of_history(tmp_path / "absent", 0.0, 1.0)
    writer = writer_of(tmp_path / "h", "another boot", WALL_AHEAD_S + 200.0)
    writer.store([frame_of(k, 0.01 * k) for k in range(5)], [], WALL_AHEAD_S + 200.0)
    writer.disconnect()
    with pytest.raises(RecordingRefused, match="started anew"):
        recording_of_history(tmp_path / "h", WALL_AHEAD_S, WALL_AHEAD_S + 300.0)


app = typer.Typer()
app.command()(export)


@pytest.mark.parametrize("kind", ["csv", "mcap"])
def test_export_writes_a_file_that_is_read_as_what_the_history_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    if kind == "mcap":
        pytest.importorskip("mcap")
    history_of(tmp_path / "h")
    monkeypatch.setattr(recordings_export.time, "time", lambda: WALL_AHEAD_S + 1.0)
    out = tmp_path / f"out.{kind}"
    arguments = ["--history", str(tmp_path / "h"), "--last", "1s", "--format", kind, "--out", str(out)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "20 samples of 6 spans" in result.stderr
    assert same(read_recording(out), recording_of_history(tmp_path / "h", WALL_AHEAD_S, WALL_AHEAD_S + 1.0))


def test_export_refuses_what_it_does_not_know(tmp_path: Path) -> None:
    history_of(tmp_path / "h")
    for arguments, text in (
        (["--history", str(tmp_path / "h")], "no file is named"),
        (["a.csv", "--last", "soon"], "'soon', should be a time above 0"),
        (["a.csv", "--last", "0"], "should be a time above 0"),
        ([str(tmp_path / "a.csv"), "--history", str(tmp_path / "absent")], "there is no history"),
        (["a.mcap", "--format", "mcap", "--fields", "tension_n"], "csv only"),
    ):
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 2 and text in result.stderr


def test_export_still_writes_a_table_of_any_fields(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    history_of(tmp_path / "h")
    monkeypatch.setattr(time, "time", lambda: WALL_AHEAD_S + 1.0)
    out = tmp_path / "table.csv"
    arguments = [str(out), "--history", str(tmp_path / "h"), "--last", "60", "--fields", "sequence"]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    assert out.read_text().splitlines()[0] == "wall_s,sequence"
