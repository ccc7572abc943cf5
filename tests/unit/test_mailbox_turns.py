"""Turns of those who write to a mailbox: bounded in all, equal among those who wait, and nobody is left out."""

import asyncio
from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from gateway.mailbox.codec import MAX_DATAGRAM
from gateway.mailbox.turns import LONG_PER_WINDOW, MAX_ACCEPTED, SHORT, WINDOW_S, Turns
from tests.support.virtual_time import START_S, VirtualTimeLoop


class Greedy:
    """A connection on which there is always something to be read."""

    def __init__(self, turns: Turns, pid: int, length: int = 1) -> None:
        self.pid = pid
        self.length = length
        self.taken_s: list[float] = []
        self._turns = turns
        turns.come(pid)

    def read(self) -> None:
        while self._turns.is_on(self.pid, self.length):
            self._turns.took(self.pid, self.length)
            self.taken_s.append(asyncio.get_running_loop().time())
        self._turns.wait(self.pid, self.length, self.read)


def greedy(pids: list[int], most: int, windows: int, lengths: dict[int, int] | None = None) -> list[Greedy]:
    """Connections of these processes after so many windows; `lengths` of what they send, in bytes."""

    async def story() -> list[Greedy]:
        turns = Turns(most)
        crowd = [Greedy(turns, pid, (lengths or {}).get(pid, 1)) for pid in pids]
        for one in crowd:
            one.read()
        await asyncio.sleep((windows - 0.5) * WINDOW_S)
        turns.close()
        return crowd

    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        return runner.run(story())


@given(st.lists(st.integers(1, 8), min_size=1, max_size=40), st.integers(1, 100))
def test_all_together_get_so_much_and_every_process_and_connection_its_turn(pids: list[int], most: int) -> None:
    processes = len(set(pids))
    crowd = greedy(pids, most, windows=2 + len(pids))
    taken = Counter(at_s for one in crowd for at_s in one.taken_s)
    assert len(taken) == 2 + len(pids)
    assert all(most - processes < count <= most for count in taken.values())  # equal shares: the rest is nobody's
    assert all(one.taken_s for one in crowd)
    first_s = {one.pid: min(other.taken_s[0] for other in crowd if other.pid == one.pid) for one in crowd}
    assert max(first_s.values()) < START_S + (2.5 + len(pids) / most) * WINDOW_S


def test_a_process_with_many_connections_gets_no_more_than_one_with_a_single_one() -> None:
    crowd = greedy([1] * 30 + [2], most=20, windows=40)
    of = Counter({pid: sum(len(one.taken_s) for one in crowd if one.pid == pid) for pid in (1, 2)})
    assert of.total() == 40 * 20
    assert of[2] >= 39 * 10  # its equal share, from the second window on


def test_the_longest_messages_go_one_in_a_window_in_turns_and_hold_up_nothing_short() -> None:
    crowd = greedy([*range(8), 8], most=20, windows=40, lengths=dict.fromkeys(range(8), MAX_DATAGRAM))
    long = Counter(at_s for one in crowd[:8] for at_s in one.taken_s)
    assert set(long.values()) == {1} and len(long) == 40
    assert {len(one.taken_s) for one in crowd[:8]} <= {4, 5, 6}, "each as often as the others"
    assert len(set(crowd[8].taken_s)) == 40, "who sends little is read in each window"


@given(st.lists(st.integers(SHORT + 1, MAX_DATAGRAM), min_size=1, max_size=20))
def test_of_what_is_long_so_many_bytes_are_taken_in_a_window_and_each_comes_to_its_turn(lengths: list[int]) -> None:
    crowd = greedy([*range(len(lengths))], 100, 2 * len(lengths) + 2, dict(enumerate(lengths)))
    taken: Counter[float] = Counter()
    for one in crowd:
        for at_s in one.taken_s:
            taken[at_s] += one.length
    assert max(taken.values()) <= LONG_PER_WINDOW and all(one.taken_s for one in crowd)


def test_connections_are_taken_so_many_in_a_window() -> None:
    async def story() -> None:
        turns = Turns()
        ends_s = {turns.accept() for _ in range(MAX_ACCEPTED)}
        assert len(ends_s) == 2 and None in ends_s
        await asyncio.sleep(WINDOW_S)
        assert turns.accept() is None

    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        runner.run(story())
