"""Accuracy against time: error and cost of every setting, and the cheapest within a tolerance."""
