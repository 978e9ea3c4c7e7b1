"""From curves and a model to estimates: problem, residual, solver, covariance."""
