"""PLANT.toml: what is shipped is the paper's table, and what is wrong is named."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

import sim_plant
from sim_plant.plant import Plant, PlantRefused, load_plant, plant_of

PLANTS = Path(sim_plant.__file__).parent / "plants"

# The paper, table system_parameters: EA, J, R, f, L, disturbance.
TABLE = {
    "s_real": (2200.0, 1.0, 0.035, 15.0, 1.2, 5e-2),
    "s_real_id": (2169.85, 1.078, 0.038, 15.47, 1.24, 5e-2),
    "s_sim": (2400.0, 0.95, 0.04, 10.0, 1.0, 1e-2),
}


def document(**tables: Any) -> dict[str, Any]:
    """A short valid file, with tables replaced or added."""
    return {
        "format": 1,
        "name": "test",
        "spans": 3,
        "web": {"stiffness_n": 2200.0, "length_m": 1.2},
        "rollers": {"radius_m": 0.035, "inertia_kg_m2": 1.0, "friction_nms_per_rad": 15.0},
        **tables,
    }


def reasons(**tables: Any) -> list[str]:
    with pytest.raises(PlantRefused) as refused:
        plant_of(document(**tables))
    return refused.value.reasons


@pytest.mark.parametrize("name", TABLE)
def test_the_shipped_plants_are_the_papers(name: str) -> None:
    plant = load_plant(PLANTS / f"{name}.toml")
    p = plant.parameters()
    found = np.array(
        [p.stiffness_n, p.inertia_kg_m2, p.radius_m, p.friction_nms_per_rad, p.length_m, p.disturbance_m_per_s2]
    )
    assert np.array_equal(found, np.outer(TABLE[name], np.ones(6)))
    assert (p.tension_before_n, p.tension_after_n) == (0.0, 0.0)
    assert (plant.sensors.tension_noise_n, plant.sensors.speed_noise_m_per_s) == (0.1, 1e-4)
    drives = plant.drives
    assert (drives.rated_torque_nm, drives.max_torque_nm, drives.torque_rate_nm_per_s) == (60.0, 60.0, None)


def test_a_parameter_may_differ_per_roller() -> None:
    rollers = {"radius_m": [0.03, 0.04, 0.05], "inertia_kg_m2": 1, "friction_nms_per_rad": 15.0}
    p = plant_of(document(rollers=rollers)).parameters()
    assert p.radius_m.tolist() == [0.03, 0.04, 0.05]
    assert p.inertia_kg_m2.tolist() == [1.0, 1.0, 1.0]


def test_a_typo_is_told_with_the_nearest_key() -> None:
    assert reasons(sensors={"tension_nois_n": 0.1}) == [
        "sensors.tension_nois_n: unknown key; did you mean tension_noise_n?"
    ]
    assert reasons(wires={"modbus": {"prt": 502}}) == ["wires.modbus.prt: unknown key; did you mean port?"]
    assert reasons(zzz=1)[0].startswith("zzz: unknown key; allowed here: format, name, spans, web")


def test_a_port_that_cannot_be_is_told_with_the_range() -> None:
    assert reasons(wires={"modbus": {"port": 99999}, "canopen": {"port": -1}}) == [
        "wires.canopen.port: is -1, should be a port: 1 to 65535",
        "wires.modbus.port: is 99999, should be a port: 1 to 65535",
    ]


def test_every_mistake_is_told_at_once() -> None:
    found = reasons(
        format=2,
        web={"stiffness_n": float("nan"), "length_m": [1.2, 1.2]},
        rollers={"radius_m": "0.035", "inertia_kg_m2": [1.0, -1.0, 1.0], "friction_nms_per_rad": True},
        plc={"speed_ramp_m_per_s2": "slow"},
        recorder={"tension_min_n": 70.0},
        sensors={"tension_noise_n": float("inf")},
    )
    expected = {
        "format": "is 2, should be 1",
        "web.stiffness_n": "finite",
        "web.length_m": "has 2 entries; give one number, or a list of 3 (spans = 3)",
        "rollers.radius_m": "is '0.035', should be a number, or a list with one number each",
        "rollers.inertia_kg_m2[1]": "is -1.0, should be greater than 0",
        "rollers.friction_nms_per_rad": "is True, should be a valid number",
        "plc.speed_ramp_m_per_s2": "is 'slow', should be 'step'",
        "recorder.tension_min_n": "is 70.0, must be below tension_max_n = 60.0",
        "sensors.tension_noise_n": "is inf, should be a finite number",
    }
    told = dict(reason.split(": ", 1) for reason in found)
    assert told.keys() == expected.keys()
    for key, text in expected.items():
        assert text in told[key], key


def test_the_speed_ramp_is_a_number_or_a_word() -> None:
    assert plant_of(document(plc={"speed_ramp_m_per_s2": 0.5})).plc.speed_ramp_m_per_s2 == 0.5
    assert reasons(plc={"speed_ramp_m_per_s2": [0.5]}) == [
        "plc.speed_ramp_m_per_s2: is [0.5], should be a number or 'step'"
    ]


def test_a_missing_key_and_too_many_spans() -> None:
    assert "web: this key is required" in reasons_without("web")
    assert any(reason.startswith("spans: is 61, should be less than or equal to 60") for reason in reasons(spans=61))


def reasons_without(key: str) -> list[str]:
    content = document()
    del content[key]
    with pytest.raises(PlantRefused) as refused:
        plant_of(content)
    return refused.value.reasons


def test_the_papers_plants_are_plain_and_the_realistic_one_has_every_effect_on() -> None:
    for name in TABLE:
        plant = load_plant(PLANTS / f"{name}.toml")
        assert plant.is_plain and plant.sensors.load_cells_are_ideal and plant.sensors.speed_step_m_per_s == 0.0
    realistic = load_plant(PLANTS / "realistic.toml")
    default = Plant.model_validate(document())
    for name in ("effects", "sensors", "drives"):
        table, plain = getattr(realistic, name), getattr(default, name)
        for key in type(table).model_fields:
            if key in ("tension_noise_n", "speed_noise_m_per_s", "rated_torque_nm", "max_torque_nm"):
                continue
            assert getattr(table, key) != getattr(plain, key) or key == "torque_rate_nm_per_s", f"{name}.{key}"
    nominal, paper = realistic.parameters(), load_plant(PLANTS / "s_real.toml").parameters()
    assert np.array_equal(nominal.coefficients(), paper.coefficients())


@pytest.mark.parametrize(
    "tables",
    [
        {"effects": {"slack": True}},
        {"effects": {"friction": {"coulomb_nm": [0.0, 0.1, 0.0]}}},
        {"effects": {"friction": {"breakaway_nm": 0.1}}},
        {"effects": {"friction": {"rise_per_s": 0.1}}},
        {"effects": {"eccentricity": {"share": 1e-3}}},
        {"effects": {"relaxation": {"stiffness_share": 0.1}}},
        {"effects": {"slip": {"on": True}}},
        {"effects": {"unwinder": {"eccentricity": 1e-3}}},
        {"effects": {"reels": {"thickness_m": 1e-4}}},
        {"drives": {"torque_lag_s": 0.004}},
        {"drives": {"torque_step_nm": 0.1}},
    ],
)
def test_each_effect_alone_leaves_the_plain_equations(tables: dict[str, Any]) -> None:
    assert not plant_of(document(**tables)).is_plain


def test_sizes_of_effects_that_are_off_do_not_matter() -> None:
    effects = {"relaxation": {"time_s": 3.0}, "slip": {"wrap_rad": 1.0}, "unwinder": {"radius_m": 0.4}}
    assert plant_of(document(effects=effects)).is_plain


def test_mistakes_in_effects_are_told() -> None:
    found = reasons(
        effects={
            "friction": {"coulomb_nm": [1.0, 1.0, 2.0], "breakaway_nm": 1.5},
            "eccentricity": {"share": 0.5, "phase_rad": [0.0, 1.0]},
            "unwinder": {"radius_m": 0.03},
            "relaxations": {},
        },
        sensors={"tension_zero_n": [0.1]},
        drives={"torque_lag_s": 0.0004},
    )
    expected = [
        "drives.torque_lag_s: is 0.0004, should be 0, or at least 0.001 (one step of the physics)",
        "effects.eccentricity.share: is 0.5, should be less than or equal to 0.1",
        "effects.relaxations: unknown key; did you mean relaxation?",
        "sensors.tension_zero_n: has 1 entries; give one number, or a list of 3 (spans = 3)",
        "effects.eccentricity.phase_rad: has 2 entries; give one number, or a list of 3 (spans = 3)",
        "effects.friction.breakaway_nm: must not be below coulomb_nm (0 means the same as it)",
        "effects.unwinder.core_radius_m: is 0.04, at most radius_m = 0.03",
    ]
    assert sorted(found) == sorted(expected)


def test_nodes_beyond_the_bus_are_refused() -> None:
    wires = {"canopen": {"first_node": 126}}
    assert reasons(wires=wires) == ["wires.canopen.first_node: is 126, at most 125 for 3 nodes (1 to 127)"]
    assert plant_of(document(wires={"canopen": {"first_node": 125}})).wires.canopen.first_node == 125


def test_a_file_that_is_no_toml_names_the_place(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    path.write_text("format = = 1\n")
    with pytest.raises(PlantRefused, match=r"plant\.toml: not a TOML file: .*line 1"):
        load_plant(path)


def test_a_plant_cannot_be_changed() -> None:
    plant = plant_of(document())
    for name in Plant.model_fields:
        with pytest.raises(ValidationError, match="frozen"):
            setattr(plant, name, getattr(plant, name))
