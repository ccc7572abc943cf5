"""`r2rgate identify` as a user runs it: from recordings in files to a model, its page, and what is refused."""

import io
import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from gateway.cli import identify_data
from gateway.cli.identify_result import IdentifyResult
from gateway.cli.identify_table import print_result
from gateway.cli.main import app
from gateway.cli.recordings_csv import write_csv
from gateway.core.line_model import LineModel, canonical, model_hash, parse_model
from gateway.core.line_template import line_template
from gateway.core.recording import Recording
from gateway.core.signals import DriveState, Quality
from gateway.core.states import LoopState
from gateway.identification import identify as pipeline
from gateway.identification import inheritance
from gateway.identification.identify import NotIdentified
from gateway.mailbox.paths import GATEWAY_DATA
from gateway.supervisor.models import open_repository
from tests.closed_loop.recorded import demonstration_line, real_plant, recorded
from tests.closed_loop.spoiled import shifted, swapped
from tests.unit.supervisor_support import frame_of
from tests.unit.test_historian import WALL_AHEAD_S, writer_of

STRONG = {"stiffness_per_length": 2200.0 / 1.2, "radius_per_inertia": 0.035, "friction_per_inertia": 15.0}


def identify(folder: Path, *given: object) -> tuple[int, str, str]:
    """With the line's file and the places to write to in `folder`."""
    places = ("--out", folder / "new" / "model.json", "--report", folder / "new" / "page.html")
    result = CliRunner().invoke(app, list(map(str, ("identify", folder / "line.toml", *given, *places))))
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stdout, result.stderr


def file_of(folder: Path, recording: Recording, name: str = "run.csv") -> Path:
    path = folder / name
    with path.open("w", newline="", encoding="utf-8") as target:
        write_csv(recording, target)
    return path


def folder_with_line(folder: Path, spans: int = 2) -> Path:
    (folder / "line.toml").write_text(line_template(spans), encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def recording() -> Recording:
    """Two spans, 4 s at each of two speeds, set-points moved."""
    plant = real_plant().model_copy(update={"spans": 2})
    return recorded(plant, 1, 4.0, (0.05, 0.1), line=demonstration_line(2))


@pytest.fixture(scope="module")
def run(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, IdentifyResult, str]:
    """The folder, the result, and its JSON."""
    folder = folder_with_line(tmp_path_factory.mktemp("identify"))
    code, out, err = identify(folder, file_of(folder, recording), "--data-dir", folder / "data", "--json")
    assert code == 0, err
    return folder, IdentifyResult.model_validate_json(out), out


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "runtime"))
    return folder_with_line(tmp_path)


# What is identified


def test_the_model_is_written_stored_and_that_of_the_data(
    run: tuple[Path, IdentifyResult, str], recording: Recording
) -> None:
    folder, result, _ = run
    payload = (folder / "new" / "model.json").read_bytes()
    model = parse_model(payload)
    assert payload == canonical(model) + b"\n"
    assert model.data.digest == recording.digest() and 780 < model.data.samples < recording.samples == 800
    assert model.validation is not None and model.validation.whiteness == "white"
    assert len(model.validation.innovation_speed) == 2 and model.parent is None and model.created == result.date
    for name, truth in STRONG.items():
        interval = model.intervals[name]
        assert interval.high - interval.low < 0.01 * truth
        assert abs(interval.value - truth) < interval.high - interval.low  # twice the half-width: no seed fails here
    assert result.kept is not None and result.kept.id == model_hash(model) and result.kept.version == 1
    with open_repository(folder / "data" / GATEWAY_DATA / "models.sqlite") as models:
        (entry,) = models.entries()
    assert entry.model == model and entry.state is None


def test_the_json_tells_what_the_model_rests_on(run: tuple[Path, IdentifyResult, str]) -> None:
    _, result, text = run
    assert json.loads(text)["found"]["validation"]["valid"] is True  # and the JSON is that alone
    found = result.found
    assert found is not None and not result.refused
    assert {one.method for one in found.methods} == {"prediction error", "recursive least squares", "subspace"}
    assert found.methods[0].behind == 0.0 and [one.score for one in found.methods] == sorted(
        one.score or np.inf for one in found.methods
    )
    assert [one.evidence for one in found.structures] == sorted((o.evidence for o in found.structures), reverse=True)
    (chosen,) = [one for one in found.structures if one.chosen]
    assert chosen.structure == "as in the paper" and chosen.structure in found.why
    of_file = {one.name: one.file.value for one in found.parameters}
    assert of_file["stiffness_n"] == pytest.approx(2400.0) and of_file["radius_m"] == pytest.approx(0.04)
    assert {one.name: one.told for one in found.parameters}["radius_per_inertia"] == "strongly"
    assert [one.name for one in found.validation.outputs] == ["tension 1", "tension 2", "speed 1", "speed 2"]


def test_the_terminal_shows_every_method_with_its_intervals_in_80_columns(
    run: tuple[Path, IdentifyResult, str],
) -> None:
    _, result, _ = run
    assert result.found is not None
    text = io.StringIO()
    console = Console(file=text, width=80)
    print_result(result, result.found, console)
    said = text.getvalue()
    tables = [line for line in said.splitlines() if "±" in line and "  " in line and ":" not in line]
    assert len(tables) >= 8 and max(map(len, tables)) <= 80 and "…" not in said
    for one in result.found.methods:
        interval = one.intervals["stiffness_per_length"]
        half = 50.0 * (interval.high - interval.low) / interval.value
        assert f"{interval.value:.4g} ±{half:.2g} %" in said
    assert "verdict: the model holds" in said and result.found.why in said
    assert all(sentence in said for sentence in result.found.words)


def test_rollers_that_differ_fit_80_columns_too(run: tuple[Path, IdentifyResult, str]) -> None:
    found = run[1].found
    assert found is not None
    some = [one for one in found.parameters if one.name in ("friction_nms_per_rad", "radius2_per_inertia")]
    each = [one.model_copy(update={"name": f"{one.name}[60]"}) for one in some]
    each += [some[0].model_copy(update={"name": name}) for name in ("coulomb_nm[60]", "torque_lag_s")]
    structure = found.structures[0].model_copy(update={"structure": "per roller, Coulomb friction, torque lag"})
    text = io.StringIO()
    differing = found.model_copy(update={"parameters": each, "structures": [structure]})
    print_result(run[1], differing, Console(file=text, width=80))
    assert "…" not in text.getvalue() and "R²/J[60]" in text.getvalue() and "c[60]" in text.getvalue()


def test_the_page_holds_its_own_data_and_the_answer(run: tuple[Path, IdentifyResult, str]) -> None:
    folder, result, _ = run
    assert result.found is not None
    page = (folder / "new" / "page.html").read_text(encoding="utf-8")
    assert "holds on" in page and "Tension 1, held out" in page and "Autocorrelation" in page
    assert "src=" not in page and "@import" not in page
    for one in result.found.parameters:
        assert f"{one.model.value:.5g}" in page


def test_what_a_tape_says_narrows_what_the_data_leave_open_and_an_offset_is_taken_out(
    run: tuple[Path, IdentifyResult, str], recording: Recording, folder: Path
) -> None:
    late = file_of(folder, shifted(recording, "tension_n", 1, 1), "late.csv")
    code, out, err = identify(folder, late)
    assert code == 2 and "tension_2_n" in err and "[offset]" in err and "--align" in err and not out
    code, out, err = identify(folder, late, "--align", "--measured", "radius_m=0.035,0.5%")
    assert code == 0, err
    assert "taken out: tension_2_n was +10.00 ms late" in out and "R = 0.035 (±0.5 %)" in out
    model = parse_model((folder / "new" / "model.json").read_bytes())
    assert [one.channel for one in model.alignment] == ["tension_2_n"] and model.alignment[0].late_s == 0.010
    free = next(one.model for one in run[1].found.parameters if one.name == "inertia_kg_m2")
    told = model.intervals["inertia_kg_m2"]
    assert told.high - told.low < 0.5 * (free.high - free.low) and told.low < 1.0 < told.high
    assert "not stored" in out and not (folder / "state").exists()


def test_a_model_that_does_not_hold_is_kept_as_rejected(recording: Recording, folder: Path) -> None:
    """Something swings in the load cell that no structure has; from two files."""
    tension = recording.tension_n.copy()
    tension[:, 0] += 0.3 * np.sin(2.0 * np.pi * 4.0 * recording.time_s)
    swinging = replace(recording, tension_n=tension)
    files = [file_of(folder, swinging.part(0, 400), "a.csv"), file_of(folder, swinging.part(400, 800), "b.csv")]
    code, out, err = identify(folder, *files, "--data-dir", folder / "data")
    assert code == 4, err
    assert "does NOT hold" in out and "finding: " in out and "recommended: " in out and "marked as rejected" in out
    assert "r2rgate design" not in out
    with open_repository(folder / "data" / GATEWAY_DATA / "models.sqlite") as models:
        (entry,) = models.entries()
    assert entry.state == "rejected" and "innovation" in entry.marks[0].reason
    assert entry.model is not None and entry.model.data.source == "a.csv, b.csv"


# What is refused: every reason, exit code 2, and nothing is written


def untouched(folder: Path) -> bool:
    return not (folder / "new").exists() and not (folder / "data").exists() and not (folder / "state").exists()


def test_bad_data_are_refused_with_what_would_mend_them(recording: Recording, folder: Path) -> None:
    bad = file_of(folder, swapped(recording, "tension_n", 0, 1))
    code, out, err = identify(folder, bad, "--data-dir", folder / "data")
    assert code == 2 and not out and "[swapped]" in err and "mend: " in err and "nothing was written" in err
    code, out, _ = identify(folder, bad, "--json")
    result = IdentifyResult.model_validate_json(out)
    assert code == 2 and result.found is None and result.kept is None and len(result.refused) >= 1
    assert any(one.kind == "swapped" and one.severity == "refusal" for one in result.recordings[0].findings)
    assert untouched(folder)


def test_a_line_that_hardly_moved_is_told_which_experiment_would_help(recording: Recording, folder: Path) -> None:
    plant = real_plant().model_copy(update={"spans": 2})
    quiet = recorded(plant, 1, 4.0, amplitude_n=0.0, line=demonstration_line(2))
    code, _, err = identify(folder, file_of(folder, quiet))
    assert code == 2 and "[excitation]" in err and "experiment: every tension set-point" in err and untouched(folder)
    code, _, err = identify(folder, file_of(folder, recording.part(0, 250)))  # excited, but too short to hold any back
    assert code == 2 and "no model: 1 reason" in err and untouched(folder)


def test_what_is_no_recording_of_this_line_is_refused(recording: Recording, folder: Path) -> None:
    good = file_of(folder, recording)
    words = folder / "words.csv"
    words.write_text("time_s,colour\n0.0,red\n")
    code, _, err = identify(folder, words, folder / "none.csv", good, good)
    assert code == 2 and "colour" in err and "none.csv" in err and "run.csv is the same data as run.csv" in err
    folder_with_line(folder, 3)
    code, _, err = identify(folder, good)
    assert code == 2 and "it has 2 spans, the line 3" in err and untouched(folder)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("radius_m=0.035", "should be NAME=VALUE,TOLERANCE%"),
        ("radius_mm=35,1%", "did you mean radius_m?"),
        ("radius_m=35,1%", "correct the unit, or the line's file"),
        ("radius_m=0.035,0%", "0.001 % or more"),
        ("radius_m=nan,1%", "the value should be above 0"),
        ("radius_m=one,1%", "should be numbers"),
    ],
)
def test_what_was_measured_must_be_possible(folder: Path, given: str, said: str) -> None:
    code, _, err = identify(folder, "run.csv", "--measured", given)
    assert code == 2 and f"--measured {given}: " in err and said in err and untouched(folder)


def test_options_that_make_no_sense_are_refused(recording: Recording, folder: Path) -> None:
    good = file_of(folder, recording)
    assert identify(folder, good, "--last", "10min")[0] == 2
    result = CliRunner().invoke(app, ["identify", str(folder / "line.toml"), str(good), "--out", str(good)])
    assert result.exit_code == 2 and "would overwrite" in result.stderr
    place = str(folder / "line.toml" / "x.json")
    result = CliRunner().invoke(app, ["identify", str(folder / "line.toml"), str(good), "--out", place])
    assert result.exit_code == 2 and "is no folder" in result.stderr


def test_the_model_in_service_is_the_prior_only_when_it_is_asked_for_and_one_was_accepted(
    run: tuple[Path, IdentifyResult, str], recording: Recording, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[LineModel] = []

    def recorded_only(parent: LineModel, *_: object, **__: object) -> None:
        asked.append(parent)
        raise NotIdentified(["far enough"])

    monkeypatch.setattr(inheritance, "identify_after", recorded_only)
    good, data = file_of(folder, recording), folder / "data"
    code, _, err = identify(folder, good, "--data-dir", data, "--prior", "in-service")
    assert code == 2 and "--prior in-service: there are no models at" in err
    shutil.copytree(run[0] / "data", data)
    code, _, err = identify(folder, good, "--data-dir", data, "--prior", "in-service")
    assert code == 2 and "no model of demo/line-1 was accepted; allowed: line, a model" in err and not asked
    with open_repository(data / GATEWAY_DATA / "models.sqlite") as models:
        (entry,) = models.entries()
        models.mark(entry.id, "accepted", 1.0, "a test")
    for prior in ("in-service", "1", str(run[0] / "new" / "model.json")):
        code, _, err = identify(folder, good, "--data-dir", data, "--prior", prior)
        assert code == 2 and "far enough" in err
    assert [model_hash(one) for one in asked] == [entry.id] * 3
    without = {**json.loads((run[0] / "new" / "model.json").read_bytes()), "posterior": None}
    (folder / "old.json").write_text(json.dumps(without))
    code, _, err = identify(folder, good, "--prior", folder / "old.json")
    assert code == 2 and "has no posterior, which a prior is made from" in err and len(asked) == 3


def test_ctrl_c_leaves_nothing_behind(recording: Recording, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "choose", interrupted)
    code, out, err = identify(folder, file_of(folder, recording), "--data-dir", folder / "data")
    assert code == 130 and not out and "interrupted: nothing was written" in err and untouched(folder)


# The running line


def test_without_files_it_is_the_history_of_the_line_that_runs(
    recording: Recording, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Path, float]] = []

    def of_history(path: Path, start_s: float, end_s: float) -> Recording:
        asked.append((path, round(end_s - start_s, 6)))
        return swapped(recording, "tension_n", 0, 1)  # refused at once

    async def status(_: Path) -> SimpleNamespace:
        return SimpleNamespace(site="demo", line="line-1", historian=SimpleNamespace(path="/history.sqlite"))

    monkeypatch.setattr(identify_data, "recording_of_history", of_history)
    monkeypatch.setattr(identify_data, "ask_status", status)
    assert identify(folder, "--run-dir", folder, "--last", "10min")[0] == 2
    assert identify(folder, "--history", folder / "old.sqlite")[0] == 2
    assert asked == [(Path("/history.sqlite"), 600.0), (folder / "old.sqlite", 60.0)]
    text = (folder / "line.toml").read_text().replace('line = "line-1"', 'line = "line-2"')
    (folder / "line.toml").write_text(text)
    code, _, err = identify(folder, "--run-dir", folder)
    assert code == 2 and "runs demo/line-1, the file describes demo/line-2" in err and len(asked) == 2


def test_a_history_gives_the_model_that_its_samples_give_in_a_file(
    run: tuple[Path, IdentifyResult, str], recording: Recording, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fields = ("tension_n", "tension_setpoint_n", "speed_m_per_s", "torque_nm", "torque_actual_nm")
    good, enabled = np.full(2, Quality.GOOD, np.int8), np.full(2, DriveState.ENABLED, np.int8)
    frames = [
        frame_of(
            k, float(recording.time_s[k]), 2, tension_quality=good, drive_state=enabled, state=LoopState.RUN, held=0,
            unwind_speed_m_per_s=float(recording.unwind_speed_m_per_s[k]),
            **{name: getattr(recording, name)[k] for name in fields},
        )
        for k in range(recording.samples)
    ]  # fmt: skip
    writer = writer_of(folder / "history.sqlite", spans=2)
    writer.store(frames, [], WALL_AHEAD_S)
    writer.disconnect()
    monkeypatch.setattr(identify_data, "time", SimpleNamespace(time=lambda: WALL_AHEAD_S + recording.time_s[-1] + 1.0))
    code, out, err = identify(folder, "--history", folder / "history.sqlite", "--json")
    assert code == 0, err
    result, from_file = IdentifyResult.model_validate_json(out), run[1]
    assert result.recordings[0].digest == from_file.recordings[0].digest == recording.digest()
    assert result.found is not None and from_file.found is not None
    assert result.found.parameters == from_file.found.parameters
    code, _, err = identify(folder, "--history", folder / "history.sqlite", "--last", "0.5")
    assert code == 2 and "the last 0.5 s were asked for: --last takes more" in err


def test_where_no_line_runs_it_says_so(folder: Path) -> None:
    code, _, err = identify(folder, "--run-dir", folder / "nowhere")
    assert code == 3 and err and untouched(folder)
