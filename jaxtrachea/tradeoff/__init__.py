"""Accuracy against time: the choices as ladders, what each rung errs and costs, the cheapest."""
