"""What takes seconds and gives the same for the same, computed once for a module's tests."""

import pickle
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


def once(function: Callable[..., T]) -> Callable[..., T]:
    """`function`, which depends on its arguments alone, asked once for each; what it raises is raised again."""
    given: dict[bytes, T] = {}
    raised: dict[bytes, Exception] = {}

    def asked(*words: object, **named: object) -> T:
        key = pickle.dumps((words, sorted(named.items())))
        if key in raised:
            raise raised[key]
        if key not in given:
            try:
                given[key] = function(*words, **named)
            except Exception as error:
                raised[key] = error
                raise
        return given[key]

    return asked
