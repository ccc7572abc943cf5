"""`r2rgate models` as a user runs it: in and out, one or two of them, the list, the page, and what is refused."""

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gateway.cli.main import app
from gateway.cli.models_compare import compared, figures, seen, verdict
from gateway.cli.models_report import page_of
from gateway.core.line_model import LineModel, canonical, model_hash, model_of, parse_model
from gateway.core.line_model_quantities import Quantity, quantities, typical, values_of
from gateway.core.line_template import line_template
from gateway.supervisor.models import Entry, begin_repository, open_repository
from tests.unit.model_support import fields, model


def r2rgate(*given: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, ["models", *map(str, given)])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stdout, result.stderr


def file_of(folder: Path, one: LineModel, name: str = "model.json") -> Path:
    path = folder / name
    path.write_bytes(canonical(one))
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A data folder with three versions; the second was refused, the third is in use."""
    path = tmp_path / "data"
    with begin_repository(path / "models.sqlite") as models:
        first = models.store(model(), 1785765900.0)
        second = models.store(
            model(2, 1.05, parent=first.id, method="subspace", validation=None, noise=None), 1785765960.0
        )
        third = models.store(model(2, 1.001, parent=first.id), 1785766020.0)
        models.mark(second.id, "rejected", 1785765970.0, "innovations of 1.4")
        models.mark(third.id, "accepted", 1785766030.0, "verdict 12")
    return path


# In and out


def test_a_model_goes_in_and_comes_out_as_the_same_bytes(tmp_path: Path) -> None:
    file, data, out = file_of(tmp_path, model()), tmp_path / "data", tmp_path / "new" / "out.json"
    code, said, err = r2rgate("import", file, "--data-dir", data)
    assert code == 0, err
    assert "stored as version 1 of demo/line-1" in said and model_hash(model())[:12] in said
    code, said, _ = r2rgate("import", file, "--data-dir", data)
    assert code == 0 and "was there already, as version 1" in said
    code, said, err = r2rgate("export", "1", "--out", out, "--data-dir", data)
    assert code == 0 and model_hash(model())[:12] in said, err
    assert out.read_bytes() == canonical(model()) + b"\n"
    assert parse_model(out.read_bytes()) == model()
    code, said, _ = r2rgate("export", "newest", "--out", "-", "--data-dir", data)
    assert code == 0 and said.encode() == out.read_bytes()


def test_an_import_tells_machines_what_it_did(tmp_path: Path) -> None:
    file = file_of(tmp_path, model())
    told = [json.loads(r2rgate("import", file, "--data-dir", tmp_path, "--json")[1]) for _ in range(2)]
    assert [one["new"] for one in told] == [True, False]
    assert told[0]["id"] == model_hash(model()) and told[0]["version"] == told[1]["version"] == 1


def test_without_a_folder_a_model_goes_to_its_line_and_is_found_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gateway.cli.data_place.data_base", lambda: tmp_path)
    monkeypatch.setattr("gateway.cli.process_commands.data_base", lambda: tmp_path)
    code, _, err = r2rgate("list")
    assert code == 2 and f"there are no models in {tmp_path}" in err and "models import FILE" in err
    assert r2rgate("import", file_of(tmp_path, model()))[0] == 0
    assert (tmp_path / "demo_line-1" / "gateway" / "models.sqlite").is_file()
    code, said, _ = r2rgate("list")
    assert code == 0 and "demo/line-1" in said
    line_file = tmp_path / "line.toml"
    line_file.write_text(line_template(2), encoding="utf-8")
    assert r2rgate("show", "1", "--line", line_file)[0] == 0
    assert r2rgate("import", file_of(tmp_path, model(line="line-2"), "b.json"))[0] == 0
    code, _, err = r2rgate("list")
    assert code == 2 and "2 lines have models here" in err and f"--data-dir {tmp_path / 'demo_line-2'}" in err
    assert r2rgate("show", "1", "--line", line_file)[0] == 0


def test_a_model_of_another_line_is_not_imported_for_this_one(tmp_path: Path) -> None:
    line_file = tmp_path / "line.toml"
    line_file.write_text(line_template(2), encoding="utf-8")
    file = file_of(tmp_path, model(3, line="line-2"))
    code, _, err = r2rgate("import", file, "--line", line_file, "--data-dir", tmp_path / "data")
    assert code == 2 and not (tmp_path / "data").exists()
    assert "is not imported: it is a model of demo/line-2, the line is demo/line-1" in err
    assert "is not imported: it has 3 spans, the line 2" in err


def test_an_export_overwrites_nothing_unless_it_must(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    out.write_text("mine")
    code, _, err = r2rgate("export", "1", "--out", out, "--data-dir", folder)
    assert code == 2 and "left as it was" in err and out.read_text() == "mine"
    assert r2rgate("export", "1", "--out", out, "--data-dir", folder, "--force")[0] == 0
    assert parse_model(out.read_bytes()) == model()
    code, _, err = r2rgate("export", "1", "--out", out / "deeper.json", "--data-dir", folder)
    assert code == 2 and "cannot be written" in err


# List and show


def test_the_list_has_a_row_for_each_version(folder: Path) -> None:
    code, said, err = r2rgate("list", "--data-dir", folder)
    assert code == 0, err
    assert max(map(len, said.splitlines()[:-1])) <= 80 and said.splitlines()[-1].startswith("repository: ")
    rows = [line for line in said.splitlines() if re.match(r"v\d", line)]
    assert [row.split()[0] for row in rows] == ["v1", "v2", "v3"]
    assert [row.split()[-1] for row in rows] == ["-", "rejected", "accepted"]
    assert "1833" in rows[0] and "0.035" in rows[0] and "subspace" in rows[1]
    assert said.count("±0.3 %") == 9
    assert "v1" in said.splitlines()[said.splitlines().index(rows[1]) + 1]


def test_the_list_for_machines(folder: Path) -> None:
    told = json.loads(r2rgate("list", "--data-dir", folder, "--json")[1])
    assert told["repository"] == str(folder / "models.sqlite")
    first, second, third = told["models"]
    assert (second["version"], second["state"], second["parent"]) == (2, "rejected", first["id"])
    assert second["marks"] == [{"state": "rejected", "time_s": 1785765970.0, "reason": "innovations of 1.4"}]
    assert third["stiffness_per_length"]["value"] == pytest.approx(2200.0 * 1.001 / 1.2)
    assert first["data"]["samples"] == 500


def test_show_says_everything(folder: Path) -> None:
    code, said, _ = r2rgate("show", "3", "--data-dir", folder)
    assert code == 0
    for part in (
        model_hash(model(2, 1.001, parent=model_hash(model()))), "experiment 3", "prior      v1", "verdict 12",
        "R2 of tensions", "0.9980", "18 to 44", "0.1 ms late", "2026-08-03 14:07 UTC", "noise of dv/dt",
    ):  # fmt: skip
        assert part in said, part
    assert r2rgate("show", "--data-dir", folder)[1] == said
    code, said, _ = r2rgate("show", "2", "--data-dir", folder)
    assert code == 0 and "rejected   2026-08-03 14:06 UTC: innovations of 1.4" in said


def test_show_takes_a_file_that_was_never_stored(tmp_path: Path) -> None:
    file = file_of(tmp_path, model(2, parent="ab" * 32))
    code, said, err = r2rgate("show", file)
    assert code == 0, err
    assert "abababababab, which is not here" in said
    told = json.loads(r2rgate("show", file, "--json")[1])
    assert model_of(told["model"]) == model(2, parent="ab" * 32) and told["ancestors"] == []


def test_show_for_machines_has_the_whole_model(folder: Path) -> None:
    told = json.loads(r2rgate("show", "2", "--data-dir", folder, "--json")[1])
    assert model_hash(model_of(told["model"])) == told["id"]
    assert told["ancestors"] == [model_hash(model())] and told["state"] == "rejected"


# Compare


def test_compare_says_what_differs_and_by_how_much(folder: Path) -> None:
    code, said, err = r2rgate("compare", "1", "2", "--data-dir", folder)
    assert code == 0, err
    rows = {line.split(",")[0]: line for line in said.splitlines() if "," in line}
    assert "+5.00 %" in rows["EA/L"] and "exclude" in rows["EA/L"] and "exclude" in rows["J"]
    assert "+0.00 %" in rows["R/J"] and "overlap" in rows["R/J"]
    assert "0.1" in rows["noise of T"] and rows["noise of T"].split()[-1] == "-"
    assert re.search(r"R2 of tensions +0.9980 +-", said)
    assert re.search(r"tension 1, N +18 to 44 +18 to 44", said)
    assert "The intervals of 6 of 9 quantities exclude each other: EA (+5 %), R (+5 %), J (+5 %)" in said


def test_compare_for_machines_and_with_a_file(folder: Path, tmp_path: Path) -> None:
    file = file_of(tmp_path, model(2, 1.05))
    told = json.loads(r2rgate("compare", "1", file, "--data-dir", folder, "--json")[1])
    assert (told["a"]["version"], told["b"]["version"], told["b"]["name"]) == (1, None, str(file))
    by_name = {row["name"]: row for row in told["quantities"]}
    assert by_name["stiffness_n"]["difference_pct"] == pytest.approx(5.0)
    assert by_name["stiffness_n"]["intervals_exclude_each_other"] is True
    assert by_name["length_m"]["intervals_exclude_each_other"] is False
    assert by_name["coulomb_nm"]["intervals_exclude_each_other"] is None
    assert told["a"]["region"]["tension_to_n"] == [44.0, 44.0] and told["verdict"].startswith("The intervals of 6")


def test_models_that_agree_do_not_contradict(folder: Path) -> None:
    said = r2rgate("compare", "1", "3", "--data-dir", folder)[1]
    assert "The intervals of all 9 quantities overlap" in said
    bare = model_of(fields(intervals={}))
    assert verdict(compared(bare, bare)).startswith("No quantity has an interval in both")


def per_roller() -> LineModel:
    document = fields(2)
    document["structure"]["per_roller"] = True
    document["parameters"]["inertia_kg_m2"] = [0.9, 1.1]
    intervals = document["intervals"]
    for name in ("inertia_kg_m2", "radius_per_inertia"):
        del intervals[name]
    intervals["inertia_kg_m2[1]"] = {"value": 0.9, "low": 0.89, "high": 0.91}
    intervals["inertia_kg_m2[2]"] = {"value": 1.1, "low": 1.09, "high": 1.11}
    return model_of(document)


def test_rollers_that_differ_stand_beside_what_all_share() -> None:
    found = quantities(per_roller())
    assert found["inertia_kg_m2[2]"] == Quantity(1.1, 1.09, 1.11) and "inertia_kg_m2" not in found
    assert found["radius_per_inertia[1]"] == Quantity(0.035 / 0.9)  # no interval, but a value each
    assert found["radius_m"] == Quantity(0.035, 0.035 * 0.98, 0.035 * 1.02)
    rows = {row.name: row for row in compared(model(), per_roller())}
    assert rows["inertia_kg_m2[1]"].a == Quantity(1.0, 0.98, 1.02)
    assert rows["inertia_kg_m2[1]"].exclusive is True and rows["inertia_kg_m2[2]"].exclusive is True
    assert rows["inertia_kg_m2[1]"].difference_pct == pytest.approx(-10.0)
    assert rows["inertia_kg_m2[1]"].symbol == "J[1]"
    assert typical(per_roller(), "inertia_kg_m2") == Quantity(
        pytest.approx(1.0), pytest.approx(0.99), pytest.approx(1.01)
    )
    assert typical(per_roller(), "radius_per_inertia").low is None


def test_combinations_are_those_of_the_parameters() -> None:
    values = {name: value[0] for name, value in values_of(model()).items()}
    assert values["stiffness_per_length"] == pytest.approx(2200.0 / 1.2)
    assert values["radius_per_inertia"] == pytest.approx(0.035)
    assert values["friction_per_inertia"] == pytest.approx(15.0)
    assert values["radius2_per_inertia"] == pytest.approx(0.035**2)
    for name, interval in model().intervals.items():
        assert values[name] == pytest.approx(interval.value)


def test_what_was_not_looked_at_is_a_dash() -> None:
    assert {figure for _, figure in figures(None)} == {"-"}
    assert len(figures(None)) == len(figures(model().validation))
    document = fields()
    document["region"]["tension_from_n"] = document["region"]["tension_to_n"] = [None, 20.0]
    assert seen(model_of(document).region)[1:] == [("tension 1, N", "-"), ("tension 2, N", "20 to 20")]


# The page


def test_the_page_has_every_version_and_the_drift(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "models.html"
    code, said, err = r2rgate("report", "--out", out, "--data-dir", folder)
    assert code == 0 and "3 versions" in said, err
    page = out.read_text(encoding="utf-8")
    for part in (
        "3 versions of the model are stored.", "Against version 1", "Stiffness EA", "verdict 12", "Validation",
        "From version 1 to version 3: EA/L +0.1 %",
    ):  # fmt: skip
        assert part in page, part
    assert "Coulomb friction, Nm" not in page  # nobody found any
    assert not re.findall(r"(?:src|href)=\"http", page)


def of_line(models: list[LineModel | None]) -> list[Entry]:
    return [
        Entry(f"{k:064x}", "demo", "line-1", k, 0.0, one, "" if one else "its content is not what was stored")
        for k, one in enumerate(models, 1)
    ]


def test_the_page_of_one_version_and_of_damaged_ones() -> None:
    around = ("2026-08-03T14:05:00+00:00", "r2rgate models report", {}, "a machine")
    one = page_of("demo", "line-1", of_line([model()]), *around)
    assert "A drift needs two versions or more." in one.answer
    assert [section.title for section in one.sections] == ["Versions", "Validation"]
    some = page_of("demo", "line-1", of_line([None, model(), None, per_roller()]), *around)
    assert "Damaged, and left out below: 1, 3." in some.answer
    x = some.sections[1].charts[0].x
    assert x.tolist() == [2.0, 4.0]
    titles = {chart.title: chart for chart in some.sections[2].charts}
    assert [one.name for one in titles["Inertia J"].series] == ["J[1]", "J[2]"]
    assert titles["Inertia J"].series[0].values.tolist()[1] == 0.9
    assert page_of("demo", "line-1", of_line([None]), *around).sections[0].title == "Versions"


def test_a_line_that_has_no_friction_has_a_page(tmp_path: Path) -> None:
    document = fields()
    document["parameters"]["friction_nms_per_rad"] = [0.0, 0.0]
    document["intervals"] = {}
    around = ("2026-08-03T14:05:00+00:00", "r2rgate models report", {}, "a machine")
    page = page_of("demo", "line-1", of_line([model_of(document)] * 2), *around)
    assert [one.name for one in page.sections[1].charts[0].series] == ["EA/L", "R/J"]


# Refusals


def test_what_cannot_be_done_is_refused_with_what_can(folder: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.json"
    broken.write_text(json.dumps({**fields(), "metod": "x"}))
    for given, says in (
        (("show", "7", "--data-dir", folder), "has no model 7; allowed: a version (1, 2, 3)"),
        (("show", "1", "--data-dir", tmp_path / "none"), "there are no models at"),
        (("show", tmp_path / "none.json"), "none.json cannot be read: No such file"),
        (("show", broken), 'broken.json: metod = "x": there is no such key'),
        (("compare", "1", broken, "--data-dir", folder), "did you mean method?"),
        (("import", tmp_path, "--data-dir", folder), "cannot be read: Is a directory"),
        (("import", broken, "--data-dir", folder), "did you mean method?"),
        (("export", "7", "--out", tmp_path / "x.json", "--data-dir", folder), "has no model 7"),
        (("report", "--data-dir", tmp_path / "none"), "there are no models at"),
        (("list", "--line", tmp_path / "none.toml"), "cannot be read"),
    ):
        code, said, err = r2rgate(*given)
        assert code == 2 and not said, given
        assert says in err, err
    assert not (tmp_path / "none").exists() and not (tmp_path / "x.json").exists()
    with open_repository(folder / "models.sqlite") as models:
        assert len(models.entries()) == 3


def test_a_file_that_is_too_large_is_no_model(tmp_path: Path) -> None:
    large = tmp_path / "large.json"
    with large.open("wb") as stream:
        stream.truncate(6_000_000)
    code, _, err = r2rgate("import", large, "--data-dir", tmp_path)
    assert code == 2 and "is larger than 5 MB: no model" in err


def test_a_damaged_model_is_listed_and_not_used(tmp_path: Path) -> None:
    older = Path(__file__).parent / "data" / "models-schema-1.sqlite"
    content = older.read_bytes()
    harmed = content.replace(b'"recursive least squares"', b'"recursive leest squares"')
    assert harmed != content
    (tmp_path / "models.sqlite").write_bytes(harmed)
    code, said, _ = r2rgate("list", "--data-dir", tmp_path)
    assert code == 0 and "DAMAGED" in said and "version 1 is damaged: its content is not what was stored" in said
    for command in (("show", "1"), ("compare", "1", "2"), ("export", "1", "--out", tmp_path / "x.json")):
        code, _, err = r2rgate(*command, "--data-dir", tmp_path)
        assert code == 2 and "is damaged: its content is not what was stored" in err
    assert r2rgate("show", "2", "--data-dir", tmp_path)[0] == 0
    told = json.loads(r2rgate("list", "--data-dir", tmp_path, "--json")[1])
    assert [bool(one["damage"]) for one in told["models"]] == [True, False]
    assert r2rgate("report", "--out", tmp_path / "m.html", "--data-dir", tmp_path)[0] == 0


def test_a_folder_with_several_lines_asks_which(folder: Path, tmp_path: Path) -> None:
    assert r2rgate("import", file_of(tmp_path, model(line="line-2")), "--data-dir", folder)[0] == 0
    code, said, _ = r2rgate("list", "--data-dir", folder)
    assert code == 0 and "demo/line-1\n" in said and "demo/line-2\n" in said
    for given in (("show", "1"), ("report", "--out", tmp_path / "m.html")):
        code, _, err = r2rgate(*given, "--data-dir", folder)
        assert code == 2 and "demo/line-1, demo/line-2: name the line with --line" in err
    line_file = tmp_path / "line.toml"
    line_file.write_text(line_template(2), encoding="utf-8")
    assert r2rgate("show", "1", "--data-dir", folder, "--line", line_file)[0] == 0
