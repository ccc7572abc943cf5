"""An experiment in stepped time: on a loop that is in RUN, from its begin to its end."""

import numpy as np

from gateway.cli.stepped import CommandRefused, SteppedLoop
from gateway.core.experiment import Experiment
from gateway.core.messages import RunExperiment
from gateway.core.recording import Recording, recording_of
from gateway.core.telemetry import frame_dtype


def run_experiment(loop: SteppedLoop, experiment: Experiment) -> Recording:
    """What was measured and sent in every period of it; afterwards the line is on its way back to its set-points.

    Raises CommandRefused where the line refuses it, or it is aborted.
    """
    before = len(loop.frames)
    reply = loop.command(RunExperiment(experiment=experiment))
    if not reply.ok:
        raise CommandRefused("; ".join([reply.text, *reply.reasons]))
    while loop.cycle.experiments.run is not None:
        loop.step()
    kind, text = loop.told[-1]
    if kind != "experiment-end":
        raise CommandRefused(text)
    frames = np.frombuffer(b"".join(loop.frames[before:]), frame_dtype(loop.line.n))
    return recording_of(frames, loop.line.control.period_s, f"experiment {experiment.name} on {loop.plant.name}")
