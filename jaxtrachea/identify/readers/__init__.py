"""Readers of measured curves, one file format each; `identify.measurements` is the door."""
