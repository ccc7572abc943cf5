"""The Controller Configuration Storage and the Performance Baseline Database: what is found again, and how."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import apsw
import pytest

from gateway.core.controller import Controller, config_hash, parse_controller
from gateway.supervisor.baselines import (
    Baselines,
    BaselinesError,
    Measured,
    MeasuredRun,
    begin_baselines,
    in_force,
    open_baselines,
)
from gateway.supervisor.configurations import (
    STABLE,
    Configurations,
    ConfigurationsError,
    Origin,
    begin_configurations,
    named,
    open_configurations,
)
from gateway.supervisor.models import begin_repository

SITE = ("demo", "line-1")
ARCHIVED = (100.0, "ann", "three shifts within 1 N")


def controller(latency_s: float = 0.01) -> Controller:
    found = parse_controller(Path("docs/examples/controller.json").read_bytes())
    return found.model_copy(update={"latency_s": latency_s})


@pytest.fixture
def storage(tmp_path: Path) -> Iterator[Configurations]:
    with begin_configurations(tmp_path / "new" / "configurations.sqlite") as found:
        yield found


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Baselines]:
    with begin_baselines(tmp_path / "baselines.sqlite") as found:
        yield found


# Configurations


def test_a_configuration_is_stored_once_and_keeps_every_origin(storage: Configurations) -> None:
    origin = Origin(1.0, "design", "first design", model="a" * 64)
    first = storage.store(*SITE, controller(), origin)
    parent = Origin(2.0, "refine", "less overshoot", parent=first.id, model="b" * 64, verdict="c" * 64)
    second = storage.store(*SITE, controller(0.011), parent)
    again = Origin(3.0, "ann", "back to the first")
    third = storage.store(*SITE, controller(), again)
    assert (first.version, second.version, third.version) == (1, 2, 1)
    assert third.id == first.id == config_hash(controller()) and third.controller == controller()
    assert third.origins == (origin, again) and second.origins == (parent,) and not third.damage
    assert storage.entries(*SITE) == [third, second]


def test_versions_count_up_within_each_line(storage: Configurations) -> None:
    origin = Origin(1.0, "design", "a test")
    assert [storage.store("demo", line, controller(), origin).version for line in ("a", "b", "a")] == [1, 1, 1]
    assert storage.store("demo", "b", controller(0.011), origin).version == 2
    assert [(one.line, one.version) for one in storage.entries()] == [("a", 1), ("b", 1), ("b", 2)]


def test_the_newest_of_a_name_counts_though_the_clock_went_back(storage: Configurations) -> None:
    ids = [storage.store(*SITE, controller(0.01 + k / 1000), Origin(1.0, "x", "y")).id for k in range(3)]
    for k, id_ in enumerate(ids[:2]):
        storage.archive(*SITE, id_, STABLE, 100.0 - k, "ann", "it held")
    assert storage.find(STABLE).id == ids[1]
    storage.archive(*SITE, ids[0], STABLE, 50.0, "ann", "again")
    assert storage.find(STABLE, *SITE).id == ids[0]
    assert [each.why for each in storage.find("1").archived] == ["it held", "again"]
    assert {name: one.id for (_, _, name), one in named(storage.entries()).items()} == {STABLE: ids[0]}


def test_a_configuration_is_found_by_what_a_person_says(storage: Configurations) -> None:
    ids = [storage.store(*SITE, controller(0.01 + k / 1000), Origin(1.0, "x", "y")).id for k in range(3)]
    storage.archive(*SITE, ids[1], "night-shift", *ARCHIVED)
    said = {"newest": 2, "v1": 0, "2": 1, ids[2][:6]: 2, ids[0].upper(): 0, "night-shift": 1}
    assert {wanted: ids.index(storage.find(wanted).id) for wanted in said} == said
    with pytest.raises(ConfigurationsError, match=r"no configuration 4; allowed: .*\(1, 2, 3\).*\(night-shift\)"):
        storage.find("4")
    storage.store("demo", "line-2", controller(), Origin(1.0, "x", "y"))
    with pytest.raises(ConfigurationsError, match="name the line with --line"):
        storage.find("1")
    with pytest.raises(ConfigurationsError, match="nothing was archived"):
        storage.archive("demo", "line-2", ids[2], STABLE, *ARCHIVED)
    with pytest.raises(ConfigurationsError, match="is no name"):
        storage.archive(*SITE, ids[2], "3", *ARCHIVED)


@pytest.mark.parametrize("table", ["configuration", "origin", "archive"])
def test_nothing_is_ever_changed_or_taken_away(storage: Configurations, table: str) -> None:
    one = storage.store(*SITE, controller(), Origin(1.0, "x", "y"))
    storage.archive(*SITE, one.id, STABLE, *ARCHIVED)
    other = apsw.Connection(str(storage.path))
    for query in (f"UPDATE {table} SET site = 'x'", f"DELETE FROM {table}"):
        with pytest.raises(apsw.ConstraintError):
            other.execute(query)
    other.close()


def test_a_damaged_configuration_is_named_and_hides_no_other(storage: Configurations) -> None:
    for k in range(2):
        storage.store(*SITE, controller(0.01 + k / 1000), Origin(1.0, "x", "y"))
    other = apsw.Connection(str(storage.path))
    other.execute("DROP TRIGGER configuration_stays")
    other.execute("UPDATE configuration SET content = CAST(replace(content, '0.011', '0.012') AS BLOB)")
    other.close()
    first, second = storage.entries()
    assert first.controller == controller() and not first.damage
    assert second.controller is None and second.damage == "its content is not what was stored"


# Baselines


def run(scenario: str = "tension", rmse_n: float = 1.0, **changes: object) -> MeasuredRun:
    measured = Measured(rmse_n, 2.0, float("inf"), 4.0)
    return replace(MeasuredRun(*SITE, "c" * 64, "m" * 64, scenario, 10.0, measured, {"speed_m_per_s": 0.1}), **changes)


def test_a_measurement_is_read_back_as_what_it_was(database: Baselines) -> None:
    stored = database.add(run())
    assert stored.run == run() and stored.baseline == ()
    database.add(run("velocity", configuration="d" * 64, model=None))
    assert [one.run for one in database.measurements(scenario="tension")] == [run()]
    assert [one.run.model for one in database.measurements(configuration="d" * 64)] == [None]
    assert database.measurements("demo", "line-2") == []


def test_the_baseline_is_the_last_one_set_and_the_history_stays(database: Baselines) -> None:
    first, second, other = (database.add(one) for one in (run(), run(rmse_n=0.8), run("velocity")))
    assert database.baseline(*SITE, "tension") is None
    database.set_baseline(second.number, 50.0, "r2rgate", "end of phase 2")
    database.set_baseline(first.number, 40.0, "ann", "the other was measured with a worn roller")  # the clock went back
    database.set_baseline(other.number, 60.0, "r2rgate", "end of phase 2")
    found = database.baseline(*SITE, "tension")
    assert found is not None and found.number == first.number and found.baseline[0].who == "ann"
    every = database.measurements()
    assert [len(one.baseline) for one in every] == [1, 1, 1]
    assert {key[2]: one.number for key, one in in_force(every).items()} == {
        "tension": first.number, "velocity": other.number,
    }  # fmt: skip
    with pytest.raises(BaselinesError, match="no measurement 99: no baseline was set"):
        database.set_baseline(99, 1.0, "x", "y")


@pytest.mark.parametrize(
    ("given", "why"),
    [
        (run(rmse_n=float("nan")), "rmse_n = nan"),
        (run(rmse_n=-1.0), "rmse_n = -1"),
        (run(measured=Measured(1.0, float("inf"), 1.0, 1.0)), "overshoot_pct = inf"),
        (run(conditions={"x": float("nan")}), "conditions"),
    ],
)
def test_what_is_no_measurement_is_refused(database: Baselines, given: MeasuredRun, why: str) -> None:
    with pytest.raises(BaselinesError, match=why):
        database.add(given)
    assert database.measurements() == []


# Files


def test_no_store_is_mistaken_for_another(tmp_path: Path) -> None:
    path = tmp_path / "models.sqlite"
    begin_repository(path).close()
    for open_, error in ((begin_configurations, ConfigurationsError), (begin_baselines, BaselinesError)):
        with pytest.raises(error, match="it belongs to another program"):
            open_(path)
    with pytest.raises(ConfigurationsError, match="there are no configurations at"):
        open_configurations(tmp_path / "none.sqlite")
    with pytest.raises(BaselinesError, match="there are no baselines at"):
        open_baselines(tmp_path / "none.sqlite")
    assert not (tmp_path / "none.sqlite").exists()
