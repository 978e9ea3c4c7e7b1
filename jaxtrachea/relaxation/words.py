"""The words of the laws of relaxation, for specifications too: nothing here imports JAX."""

from typing import Literal

#: Each is an entry of `relaxation.laws.LAWS`.
Word = Literal["prony-1", "prony-2", "prony-3", "prony-4", "power", "fung"]
