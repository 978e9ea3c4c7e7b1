"""Trials of a study against each other: differences at one position, uneven noise."""
