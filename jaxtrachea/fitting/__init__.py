"""From curves and a model to estimates: study, residual, solver, covariance."""
