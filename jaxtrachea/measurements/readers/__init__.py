"""Readers of measured curves, one file format each; `measurements.read` is the door."""
