"""The local contact law (paper eq. 1, quasi-static Duffing oscillator) and where it applies.

|F| = m_0 |omega_0^2 d + 3/4 beta_0^2 eps d^3| = k_1 d + k_3 d^3, and with a term that is not in the
paper + k_5 d^5. Only k_1, k_3 and k_5 can be identified; m_0 merely scales. The paper gives no
values for them. A law with k_3 < 0 or k_5 < 0 softens, and may have a fold (PAST_FOLD).

Everything else asks a law for its `force`, its `tangent` and its `series` (the equilibrium with a
compliance behind it), or for the same of a vector (`secant`, `root`); no other module knows its
coefficients. A new one is a field of `Law` and two declarations in `trachea.material`: of the same
name, and of its value on a ring.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrachea.mechanics.roots import (
    cubic_ratio,
    first_positive_root,
    quintic_past_fold,
    quintic_ratio,
)
from jaxtrachea.trachea.material import Material

#: What the name of a coefficient ends in where it is meant for a ring.
ON_RING = "_ring"


class Series(NamedTuple):
    """A local law in series with a compliance, one entry per displacement.

    Attributes:
        depth: local indentation, mm; NaN past the fold.
        force: N; NaN past the fold.
        folded: whether the displacement lies past the fold.
    """

    depth: Float[Array, "*n"]
    force: Float[Array, "*n"]
    folded: Bool[Array, "*n"]


class Law(NamedTuple):
    """An odd polynomial in the local indentation d: the sum of k_n d^n over the fields.

    What is None is no part of the law, nor of the program. With k_1 and k_3 alone the equilibrium
    of `series` is a closed form, with one coefficient more it is found by Newton steps.

    Attributes:
        k_1: N/mm; positive.
        k_3: N/mm^3; negative for a law that softens.
        k_5: N/mm^5; likewise. Not in the paper: silicone beyond 40 % strain needs it.
    """

    k_1: Float[Array, "..."]
    k_3: Float[Array, "..."]
    k_5: Float[Array, "..."] | None = None

    def coefficients(self) -> dict[str, Float[Array, "..."]]:
        """Those that are there, by name, in rising powers 1, 3, 5, ... of the indentation."""
        return {name: k for name, k in zip(self._fields, self, strict=True) if k is not None}

    def force(self, depth: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Contact force, N, at a local indentation, mm; odd in it."""
        value, *lower = reversed(self.coefficients().values())
        for k in lower:
            value = k + value * depth * depth
        return depth * value

    def tangent(self, depth: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Derivative of `force` by the local indentation, N/mm."""
        first, *rest = self.coefficients().items()
        return _horner([first[1], *(power(name) * k for name, k in rest)], depth * depth)

    def powers(self, depth: Float[Array, "*n"]) -> dict[str, Float[Array, "*n"]]:
        """Derivative of `force` by each coefficient: d^n by k_n, mm^n."""
        out, powered = {}, depth
        for name in self.coefficients():
            out[name] = powered
            powered = depth * depth * powered
        return out

    def secant(self, squared: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Force over indentation, N/mm, by the square of the indentation, mm^2."""
        return _horner(list(self.coefficients().values()), squared)

    def energy(self, squared: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Stored energy, N mm, by the square of the indentation, mm^2: the integral of `force`."""
        parts = [k / (power(name) + 1) for name, k in self.coefficients().items()]
        return squared * _horner(parts, squared)

    def stiffest(self, squared: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """As `secant`, of the parts that harden: no smaller indentation has a larger one."""
        first, *rest = self.coefficients().values()
        return _horner([first, *(jnp.maximum(k, 0) for k in rest)], squared)

    def softens(self) -> Bool[Array, "..."]:
        """Whether a part of the law softens, so that there may be a fold."""
        _, *rest = self.coefficients().values()
        return functools.reduce(jnp.logical_or, [k < 0 for k in rest])

    def in_unit(self, size: Float[Array, ""]) -> "Law":
        """The law for indentations in units of `size`, mm: k_n size^(n - 1), N/mm."""
        out = self.coefficients()
        for name in out:
            for _ in range(power(name) - 1):
                out[name] = out[name] * size
        return self._replace(**out)

    def series(self, displacement: Float[Array, "..."], compliance: Float[Array, "..."]) -> Series:
        """Solve d + c F(d) = D on the branch through d = 0, up to its fold (1 + c F' = 0).

        Unique for a law that nowhere softens. Derivatives, forward and reverse and to any order,
        are those of the equilibrium.

        Args:
            displacement: D, mm; any shape.
            compliance: c, mm/N, not negative; broadcasts against D.
        """
        depth, force = _series(displacement, compliance, self)
        return Series(depth, force, self._folded(displacement, compliance))

    def root(
        self,
        displacement: Float[Array, "..."],
        compliance: Float[Array, "..."],
        share: Float[Array, "..."] | float = 1,
    ) -> Float[Array, "..."]:
        """Indentation d, mm, with share d + c F(d) = D, see `series`; NaN past the fold.

        Raises:
            ValueError: a law of other powers than 1, 3 and 5.
        """
        delta, terms = _scaled(self, displacement, compliance, share)
        return delta * (cubic_ratio(*terms) if len(terms) == 1 else quintic_ratio(*terms))

    def under(self, force: Float[Array, "..."]) -> Float[Array, "..."]:
        """Indentation that the law by itself has under a force, mm; NaN past the fold."""
        return self.root(force, jnp.ones_like(force), 0.0)

    def _folded(self, displacement, compliance) -> Bool[Array, "..."]:
        terms = _scaled(self, displacement, compliance, 1)[1]
        if len(terms) == 1:
            return terms[0] <= -1  # the fold of `cubic_ratio`
        return quintic_past_fold(*terms)


def power(name: str) -> int:
    """Of the indentation, that a coefficient belongs to: 3 of `k_3` and of `k_3_ring`."""
    return int(name.removesuffix(ON_RING).removeprefix("k_"))


def coefficient(name: str) -> str | None:
    """Field of `Law` that a parameter of a material feeds, on ligament or ring; None: not one."""
    name = name.removesuffix(ON_RING)
    return name if name in Law._fields else None


def _horner(coefficients, x):
    """Polynomial in x with these coefficients in rising powers."""
    value, *lower = reversed(coefficients)
    for k in lower:
        value = k + value * x
    return value


def _scaled(law: Law, displacement, compliance, share):
    """The equilibrium in d = delta g: delta, and the arguments of `roots.*_ratio` for g."""
    first, *rest = law.coefficients().items()
    stiffening = share + compliance * first[1]
    delta = displacement / stiffening
    if [power(name) for name, _ in rest] not in ([3], [3, 5]):
        raise ValueError(f"a contact law of {list(law.coefficients())}; expected k_1, k_3 and k_5")
    factor = 6.75 if len(rest) == 1 else 1  # that of `cubic_ratio`
    terms = [factor * (compliance * k / stiffening) for _, k in rest]
    for i, (name, _) in enumerate(rest):
        for _ in range(power(name) - 1):
            terms[i] = terms[i] * delta
    return delta, terms


@jax.custom_jvp
def _series(displacement, compliance, law: Law):
    """Indentation and force of `Law.series`, with the derivatives of the equilibrium d + c F = D.

    Both are differentiated here: the derivative of F(d) by the law would be the difference of its
    growth at fixed d and of the growth of c F, which cancel on a soft skeleton.
    """
    depth = law.root(displacement, compliance)
    return depth, law.force(depth)


@_series.defjvp
def _series_jvp(primals, tangents):
    _, compliance, law = primals
    d_displacement, d_compliance, d_law = tangents
    solution = _series(*primals)
    # Without a solution derivatives are 0: NaN would be those of all rows by what they share.
    solved = jnp.isfinite(solution[1])
    depth, force, compliance = (jnp.where(solved, v, 0) for v in (*solution, compliance))
    slope = jnp.where(solved, law.tangent(depth), 0)
    share = jnp.where(solved, 1 / (1 + compliance * slope), 0)
    pushed = share * (d_displacement - force * d_compliance)
    grown = depth * d_law.secant(depth * depth)
    return solution, (pushed - (compliance * share) * grown, slope * pushed + share * grown)


def from_duffing(m_0, omega_0_squared, beta_0_squared_epsilon) -> Law:
    """The law from the paper's symbols: k_1 = m_0 omega_0^2, k_3 = 3/4 m_0 beta_0^2 eps.

    Args:
        m_0: mass of the virtual tool, in tonnes (so that tonne mm/s^2 = N).
        omega_0_squared: 1/s^2.
        beta_0_squared_epsilon: 1/(s^2 mm^2).
    """
    return Law(m_0 * omega_0_squared, 0.75 * m_0 * beta_0_squared_epsilon)


def duffing(depth: Float[Array, "*n"], law: Law) -> Float[Array, "*n"]:
    """Contact force, N, for a local indentation d, mm (odd in d): `Law.force`, as a function."""
    return law.force(depth)


def fold_depth(law: Law) -> Float[Array, "..."]:
    """Depth at which a softening law peaks, mm; inf where it nowhere does.

    sqrt(k_1 / (-3 k_3)) of a cubic law; with k_5 the first zero of k_1 + 3 k_3 d^2 + 5 k_5 d^4.
    """
    if len(law.coefficients()) > 2:
        k_1, *rest = law.coefficients().items()
        squared = first_positive_root(
            jnp.maximum(k_1[1], 0), *(power(name) * k for name, k in rest)
        )
        return jnp.where(
            jnp.isfinite(squared), jnp.sqrt(jnp.where(squared > 0, squared, 0)), jnp.inf
        )
    softening = law.k_3 < 0
    cubic = jnp.where(softening, -3 * law.k_3, 1)
    return jnp.where(softening, jnp.sqrt(jnp.maximum(law.k_1, 0) / cubic), jnp.inf)


def ring_weight(
    s_c: Float[Array, ""], ring_positions: Float[Array, " n"], transition: Float[Array, ""]
) -> Float[Array, ""]:
    """How much the contact rests on a ring: 1 on a ring's centre, 0 beyond `transition`, C2 in s_c.

    1 - prod_i (1 - (1 - t_i^2)^3), t_i = min(|s_c - x_i| / transition, 1): smooth also where the
    neighbourhoods of two rings overlap.

    Args:
        s_c: contact position, mm.
        ring_positions: mm; shape (n,).
        transition: distance from a ring's centre at which the ligament's law is reached, mm.
    """
    return 1 - jnp.prod(1 - on_one_ring(s_c - ring_positions, transition))


def on_one_ring(distance: Float[Array, "*m"], transition: Float[Array, ""]) -> Float[Array, "*m"]:
    """(1 - t_i^2)^3 of `ring_weight`, at a distance from the centre of one ring, mm."""
    t = jnp.clip(distance / transition, -1, 1)
    return (1 - t * t) ** 3


def of_ligament(material: Material) -> Law:
    """The law of the ligament."""
    return Law(**{name: getattr(material, name) for name in Law._fields})


def of_ring(material: Material) -> Law:
    """The law on a ring; a coefficient that is not given there is that of the ligament."""
    of_all = of_ligament(material)
    own = {name: getattr(material, name + ON_RING) for name in Law._fields}
    return of_all._replace(**{name: k for name, k in own.items() if k is not None})


def blend(ligament: Law, ring: Law, weight: Float[Array, ""]) -> Law:
    """Two-material law: compliances of ring and ligament mixed by `ring_weight`.

    1 / k_1 is the mean of both by weight, as of two springs in series that share the displacement;
    k_3 and k_5 are those of the same springs to leading order, k_1^(n + 1) times the mean of
    k_n / k_1^(n + 1). (A mean of stiffnesses lets a rigid ring rule all but a notch midway between
    two of them.) A coefficient that only one of them has counts as 0 in the other.
    """
    softer = (1 - weight) * ring.k_1 + weight * ligament.k_1
    softer = jnp.where(softer > 0, softer, 1)
    share = ring.k_1 / softer, ligament.k_1 / softer  # k_1 over that of ligament and ring
    part = 1 - weight, weight

    def mix(name, *both):
        terms = [
            p * k * s ** (power(name) + 1)
            for k, s, p in zip(both, share, part, strict=True) if k is not None
        ]  # fmt: skip
        return sum(terms[1:], terms[0]) if terms else None

    others = {n: mix(n, getattr(ligament, n), getattr(ring, n)) for n in Law._fields[1:]}
    return Law(ligament.k_1 * share[0], **others)  # pyright: ignore
