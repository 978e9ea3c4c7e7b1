"""Scenes: specification, the effects that a scene needs, the plan, and the program of the plan."""
