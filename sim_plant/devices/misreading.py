"""What can be wrong with one sensor beside its noise: stuck, off, drifting, spiking, showing something else.

Set while the line runs. Everything is counted in steps of the world (1 ms), in each of which a sensor measures once.
"""

from math import nan

from sim_plant.physics import STEP_S


class Misreading:
    """In the sensor's own unit. Mistakes add up, but a sensor that is stuck, or made to show a value, shows just that.

    >>> sensor = Misreading()
    >>> sensor.offset(0.5, rate_per_s=0.1, step=1000)
    >>> sensor.shown(20.0, step=3000)
    20.7
    """

    def __init__(self) -> None:
        self.heal()

    def heal(self) -> None:
        """Nothing is wrong any more."""
        self.healthy = True
        self._sticks = False
        self._held: float | None = None
        self._factor = 1.0
        self._offset = 0.0
        self._rate_per_s = 0.0
        self._since_step = 0
        self._spike = 0.0
        self._spike_step: int | None = None

    def stick(self) -> None:
        """It stays at what it shows next."""
        self.healthy, self._sticks = False, True

    def show(self, value: float) -> None:
        """It shows this from now on."""
        self.healthy, self._held = False, value

    def nan(self) -> None:
        """It shows no number from now on."""
        self.show(nan)

    def scale(self, factor: float) -> None:
        """It shows so many times what it should; -1 is the wrong way round, 0 nothing."""
        self.healthy, self._factor = False, factor

    def offset(self, offset: float, rate_per_s: float, step: int) -> None:
        """It is off by `offset`, and by `rate_per_s` more for every second from `step` on."""
        self.healthy = False
        self._offset, self._rate_per_s, self._since_step = offset, rate_per_s, step

    def spike(self, height: float) -> None:
        """Its next measurement that is read is off by `height`, and only that."""
        self.healthy, self._spike, self._spike_step = False, height, None

    def shown(self, value: float, step: int) -> float:
        """What it shows when it should show `value`, in this step."""
        if self.healthy:
            return value
        if self._held is not None:
            return self._held
        shown = (
            self._factor * value
            + self._offset
            + self._rate_per_s * (step - self._since_step) * STEP_S
            + self._spiked(step)
        )
        if self._sticks:
            self._held = shown
        return shown

    def _spiked(self, step: int) -> float:
        if self._spike_step is None:
            self._spike_step = step
        return self._spike if step == self._spike_step else 0.0
