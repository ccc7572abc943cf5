"""`python -m gateway.cli.compiled`: compile ahead what is compiled at its first use, so that no line waits for it.

The compiled code is kept beside its source, and holds until that changes.
"""

import sys
import time
from importlib.resources import as_file, files

import numpy as np

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, task_of
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from safety.judge import warm_up
from sim_plant.plant import load_plant

SPANS = 6
PLANTS = ("s_real", "realistic")  #: without effects, and with


def main() -> int:
    began_s = time.monotonic()
    line = load_line(line_template(SPANS, "line.toml"), "line.toml")
    warm_up(line)
    for name in PLANTS:
        with as_file(files("sim_plant") / "plants" / f"{name}.toml") as path:
            loop = SteppedLoop(line, design_lqi(task_of(line)), load_plant(path), 0)
        recipe = line.recipes[0]
        loop.begin_in_production(np.array(recipe.tension_n), recipe.speed_m_per_s)
        loop.step(2)
    print(f"compiled in {time.monotonic() - began_s:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
