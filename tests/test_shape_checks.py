"""The suite checks shapes: an array that does not fit what a function says is refused."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from jaxtrachea.optimisation.schur import trust_region_step


def test_shapes_that_do_not_fit_are_refused():
    """Before numpy sees them: the message names the function and the shapes that it wants."""
    fits = trust_region_step(1.0, np.ones(2), np.eye(2))
    assert fits.shape == (2,)
    with pytest.raises(TypeCheckError, match="trust_region_step"):
        trust_region_step(1.0, np.ones(2), np.eye(3))
