r"""Laws of relaxation: what turns few numbers into the branches of `relaxation.filter`.

A law gives the reduced relaxation function G(t) of a sudden press, over what lasts: 1 + g(t).

- `prony-1` to `prony-4`: g = sum gamma_b exp(-t / tau_b), the times by tau_1 and the ratios of
  each to the one before, so that branches keep their order.
- `power`: g = gamma (t / 1 s)^-beta (a springpot beside a spring), by the trapezoidal rule of
  t^-beta = 1/Gamma(beta) int exp(-t/tau) tau^-beta d log tau, two nodes a decade. Between the
  shortest step and the longest record within 1e-3 of g, beta 0.05 to 0.4.
- `fung`: g = C int exp(-t/tau) d log tau from tau_1 to tau_2 (a box of times), by 12 Gauss nodes:
  within 1e-4 of g(0) for times up to 1e4 apart.

A new law is a word, an entry of `LAWS`, and the declarations of its numbers in
`trachea.material`.
"""

import functools
import math
from collections.abc import Callable, Mapping
from typing import NamedTuple, get_args

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, Float

from jaxtrachea._arguments import check_word
from jaxtrachea.relaxation.filter import Relaxation
from jaxtrachea.relaxation.steps import Branches
from jaxtrachea.relaxation.words import Word as Word

#: What the name of a number ends in where it is the skeleton's.
OF_SKELETON = "_skeleton"
#: Of `power`: nodes a decade, and decades beyond the span in which its nodes lie.
PER_DECADE, BELOW, ABOVE = 2, 1.0, 2.0
#: Nodes of `fung`.
NODES = 12


class Span(NamedTuple):
    """Times that records tell something about, s; plain numbers: they choose the branches.

    Attributes:
        shortest: between two samples.
        longest: of a record.
    """

    shortest: float
    longest: float


class RelaxationLaw(NamedTuple):
    """A law.

    Attributes:
        names: of its numbers.
        branches: from those by name, and the span.
    """

    names: tuple[str, ...]
    branches: Callable[[Mapping[str, Float[Array, ""]], Span], Branches]


def relaxation(
    word: Word, values: Mapping[str, Float[Array, ""]], span: Span, *, parts: bool = False
) -> Relaxation:
    """What relaxes, from the numbers of a law.

    Args:
        word: of the law (static), of either part.
        values: its numbers by name; those of the skeleton end in `_skeleton`.
        span: see `branches`.
        parts: whether the skeleton relaxes apart (static).

    Raises:
        ValueError: as `branches`.
    """
    check_word("law", word, Word)
    local = branches(word, values, span)
    if not parts:
        return Relaxation(local)
    own = {k.removesuffix(OF_SKELETON): v for k, v in values.items() if k.endswith(OF_SKELETON)}
    return Relaxation(local, branches(word, own, span))


def names(word: Word, *, parts: bool = False) -> tuple[str, ...]:
    """Names of the numbers that `relaxation` reads."""
    check_word("law", word, Word)
    local = LAWS[word].names
    return local + tuple(name + OF_SKELETON for name in local if parts)


def branches(word: Word, values: Mapping[str, Float[Array, ""]], span: Span) -> Branches:
    """The branches of a law.

    Args:
        word: of the law (static).
        values: its numbers by name; others are passed over.
        span: of the records; a law of few branches does not read it (static).

    Raises:
        ValueError: a number that is wanting, or a span that is none.
    """
    check_word("law", word, Word)
    law = LAWS[word]
    if wanting := [name for name in law.names if values.get(name) is None]:
        raise ValueError(f"the relaxation {word!r} needs {', '.join(wanting)}; none given")
    if not 0 < span.shortest <= span.longest < math.inf:
        raise ValueError(f"span is {tuple(span)} s; expected two times, 0 < shortest <= longest")
    return law.branches(values, span)


def _prony(count: int, values, span: Span) -> Branches:
    tau = [values["tau_1"]]
    for name in _names_of_prony(count)[count + 1 :]:
        tau.append(tau[-1] * values[name])
    return Branches(jnp.stack([values[f"gamma_{b + 1}"] for b in range(count)]), jnp.stack(tau))


def _names_of_prony(count: int) -> tuple[str, ...]:
    strengths = tuple(f"gamma_{b + 1}" for b in range(count))
    return (*strengths, "tau_1", *(f"tau_ratio_{b + 1}" for b in range(1, count)))


def _power(values, span: Span) -> Branches:
    """Nodes within and around the span; all slower ones hold, of all faster ones gamma tau counts.

    Both rests are geometric series, one branch each.
    """
    gamma, beta = values["gamma"], values["beta"]
    low, high = math.log10(span.shortest) - BELOW, math.log10(span.longest) + ABOVE
    count = math.ceil((high - low) * PER_DECADE) + 1
    log_tau = np.linspace(low, high, count) * math.log(10)
    width = float(log_tau[1] - log_tau[0])
    log_tau = jnp.asarray(log_tau, gamma.dtype)
    nodes = gamma * width * jnp.exp(-beta * log_tau - gammaln(beta))
    slower = nodes[-1] / jnp.expm1(beta * width)
    faster = nodes[0] / jnp.expm1((1 - beta) * width) * math.exp(width)
    tau = jnp.exp(log_tau)
    return Branches(
        jnp.concatenate([faster[None], nodes, slower[None]]),
        jnp.concatenate([tau[:1] * math.exp(-width), tau, jnp.full_like(tau[:1], jnp.inf)]),
    )


def _fung(values, span: Span) -> Branches:
    x, weight = np.polynomial.legendre.leggauss(NODES)
    tau_1, half = values["tau_1"], jnp.log(values["tau_2"] / values["tau_1"]) / 2
    x, weight = (jnp.asarray(v, half.dtype) for v in (x, weight))
    return Branches(values["C"] * half * weight, tau_1 * jnp.exp(half * (1 + x)))


#: Every law, by its word.
LAWS: Mapping[str, RelaxationLaw] = {
    **{
        f"prony-{n}": RelaxationLaw(_names_of_prony(n), functools.partial(_prony, n))
        for n in range(1, 5)
    },
    "power": RelaxationLaw(("gamma", "beta"), _power),
    "fung": RelaxationLaw(("C", "tau_1", "tau_2"), _fung),
}
assert tuple(LAWS) == get_args(Word)
