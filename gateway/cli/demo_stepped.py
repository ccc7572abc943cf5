"""The same cases in stepped time, worked out beside the line that runs: in one process of low priority."""

import os
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from gateway.cli.demo_line import Setup
from gateway.cli.rehearse_designs import truth_of
from gateway.cli.stepped import run_scenario
from gateway.cli.workers import Workers
from gateway.control.design import design_mpc, task_of
from gateway.core.controller import Controller, config_hash
from gateway.core.line import Line
from gateway.core.scenario import PAPER, Scenario
from sim_plant.plant import load_plant

SEEDS = 5  #: runs that a case is held against
NICER = 10


class SteppedAside:
    """A context. `ask` early, `rmse_n` late."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._plant = setup.out / "plant.toml"
        self._workers = Workers(1, _begin)
        self._asked: dict[tuple[str, str], Future[float]] = {}

    def __enter__(self) -> Self:
        self._workers.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._workers.__exit__(kind, error, trace)

    def ask(self, config: Controller) -> None:
        for case in PAPER:
            key = config_hash(config), case.name
            if key not in self._asked:
                self._asked[key] = self._workers.submit(
                    _rmse_n, self._setup.line, config, self._plant, case, self._setup.seed
                )

    def rmse_n(self, config: Controller, case: Scenario) -> float:
        """The mean of `SEEDS` runs; waits for what is not done yet."""
        self.ask(config)
        return self._asked[config_hash(config), case.name].result()

    def on_truth(self) -> Controller:
        """Predictive control that is designed on the true line: nobody knows that line better."""
        return design_mpc(replace(task_of(self._setup.line), model=truth_of(load_plant(self._plant))))


def _rmse_n(line: Line, config: Controller, plant: Path, case: Scenario, seed: int) -> float:
    truth = load_plant(plant)
    return float(np.mean([run_scenario(line, config, truth, case, one).rmse_n for one in range(seed, seed + SEEDS)]))


def _begin() -> None:
    """Behind everything that runs."""
    os.nice(NICER)
