"""How many lanes are computed together: one rule, by bytes.

A lane, or a start of one, takes some bytes while it is computed (`Study.bytes_per_lane`). Together
go as many as the memory nearest to the processor holds: on a CPU `CACHED` bytes, since more are out
of the cache before they are read again (docs/evidence/measured.md), and never fewer than `LONG` of
the longest curves; on another device what a part of its free memory holds. Either way at most
`max_slots`. Paths of a level that iterates go one by one on a CPU, and `PATHS` together elsewhere.

There are few sizes, since each is a program. Of fewer lanes than the memory holds a CPU takes the
largest size that they fill, and `FEWEST` of even fewer: less than half of what is computed is then
nobody's. On another device lanes that are nobody's cost nothing, and the next larger size does with
one call.

What is copied for the solver before it takes its lanes is at most `COPIED` bytes.
"""

import jax

#: Bytes of lanes computed together on a CPU, and lanes of the longest curves.
CACHED, LONG = 5 << 20, 16
#: Lanes of the smallest program, and of the next: sizes between them are not worth compiling.
FEWEST, NEXT = 4, 16
#: Lanes together at most, on a CPU and on another device (docs/evidence/gpu.md), and the part of
#: the free memory that they may take.
MOST_SLOTS, MOST_ELSEWHERE, PART_OF_MEMORY = 128, 1024, 0.5
#: Paths of a level that iterates that are computed together: all would take the memory.
PATHS = 16
#: Bytes of lanes that are copied for the solver at a time.
COPIED = 1 << 28
#: Starts, and their bytes, up to which a program is compiled without optimisation: it takes longer
#: to optimise than to run (docs/evidence/measured.md); and lanes evaluated in the time of a start.
UNOPTIMISED_LANES, UNOPTIMISED_BYTES, EVALUATIONS = 256, 24 << 20, 16


def on_cpu() -> bool:
    """Whether JAX names a CPU first."""
    return jax.default_backend() == "cpu"


def max_slots() -> int:
    """Lanes worth computing together at most on the device that JAX names first."""
    return MOST_SLOTS if on_cpu() else MOST_ELSEWHERE


def max_in_cache(bytes_per_lane: int) -> int:
    """Lanes worth computing together at most on a CPU, a power of two."""
    return 1 << (max(LONG, CACHED // bytes_per_lane).bit_length() - 1)


def max_in_memory(bytes_per_lane: int, free: float) -> int:
    """Lanes that a part of the free memory holds, a power of two and at least 1.

    Args:
        bytes_per_lane: as `Study.bytes_per_lane`.
        free: bytes.
    """
    return 1 << (max(1, int(PART_OF_MEMORY * free) // bytes_per_lane).bit_length() - 1)


def batch_size(total: int, most: int) -> int:
    """Lanes computed together, of few different sizes.

    Args:
        total: lanes in all; one alone is a program of its own.
        most: lanes together at most.
    """
    if total == 1:
        return 1
    if not on_cpu():
        return min(most, max(NEXT, 1 << (total - 1).bit_length()))
    return min(most, FEWEST if total < NEXT else 1 << (total.bit_length() - 1))


def worth_optimising(total: int, bytes_per_lane: int) -> bool:
    """Whether so many lanes take more time than it takes to optimise their program.

    Of a program without optimisation a lane takes about three times as long.
    """
    together = max(LONG, 1 << (total - 1).bit_length())
    return together > UNOPTIMISED_LANES or together * bytes_per_lane > UNOPTIMISED_BYTES


def copied_at_once(bytes_per_lane: int) -> int:
    """Lanes that are copied for the solver at a time."""
    return max(LONG, COPIED // bytes_per_lane)
