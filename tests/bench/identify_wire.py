"""Part g of bench-identify: the same experiment over the wires in real time and in stepped time, and what each tells.

The plant is S_real, the law LQI of the line's file, the data those of the gateway's history between begin and end of
the experiment. Over the wires there is what stepped time does not have: jitter of the loop, and of when drives and load
cells answer.
"""

import asyncio
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gateway.cli.experiment_run import follow
from gateway.cli.recordings import recording_of_history
from gateway.cli.stepped import SteppedLoop
from gateway.cli.stepped_experiment import run_experiment
from gateway.control.design import design_lqi, task_of
from gateway.core.experiment import Abort, Experiment, Leg
from gateway.core.line import Line
from gateway.core.recording import Recording
from gateway.core.theta import Noise
from gateway.identification.estimate import Structure
from gateway.identification.prediction_error import fit
from gateway.identification.prior import prior_of
from tests.bench.identify_runs import FAST_M_PER_S, SPEED_M_PER_S, Found, against_truth
from tests.closed_loop.recorded import real_plant
from tests.closed_loop.wire import WireLine
from tests.support.proved import store_proof

LEG_S = 5.0
SETTLE_S = 1.0  #: in stepped time, before the experiment
TRIES = 3  #: a test machine that stalls ends an experiment, as it must


class SimulatedLine(WireLine):
    """Its loop knows that nobody can be hurt, and takes experiments."""

    def start_loop(self) -> None:
        store_proof(self.line, self.folder / "data")
        controller = self.folder / "controller.json"
        self.children.start("loop", self.folder / "line.toml", "--controller", controller, "--simulated", *self.folders)


@dataclass(frozen=True)
class OverTheWire:
    """Of one seed."""

    wire: Found  #: of the paper's structure, against the truth
    stepped: Found
    samples: tuple[int, int]  #: over the wire, stepped

    @property
    def ratios(self) -> dict[str, float]:
        """Half width over the wire over that of stepped time, by parameter."""
        return {name: width / self.stepped.half_width[name] for name, width in self.wire.half_width.items()}


def experiment(seed: int) -> Experiment:
    """Five seconds at each of two speeds, as one commissions."""
    legs = [Leg(duration_s=LEG_S, speed_m_per_s=speed) for speed in (SPEED_M_PER_S, FAST_M_PER_S)]
    abort = Abort(deviation_n=12.0, saturated_share=1.0, reversal_share=1.0, held_periods=2)
    return Experiment(format=1, amplitude_n=[2.0] * 6, dwell_s=0.1, seed=seed, legs=legs, abort=abort)


def over_the_wire(seed: int) -> OverTheWire:
    """Raises AssertionError where this machine cannot hold a line in real time."""
    wire, line = _from_the_wire(seed)
    stepped = _in_stepped_time(line, seed)
    prior, plant = prior_of(line, Structure()), real_plant()
    fits = [fit([data], prior, Noise()) for data in (wire, stepped)]
    return OverTheWire(against_truth(fits[0], plant), against_truth(fits[1], plant), (wire.samples, stepped.samples))


def _from_the_wire(seed: int) -> tuple[Recording, Line]:
    said = ""
    for _ in range(TRIES):
        with tempfile.TemporaryDirectory() as folder, SimulatedLine(Path(folder), seed) as wire:
            wire.run()
            ended = asyncio.run(follow(wire.children.run_folder, experiment(seed), lambda text: None))
            if ended.complete:
                wire.children.end("gateway")  # which writes the last of the history
                return recording_of_history(Path(ended.history), ended.begin_s, ended.end_s), wire.line
            said = "; ".join([ended.text, *ended.reasons])
    raise AssertionError(f"no experiment came to its end over the wires: {said}")


def _in_stepped_time(line: Line, seed: int) -> Recording:
    loop = SteppedLoop(line, design_lqi(task_of(line)), real_plant(), seed)
    recipe = line.recipes[0]
    loop.begin_in_production(np.array(recipe.tension_n), recipe.speed_m_per_s)
    loop.step(round(SETTLE_S / line.control.period_s))
    return run_experiment(loop, experiment(seed))
