"""`make bench-stepped`: both cases in stepped time on the simulated real line, which is itself held against others."""

import numpy as np

from gateway.cli.stepped import SteppedResult, run_scenario
from gateway.control.design import design_lqi, design_pid, task_of
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.scenario import PAPER
from sim_plant.physics import derivative, equilibrium
from sim_plant.plant import load_plant
from tests.bench.figures import Bench
from tests.unit.test_sim_physics import TENSION_N, eigenvalue_error, parameters, solver_errors

SEEDS = list(range(20))


def main() -> None:
    bench = Bench("stepped", SEEDS)
    line = load_line(line_template(6, "line.toml"), "line.toml")
    plant = load_plant("sim_plant/plants/s_real.toml")
    table = {}
    for law, design in (("lqi", design_lqi), ("pid", design_pid)):
        config = design(task_of(line))
        run_scenario(line, config, plant, PAPER[0], 0)  # compiled and warm
        for case in PAPER:
            results = [run_scenario(line, config, plant, case, seed) for seed in SEEDS]
            table[f"{law} {case.name}"] = results
    for case in PAPER:
        rmse = [result.rmse_n for result in table[f"lqi {case.name}"]]
        bench.figure(f"rmse_{case.name}_n", float(np.mean(rmse)), "N", len(rmse))
        bench.figure(f"rmse_{case.name}_p95_n", float(np.percentile(rmse, 95)), "N", len(rmse))
        pid = [result.rmse_n for result in table[f"pid {case.name}"]]
        bench.figure(f"rmse_{case.name}_pid_n", float(np.mean(pid)), "N", len(pid))
    everything = [result for results in table.values() for result in results]
    bench.figure("unsafe_events", sum(result.unsafe_events for result in everything), "", len(everything))
    speed = [result.time_s[-1] / result.wall_s for result in everything]
    bench.figure("faster_than_real_time", float(np.median(speed)), "x", len(speed))
    physics(bench)
    bench.tables["cases"] = {name: row(results) for name, results in table.items()}
    bench.finish()


def row(results: list[SteppedResult]) -> dict[str, float]:
    rmse = [result.rmse_n for result in results]
    return {
        "rmse_mean_n": float(np.mean(rmse)),
        "rmse_p95_n": float(np.percentile(rmse, 95)),
        "tension_min_n": float(min(result.tension_n.min() for result in results)),
        "tension_max_n": float(max(result.tension_n.max() for result in results)),
        "unsafe_events": sum(result.unsafe_events for result in results),
    }


def physics(bench: Bench) -> None:
    residual = 0.0
    for seed in range(100):
        theta = parameters(6, seed)
        speed, torque = equilibrium(theta, TENSION_N, 0.1)
        rates = derivative(theta, TENSION_N, speed, torque, 0.1)
        residual = max(residual, *(float(np.abs(rate).max()) for rate in rates))
    bench.figure("equilibrium_residual", residual, "", 100)
    cases = [(1, 0.1), (6, 0.01), (6, 0.1), (20, 0.5)]
    bench.figure("eigenvalue_error", max(eigenvalue_error(*case) for case in cases), "", len(cases))
    bench.figure("solve_ivp_error_n", solver_errors()[0], "N", 1)


if __name__ == "__main__":
    main()
