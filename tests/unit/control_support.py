"""A web for tests of control."""

import numpy as np

from gateway.core.web_model import WebModel


def model(n=6, stiffness=2400.0, length=1.0, radius=0.04, inertia=0.95, friction=10.0):
    """S_sim with n spans."""
    ones = np.ones(n)
    return WebModel(stiffness, length * ones, radius * ones, inertia * ones, friction * ones)
