"""An arming that is cancelled at any point, and its undoing that is cancelled again, on CANopen in virtual time."""

import pytest

from drivers.canopen.link import CanopenLink
from gateway.core.signals import DriveRequest, Inputs, Outputs
from tests.closed_loop.conftest import demo_line, real_plant
from tests.closed_loop.virtual_line import VirtualLine
from tests.support.cutting import cut, release_cut

SPANS = 2
TURNS = (0, 1, 2, 3, 5, 8, 13, 21, 34, 55)  #: of the loop, from the beginning of a release to its cancellation


def canopen_link(line):
    (link,) = [link for link in line.links if isinstance(link, CanopenLink)]
    return link


def standing(line):
    """Everything of every node that can be written, and its NMT state."""
    found = {}
    for node in line.truth.canopen.nodes:
        entries = node.objects.object_dictionary.values()
        variables = [
            of for entry in entries for of in (entry.subindices.values() if hasattr(entry, "subindices") else [entry])
        ]
        found |= {
            (node.node_id, of.index, of.subindex): node.objects.get_data(of.index, of.subindex)
            for of in variables
            if of.writable and of.readable and of.index not in (0x6040, 0x6071)  # commands
        }
        found[node.node_id] = node.state
    return found


@pytest.mark.parametrize("cancellations", [0, 1, 3], ids=["once", "twice", "four times"])
def test_wherever_an_arming_is_cut_its_devices_are_left_as_it_found_them(cancellations):
    with VirtualLine(demo_line(SPANS), real_plant(SPANS)) as line:
        link = canopen_link(line)
        line.step(3)
        before, cuts = standing(line), 0
        while line.run(cut(link.prepare(), cuts + 1)):
            cuts += 1
            line.run(release_cut(link, TURNS[cuts % len(TURNS)], cancellations))
            assert standing(line) == before, f"cut at {cuts}"
            sent = len(line.recording().of_kind("command"))
            line.run(command(link))
            assert len(line.recording().of_kind("command")) == sent, "a link that was released is silent"
        assert cuts > 50 and standing(line) != before
        line.run(release_cut(link, 0, cancellations))
        line.step(3)
        assert line.arm().ok


async def command(link):
    outputs = Outputs(SPANS)
    outputs.drive_request[:] = DriveRequest.ENABLE
    link.write(outputs)
    link.trigger(0.0)
    await link.collect(Inputs(SPANS), 0.0)
