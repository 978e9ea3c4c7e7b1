"""Least squares of many problems at once: knows no curve and no trachea."""
