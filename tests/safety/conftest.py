"""The published context, and a redesign in it that passes every rule."""

import pytest

from gateway.control.design import design_lqi
from tests.safety.case_support import case_of, gains, published


@pytest.fixture(scope="module")
def of():
    return published()


@pytest.fixture(scope="module")
def context(of):
    return of.context()


@pytest.fixture(scope="module")
def redesigned(of):
    return design_lqi(of.task())


@pytest.fixture
def case(of, context, redesigned):
    return case_of(gains(redesigned, context), context, of)
