"""One device is exchanged and proved alone: `r2rgate prove --only`, in stepped time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from drivers.memory import MemoryLink
from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, task_of
from gateway.core.messages import Drill, KeepProof, Prove, Reply, Start, Stop
from gateway.core.states import Phase
from gateway.core.wiring_proof import Answer, asked_of
from gateway.loop.commands import proof_to_keep
from gateway.loop.refused import Refused
from safety.actions import Action, found
from sim_plant.faults.parse import parse_fault
from sim_plant.faults.stepped import injector_of
from tests.bench.harm_lines import drawn
from tests.closed_loop.conftest import demo_line, real_plant

SEED = 41018  #: of a line with four spans, wired right
LONGEST_S = 180.0  #: of one device, from the command to the end of its pulls
FAILS_S = 600.0


@dataclass
class Exchanged:
    """A line that was proved, `faults` in it from then on."""

    loop: SteppedLoop

    @classmethod
    def of_drawn(cls, faults: Sequence[str] = ()) -> "Exchanged":
        line = drawn(SEED)
        loop = SteppedLoop(line.line, design_lqi(task_of(line.line)), line.plant, SEED)
        return cls(loop).with_faults(faults)

    def with_faults(self, faults: Sequence[str] = ()) -> "Exchanged":
        self.loop.step(3)
        for fault in faults:
            injector_of(self.loop.truth).add(parse_fault(fault), self.loop.truth.world.now_s)
        self.tell({})
        return self

    def tell(self, serials: dict[str, str]) -> None:
        """Devices have these serial numbers from now on."""
        (link,) = self.loop.cycle.links
        assert isinstance(link, MemoryLink)
        link.serials = serials

    def start(self) -> Reply:
        """Armed, and the line is started or not."""
        self._arm()
        return self.loop.command(Start())

    def ask(self, only: list[str]) -> Reply:
        """Drilled, armed, asked to prove these."""
        if self.loop.cycle.machine.phase is Phase.READY:
            assert self.loop.command(Stop()).ok and self.loop.step_until(Phase.OFF, 1.0)
        assert self.loop.arm(Drill()).ok and self.loop.step_until(Phase.OFF, 10.0)
        self._arm()
        return self.loop.command(Prove(only=only))

    def prove(self, only: list[str]) -> tuple[float, list[int]]:
        """The time that it took and the rollers whose drives had any torque."""
        reply, since_s = self.ask(only), self.loop.now_s
        assert reply.ok, reply.reasons
        torque_nm = np.zeros(self.loop.line.n)
        while self.loop.cycle.machine.phase is not Phase.OFF:
            self.loop.step()
            torque_nm = np.maximum(torque_nm, np.abs(self.loop.cycle.outputs.torque_nm))
            assert self.loop.now_s - since_s < FAILS_S
        return self.loop.now_s - since_s, (np.flatnonzero(torque_nm) + 1).tolist()

    def keep(self, only: list[str]) -> list[str]:
        """As the loop does it, every question answered; returns which were asked."""
        cycle = self.loop.cycle
        assert cycle.proving.judged is not None
        questions = cycle.proving.judged.questions
        answers = [Answer(question=each.code, device=asked_of(each), by="somebody") for each in questions]
        command = KeepProof(answers=answers, only=only)
        cycle.wiring.write(proof_to_keep(cycle, command), only)
        assert self.loop.command(command).ok
        return [each.code for each in questions]

    @property
    def found(self) -> list[tuple[str, object]]:
        """Code and number (span or roller) of everything that ended the proof."""
        judged = self.loop.cycle.proving.judged
        assert judged is not None
        told = [each.as_data() for each in judged.findings]
        return [(each.code, each.parameters.get("span", each.parameters.get("roller"))) for each in told if each]

    def _arm(self) -> None:
        reply = self.loop.arm()
        assert reply.ok, reply.reasons
        assert self.loop.step_until(Phase.READY, 2.0)


def codes(reply: Reply) -> list[str]:
    return [each.code for each in reply.findings]


def test_an_exchanged_drive_is_proved_alone_and_the_line_starts() -> None:
    line = Exchanged.of_drawn()
    name = line.loop.line.drives[2].name
    line.tell({name: "4799"})
    refused = line.start()
    assert not refused.ok and codes(refused) == ["device-exchanged"]
    before = line.loop.cycle.wiring.proof
    assert before is not None
    time_s, pulled = line.prove([name])
    assert time_s <= LONGEST_S and pulled == [3] and line.found == []
    assert set(line.keep([name])) <= {"drive-torque-unseen", "speed-sign-unseen"}
    after = line.loop.cycle.wiring.proof
    assert after is not None and {one.device: one.serial for one in after.devices}[name] == "4799"
    assert after.cells == before.cells
    others = [[one for one in proof.drives if one.drive != name] for proof in (before, after)]
    assert others[0] == others[1] and 3 in after.drives[2].answered and after.drives[2].torque_nm > 0.0
    assert line.start().ok


def test_a_web_with_slack_takes_no_longer_than_three_minutes() -> None:
    """The demonstration line: friction is so heavy that what a proof may give takes 3 cm of slack up in 40 s."""
    line = demo_line()
    plant = real_plant()
    plant = plant.model_copy(update={"effects": plant.effects.model_copy(update={"slack": True})})
    loop = SteppedLoop(line, design_lqi(task_of(line)), plant, 1)
    for span in range(1, line.n + 1):
        loop.truth.world.slacken_web(span, 0.03)
    exchanged = Exchanged(loop).with_faults()
    time_s, pulled = exchanged.prove(["load-cell-6"])  # tells no number: a person says that it is another one
    assert time_s <= LONGEST_S and pulled == [5, 6] and exchanged.found == []
    exchanged.keep(["load-cell-6"])
    assert exchanged.start().ok


@pytest.mark.parametrize(
    ("fault", "device", "finding"),
    [
        ("drive 3 reversed", "drive", ("drive-reversed", 3)),
        ("drive 3 encoder-reversed", "drive", ("speed-reversed", 3)),
        ("load-cell 3 cell-factor factor=-1", "cell", ("cell-inverted", 3)),
        ("load-cell 3 cell-factor factor=0", "cell", ("cell-silent", 3)),
        ("load-cell 3 cells-swapped other=2", "cell", ("cell-of-another-span", 3)),
        ("load-cell 3 cell-factor factor=0", "drive", ("drive-answered-otherwise", 3)),
        ("load-cell 3 cell-factor factor=-1", "drive", ("drive-answered-otherwise", 3)),
    ],
)
def test_what_is_wired_wrong_is_named(fault: str, device: str, finding: tuple[str, int]) -> None:
    """Of a drive alone nobody knows whether it or its load cell is another than it was: both are named."""
    line = Exchanged.of_drawn([fault])
    name = {"drive": line.loop.line.drives[2].name, "cell": line.loop.line.load_cells[2].name}[device]
    line.prove([name])
    assert line.found[0] == finding, line.found
    assert {number for _, number in line.found} <= {3, 2}


def test_what_is_not_named_and_has_changed_too_is_refused() -> None:
    line = Exchanged.of_drawn()
    first, second = (drive.name for drive in line.loop.line.drives[:2])
    line.tell({first: "4711", second: "4712"})
    refused = line.ask([second])
    assert [(each.code, each.parameters["device"]) for each in refused.findings] == [("device-exchanged", first)]
    assert line.ask([first, second]).ok


def test_a_name_that_no_device_has_is_refused_with_the_nearest() -> None:
    line = Exchanged.of_drawn()
    name = line.loop.line.drives[2].name
    (told,) = line.ask([name + "x"]).findings
    assert (told.code, told.parameters["device"], told.parameters["nearest"]) == ("device-unknown", name + "x", name)
    assert name in told.parameters["names"].split(", ")


def test_nothing_is_kept_of_another_proof_than_was_made() -> None:
    line = Exchanged.of_drawn()
    name = line.loop.line.drives[2].name
    line.prove([name])
    for only in ([], [line.loop.line.drives[1].name]):
        with pytest.raises(Refused) as refused:
            proof_to_keep(line.loop.cycle, KeepProof(only=only))
        assert [each.code for each in refused.value.findings] == ["not-pulled"]


def test_a_load_cell_that_was_contradicted_is_cleared_by_its_own_proof_alone() -> None:
    line = Exchanged.of_drawn()
    cells, wiring = line.loop.line.load_cells, line.loop.cycle.wiring
    wiring.contradict(
        [found("load-cell-contradicted", Action.STOP, span=span, shown_n=50.0, off_n=20.0) for span in (2, 3)]
    )
    drive = line.loop.line.drives[0].name
    for only, left in (([drive], [2, 3]), ([cells[2].name], [2])):
        line.prove(only)
        assert line.found == []
        line.keep(only)
        assert [each.parameters["span"] for each in wiring.against] == left
    assert codes(line.start()) == ["load-cell-contradicted"]
