"""The controller that `run` keeps: for the line that it was designed for, and for no other."""

import json
from pathlib import Path

import pytest

from gateway.cli.kept_controller import CONTROLLER, SOURCE, kept_controller, source_hash
from gateway.control.design import design_lqi, design_pid, task_of
from gateway.core.controller import ControllerRefused, canonical, config_hash, parse_controller
from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template


def line(*edits: tuple[str, str], spans: int = 2) -> Line:
    text = line_template(spans)
    for old, new in edits:
        assert old in text
        text = text.replace(old, new, 1)
    return load_line(text, "line.toml")


def test_it_is_designed_once_and_then_kept(tmp_path: Path) -> None:
    path, said = kept_controller(line(), tmp_path)
    assert path == tmp_path / CONTROLLER
    assert "designed on the line's nominal model" in said
    assert parse_controller(path.read_bytes()) == design_lqi(task_of(line()))
    before = path.stat().st_mtime_ns
    assert kept_controller(line(), tmp_path) == (path, "")
    assert path.stat().st_mtime_ns == before


#: Every one of these changes the design or what it must respect.
CHANGES = [
    (("period_s = 0.010", "period_s = 0.012"), ("latency_s = 0.010", "latency_s = 0.012")),
    (("latency_s = 0.010", "latency_s = 0.015"),),
    (("speed_max_m_per_s = 0.12", "speed_max_m_per_s = 0.2"),),
    (("value = 2400.0", "value = 2500.0"),),
    (("radius_m = { value = 0.04", "radius_m = { value = 0.05"),),
    (("inertia_kg_m2 = { value = 0.95", "inertia_kg_m2 = { value = 1.2"),),
    (("length_m = { value = 1.0", "length_m = { value = 2.0"),),
    (("tension_n = [28.0", "tension_n = [30.0"),),
]


@pytest.mark.parametrize("edits", CHANGES)
def test_another_line_gets_another_controller_and_the_old_one_is_kept(
    edits: tuple[tuple[str, str], ...], tmp_path: Path
) -> None:
    path, _ = kept_controller(line(), tmp_path)
    old = path.read_bytes()
    changed = line(*edits)
    same, said = kept_controller(changed, tmp_path)
    assert same == path
    assert parse_controller(path.read_bytes()) == design_lqi(task_of(changed))
    kept = tmp_path / f"controller-{config_hash(parse_controller(old))[:12]}.json"
    assert "the line has changed" in said and str(kept) in said
    assert kept.read_bytes() == old
    assert kept_controller(changed, tmp_path) == (path, "")


def test_a_draw_span_is_another_line() -> None:
    drawn = [span.model_copy(update={"control": "draw"}) for span in line().spans]
    assert source_hash(line().model_copy(update={"spans": drawn})) != source_hash(line())


def test_names_and_wires_are_no_reason_for_another_controller(tmp_path: Path) -> None:
    kept_controller(line(), tmp_path)
    renamed = line(('name = "roller-1"', 'name = "nip"'), ("port = 43113", "port = 43114"))
    assert kept_controller(renamed, tmp_path)[1] == ""


def test_what_does_not_change_the_design_is_no_news(tmp_path: Path) -> None:
    path, _ = kept_controller(line(), tmp_path)
    before = path.read_bytes()
    later = line(("stop_time_s = 10.0", "stop_time_s = 11.0"))
    assert kept_controller(later, tmp_path) == (path, "")
    assert path.read_bytes() == before
    assert sorted(file.name for file in tmp_path.iterdir()) == [CONTROLLER, SOURCE]


@pytest.mark.parametrize("has_source", [False, True])
def test_a_controller_that_somebody_put_there_is_never_replaced(has_source: bool, tmp_path: Path) -> None:
    if has_source:
        kept_controller(line(), tmp_path)
    own = canonical(design_pid(task_of(line()))) + b"\n"
    (tmp_path / CONTROLLER).write_bytes(own)
    path, said = kept_controller(line(("value = 2400.0", "value = 2500.0")), tmp_path)
    assert path.read_bytes() == own
    assert "it was put there, not designed by run" in said


def test_a_damaged_source_replaces_nothing(tmp_path: Path) -> None:
    path, _ = kept_controller(line(), tmp_path)
    before = path.read_bytes()
    for damaged in (b"", b"[1]", b'{"made_from": 1}', b"\xff"):
        (tmp_path / SOURCE).write_bytes(damaged)
        assert kept_controller(line(("value = 2400.0", "value = 2500.0")), tmp_path)[0].read_bytes() == before


def test_interrupted_between_its_two_files_it_designs_at_the_next_start(tmp_path: Path) -> None:
    kept_controller(line(), tmp_path)
    (tmp_path / CONTROLLER).unlink()
    path, said = kept_controller(line(), tmp_path)
    assert said and path.exists()
    assert json.loads((tmp_path / SOURCE).read_bytes())["controller"] == config_hash(
        parse_controller(path.read_bytes())
    )


def test_what_is_no_json_has_no_empty_place() -> None:
    with pytest.raises(ControllerRefused) as refused:
        parse_controller(b"hello")
    assert str(refused.value).startswith("Invalid JSON")
