"""Parameters of a test that are for the slow runs, beside others for the default suite."""

import pytest


def late(*values):
    """Each of these values as a parameter that is marked slow."""
    return [pytest.param(v, marks=pytest.mark.slow) for v in values]
