"""Predictions of a finished fit: presses at new positions, and comparison with measured curves."""
