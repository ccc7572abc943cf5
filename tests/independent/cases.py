"""What a line is asked for when a configuration is judged on it: other moves than the gate's own scenarios.

Set-points stay where a good controller has room for them, steps and rates within what the line's file permits.
"""

import numpy as np

from gateway.core.line import Line
from tests.independent.runs import Case, Glide
from tests.independent.truth import FloatArray, Truth, equilibrium

LEAST_N, MOST_N = 12.0, 44.0  #: set-points
SETPOINTS_N = (28.0, 36.0, 20.0, 40.0, 24.0, 32.0)
TAIL_S, STANDS_S = 2.0, 4.0
MOST_TORQUE_SHARE = 0.85  #: of the limit, at the equilibria of the fastest case
PUSH_NM = 3.0
GLIDE_PEAK = 1.875  #: the greatest rate of a minimum-jerk move, times its time, of its way
TOGETHER_N = 8.0  #: by which all set-points go down in one shaped move: rollers at the end follow the sum of it
BAND_N = 0.6  #: 2 % of a middling set-point: what has settled stays within


class Course:
    """Builds a case, piece by piece, from set-points (n,) and a speed that stand."""

    def __init__(self, line: Line, tension_n: FloatArray, unwind_m_per_s: float) -> None:
        self._line, self._period_s = line, line.control.period_s
        self._tension, self._unwind = np.array(tension_n, dtype=np.float64), float(unwind_m_per_s)
        self._rows: list[FloatArray] = []
        self._pushed = np.zeros(len(tension_n))
        self._changed = 0
        self._glide: Glide | None = None

    def stand(self, time_s: float) -> "Course":
        for _ in range(round(time_s / self._period_s)):
            self._row()
        return self

    def step(self, tension_n: FloatArray | None = None, unwind_m_per_s: float | None = None) -> "Course":
        self._changed = self._changed or len(self._rows)
        self._tension = self._tension if tension_n is None else np.array(tension_n, dtype=np.float64)
        self._unwind = self._unwind if unwind_m_per_s is None else float(unwind_m_per_s)
        return self

    def ramp(self, tension_n: FloatArray | None = None, unwind_m_per_s: float | None = None) -> "Course":
        """Both at the rates of the line's moves, together."""
        self._changed = self._changed or len(self._rows)
        moves, h = self._line.moves, self._period_s
        goal = self._tension if tension_n is None else np.array(tension_n, dtype=np.float64)
        fast = self._unwind if unwind_m_per_s is None else float(unwind_m_per_s)
        while np.abs(goal - self._tension).max() > 1e-9 or abs(fast - self._unwind) > 1e-12:
            reach = moves.tension_rate_n_per_s * h
            self._tension = self._tension + np.clip(goal - self._tension, -reach, reach)
            self._unwind += float(np.clip(fast - self._unwind, -moves.speed_rate_m_per_s2 * h,
                                          moves.speed_rate_m_per_s2 * h))  # fmt: skip
            self._row()
        return self

    def glide(self, tension_n: FloatArray, unwind_m_per_s: float, time_s: float) -> "Course":
        """Along minimum-jerk curves."""
        self._changed = self._changed or len(self._rows)
        first, slow, count = self._tension, self._unwind, round(time_s / self._period_s)
        if (goal := np.array(tension_n, dtype=np.float64)).tolist() != first.tolist():
            self._glide = Glide(len(self._rows) - 1, time_s, first, goal)
        for k in range(1, count + 1):
            s = k / count
            way = s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)
            self._tension, self._unwind = first + way * (tension_n - first), slow + way * (unwind_m_per_s - slow)
            self._row()
        return self

    def push(self, torque_nm: FloatArray, time_s: float) -> "Course":
        """Rollers are disturbed by so much torque (n,) for so long."""
        self._changed = self._changed or len(self._rows)
        self._pushed = torque_nm
        self.stand(time_s)
        self._pushed = np.zeros(len(torque_nm))
        return self

    def case(self, name: str, stands_s: float = STANDS_S, band_n: float = BAND_N) -> Case:
        """Standing at the end."""
        self.stand(stands_s)
        rows = np.array(self._rows)
        n = len(self._tension)
        return Case(name, rows[:, :n].copy(), rows[:, n].copy(), rows[:, n + 1 :].copy(), self._changed,
                    round(TAIL_S / self._period_s), band_n, self._glide)  # fmt: skip

    def _row(self) -> None:
        self._rows.append(np.concatenate((self._tension, [self._unwind], self._pushed)))


def fastest(line: Line, truth: Truth, allowed_m_per_s: float) -> float:
    """The greatest speed up to `allowed_m_per_s` at which the drives hold any of the cases, with something in hand."""
    speed = min(allowed_m_per_s, line.limits.speed_max_m_per_s)
    worst = np.where(np.arange(truth.n) % 2 == 0, MOST_N, LEAST_N)
    while speed > 0.02:
        torque = [np.abs(equilibrium(truth, tension, speed)[1]).max() for tension in (worst, worst[::-1])]
        if max(torque) <= MOST_TORQUE_SHARE * line.limits.torque_nm:
            break
        speed *= 0.97
    return speed


def trying_cases(line: Line, top_m_per_s: float, generator: np.random.Generator) -> list[Case]:
    """The cases by which a configuration is found to be safe, or not."""
    n, limits = line.n, line.limits
    slow = min(0.01, 0.3 * top_m_per_s)
    rise = min(limits.speed_step_max_m_per_s, top_m_per_s - slow)

    def levels() -> FloatArray:
        return generator.uniform(LEAST_N + 6.0, MOST_N - 6.0, n)

    def stepped(base: FloatArray, spans: int, least_share: float) -> FloatArray:
        goal = base.copy()
        for i in generator.permutation(n)[:spans]:
            size = generator.uniform(least_share, 1.0) * limits.tension_step_max_n
            up = base[i] + size <= MOST_N and (base[i] - size < LEAST_N or generator.random() < 0.5)
            goal[i] = np.clip(base[i] + size if up else base[i] - size, LEAST_N, MOST_N)
        return goal

    def at(speed: float) -> tuple[FloatArray, Course]:
        base = levels()
        return base, Course(line, base, speed).stand(0.5)

    found: list[Case] = []
    base, course = at(slow)
    span, lowest = int(generator.integers(n)), base.copy()
    lowest[span] = LEAST_N
    course = Course(line, lowest, slow).stand(0.5)
    highest = lowest.copy()
    highest[span] = min(LEAST_N + limits.tension_step_max_n, MOST_N)
    found.append(course.step(highest).stand(1.5).step(lowest).case("step-up-and-down-slow"))
    base, course = at(top_m_per_s)
    found.append(course.step(stepped(base, 1, 0.9)).case("step-fast"))
    base, course = at(slow)
    found.append(course.step(stepped(base, 2, 0.5)).case("two-steps-slow"))
    _, course = at(slow)
    found.append(course.step(unwind_m_per_s=slow + rise).stand(2.0).step(unwind_m_per_s=slow).case("speed-and-back"))
    base, course = at(top_m_per_s)
    found.append(course.ramp(levels(), 0.4 * top_m_per_s).case("grade-change"))
    base, course = at(0.5 * top_m_per_s)
    found.append(
        course.ramp(unwind_m_per_s=top_m_per_s).step(stepped(base, 1, 0.7)).stand(0.3)
        .step(unwind_m_per_s=0.6 * top_m_per_s).case("step-and-speed")
    )  # fmt: skip
    base, course = at(float(generator.uniform(slow, top_m_per_s)))
    for _ in range(4):
        course.step(stepped(base, 1, 0.2)).stand(float(generator.uniform(0.15, 0.5)))
    found.append(course.step(base).case("one-after-another"))
    base, course = at(0.8 * top_m_per_s)
    apart = base.copy()
    span = int(generator.integers(n - 1)) if n > 1 else 0
    for i, sign in ((span, 1.0), (span + 1, -1.0)):
        if i < n:
            apart[i] = np.clip(base[i] + 0.7 * sign * limits.tension_step_max_n, LEAST_N, MOST_N)
    found.append(course.step(apart).case("neighbours-apart"))
    step = 0.9 * limits.tension_step_max_n
    few = generator.permutation(n)[: n // 3]
    low = generator.uniform(LEAST_N, max(MOST_N - step, LEAST_N + 1.0), n)
    high = np.minimum(low + step * generator.uniform(0.8, 1.0, n), MOST_N)
    high[few] = low[few]
    found.append(
        Course(line, low, 0.9 * top_m_per_s).stand(0.5).step(high).stand(2.0).step(low).case("most-up-and-down")
    )
    _, course = at(0.7 * top_m_per_s)
    pushed = PUSH_NM * generator.choice([-1.0, 1.0], n) * generator.uniform(0.3, 1.0, n)
    found.append(course.push(pushed, 0.25).case("push", 3.0))
    return found


def largest_case(line: Line, top_m_per_s: float, generator: np.random.Generator) -> Case:
    """As many spans as may, any of them, by as much as may be, at the highest speed: up, and down again."""
    n, limits = line.n, line.limits
    half = 0.5 * min(limits.tension_step_max_n, MOST_N - LEAST_N)
    middle = np.clip(np.resize(SETPOINTS_N, n), LEAST_N + half, MOST_N - half)
    high, low = middle.copy(), middle.copy()
    moving = generator.permutation(n)[: max(1, min(n, int(limits.steps_together)))]
    high[moving] += half
    low[moving] -= half
    return Course(line, low, top_m_per_s).stand(0.5).step(high).stand(2.5).step(low).case("largest")


def measuring_cases(line: Line, top_m_per_s: float) -> list[Case]:
    """The cases by which configurations are compared: steps of one, of all, of the speed, and shaped moves."""
    n, limits = line.n, line.limits
    slow, middle = min(0.01, 0.3 * top_m_per_s), 0.5 * top_m_per_s
    rise = min(limits.speed_step_max_m_per_s, top_m_per_s - slow)
    base = np.resize(SETPOINTS_N, n)
    high, low, shaped = base.copy(), base.copy(), base.copy()
    high[n // 2 - 1 if n > 1 else 0] += min(limits.tension_step_max_n, 22.0)
    low[1 % n] -= min(limits.tension_step_max_n, 20.0)
    moved = np.resize([8.0, -10.0], n)  # every span: a feed-forward may be wrong for any of them
    gliding_s = max(0.5, GLIDE_PEAK * float(np.abs(moved).max()) / line.moves.tension_rate_n_per_s)
    shaped += moved
    level = np.full(n, 30.0)
    half = 0.5 * min(limits.tension_step_max_n, 24.0)
    together = half * min(1.0, limits.steps_together / n)
    return [
        Course(line, base, slow).stand(0.5).step(high).case("up", 4.0),
        Course(line, base, middle).stand(0.5).step(low).case("down", 4.0),
        Course(line, level, slow).stand(0.5).step(unwind_m_per_s=slow + rise).case("faster", 4.0),
        Course(line, level - together, top_m_per_s).stand(0.5).step(level + together).case("all", 4.0),
        Course(line, level + together, top_m_per_s).stand(0.5).step(level - together).case("all-down", 4.0),
        Course(line, base, middle).stand(0.5).glide(shaped, middle, gliding_s).case("shaped", 4.0),
        Course(line, base, middle).stand(0.5).glide(base - TOGETHER_N, middle, gliding_s).case("shaped-together", 4.0),
        Course(line, level, slow).stand(0.5).glide(level, slow + rise, 1.0).case("shaped-faster", 4.0),
    ]
