"""Measured force-displacement curves: readers, checks, loading rule; no JAX, no model."""
