"""A differentiable skeleton model of the trachea for parameter identification."""

__version__ = "0.1.0"
