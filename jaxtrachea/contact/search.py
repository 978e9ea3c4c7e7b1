r"""The search for the contact normal: smallest value of a smooth function on the unit sphere.

With lengths over the size of the pair, the function is f(d) = h_A(d) + h_B(-d), |d| = 1. It has
one minimum when the shapes are apart and many when they overlap. A table of coarse directions gives
the starts; from each, saddle-free Newton steps in the tangent plane follow the minimum while beta
rises; the survivors finish with safeguarded steps. Fixed cost: no step depends on the outcome.

Where several minima are equally low, roundings must not choose: those within a tolerance well above
rounding count as equal, and of them the one furthest along a fixed direction in the frame of A is
taken. Steps against a gradient that is rounding alone are left out, so that a start on a level
circle, or on a saddle by symmetry, stays where it is.

Everything here works on numbers; derivatives are attached in `distance`.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea._arguments import check_record
from jaxtrachea._numerics import epsilon, largest, lowest, total
from jaxtrachea.contact.shapes import heights, log_mean

#: Sharpness times size at which annealing begins: the whole pair is then one smooth bowl.
FIRST_SHARPNESS = 100.0
#: Trust radius times sharpness (rad): the quadratic model holds over about one softmax width.
TRUST = 30.0
#: Longest step while annealing and longest trust radius, rad.
LONGEST, WIDEST = 0.06, 0.5
#: Smallest curvature taken at face value, relative to the size of the pair.
FLOOR = 1e-6
#: Which of equal normals is taken: the one furthest along this direction. At no small whole ratio
#: of the axes, so that it tells the normals of symmetric shapes apart.
PREFERRED = (0.7548776662, 0.5698402910, 0.3247179572)
#: Values that count as equal when one is chosen, and gradients that are none, in roundings.
EQUAL, NONE = 8, 8
#: Values that count as equal for the status, relative to the extent of the pair.
TIED = 1e-6
#: Curvature from which on a rounding of the gradient moves the direction by little.
CURVED = 1e-3
#: Share of the extent by which starts and survivors further along `PREFERRED` come first.
LEAD = 1e-5
#: Cosine from which on two directions belong to one minimum: 0.03 rad.
SAME = 1 - 5e-4
#: First trust radius of `descend`, rad, and its growth.
WIDE, GROWTH = 0.3, 3.0


@dataclasses.dataclass(frozen=True)
class Settings:
    """How sharp, and how much work. Static: not a pytree, hashable, a new one compiles anew.

    Attributes:
        sharpness: beta times the size of the pair. The distance comes out too small by at most
            log(N_A N_B) / sharpness of that size; curvatures of sharp edges grow with it.
        directions: in the coarse table, at least 16.
        starts: local minima of the table followed up, the direction between the centres included.
        survivors: of them, carried to full sharpness.
        coarse_steps: Newton steps on every start while the sharpness rises.
        fine_steps: on every survivor while it rises further.
        final_steps: safeguarded steps at full sharpness.
        warm_steps: safeguarded steps of `track`, which does nothing else.
    """

    sharpness: float = 1000.0
    directions: int = 256
    starts: int = 8
    survivors: int = 3
    coarse_steps: int = 4
    fine_steps: int = 6
    final_steps: int = 12
    warm_steps: int = 10

    def __post_init__(self):
        """Refuse settings that cannot work (`ValueError`)."""
        check_record(self)
        least = {"directions": 16, "starts": 1, "survivors": 1, "coarse_steps": 0}
        least |= {"fine_steps": 1, "final_steps": 1, "warm_steps": 1}
        for name, low in least.items():
            if getattr(self, name) < low:
                raise ValueError(f"{name}: expected at least {low}, found {getattr(self, name)}")
        if not self.sharpness > 0:
            raise ValueError(f"sharpness: expected a positive number, found {self.sharpness}")
        if not self.survivors <= self.starts <= self.directions:
            raise ValueError(
                "expected survivors <= starts <= directions, found "
                f"{self.survivors}, {self.starts}, {self.directions}"
            )


FAST = Settings(
    sharpness=300.0, directions=128, starts=6, survivors=3, fine_steps=4, final_steps=10
)
STANDARD = Settings()
#: For a point against a shape, many times over: there are fewer minima than of two bodies.
FOR_POINTS = Settings(starts=4, survivors=2)
FINE = Settings(
    sharpness=10_000.0,
    directions=512,
    starts=12,
    survivors=5,
    fine_steps=10,
    final_steps=16,
    warm_steps=16,
)
#: The named levels of accuracy; errors and times of each are in docs/evidence/contact.md.
LEVELS = {"fast": FAST, "standard": STANDARD, "fine": FINE}


class Pair(NamedTuple):
    """Vertices of both shapes in one frame, and the sharpness; all dimensionless.

    Radii are constants on the sphere of directions and take no part in the search. How often each
    vertex counts: see `Shape.counts`.
    """

    a: Float[Array, "3 n"]
    b: Float[Array, "3 m"]
    beta: Float[Array, ""]
    counts_a: Float[Array, " n"] | None = None
    counts_b: Float[Array, " m"] | None = None


class Model(NamedTuple):
    """f, its gradient and Hessian (entries 11, 12, 22) in the tangent plane at d."""

    value: Float[Array, ""]
    gradient: tuple[Float[Array, ""], Float[Array, ""]]
    hessian: tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]


def tangents(d: Float[Array, "3"]):
    """Two unit vectors that complete d to an orthonormal frame.

    Duff et al., "Building an orthonormal basis, revisited", J. Comput. Graph. Tech. 6(1) (2017).
    """
    sign = jnp.where(d[2] >= 0, 1, -1).astype(d.dtype)
    a = -1 / (sign + d[2])
    b = d[0] * d[1] * a
    first = jnp.stack([1 + sign * d[0] * d[0] * a, sign * b, -sign * d[0]])
    return first, jnp.stack([b, sign + d[1] * d[1] * a, -d[1]])


def _moments(vertices, counts, beta, d, e1, e2):
    """Support value, softmax means along (d, e1, e2), and beta times the tangent covariance."""
    along, s1, s2 = heights(vertices, d), heights(vertices, e1), heights(vertices, e2)
    if vertices.shape[1] == 1:  # a ball
        none = jnp.zeros_like(beta)
        return along[0], along[0], (s1[0], s2[0]), (none, none, none)
    value, p = log_mean(along, beta, counts)
    m1, m2 = total(p * s1), total(p * s2)
    r1, r2 = s1 - m1, s2 - m2
    spread = (total(p * r1 * r1), total(p * r1 * r2), total(p * r2 * r2))
    return value, total(p * along), (m1, m2), tuple(beta * v for v in spread)


def model(pair: Pair, d: Float[Array, "3"]) -> Model:
    """Second-order model of f at d on the sphere: Hessian = beta cov - (mean . d) I."""
    e1, e2 = tangents(d)
    h_a, m_a, g_a, c_a = _moments(pair.a, pair.counts_a, pair.beta, d, e1, e2)
    h_b, m_b, g_b, c_b = _moments(pair.b, pair.counts_b, pair.beta, -d, e1, e2)
    bend = m_a + m_b
    hessian = (c_a[0] + c_b[0] - bend, c_a[1] + c_b[1], c_a[2] + c_b[2] - bend)
    return Model(h_a + h_b, (g_a[0] - g_b[0], g_a[1] - g_b[1]), hessian)


def eigenvalues(hessian):
    """Smaller and larger eigenvalue of a symmetric 2x2 matrix."""
    a, b, c = hessian
    middle = 0.5 * (a + c)
    radius = jnp.sqrt(0.25 * (a - c) ** 2 + b * b)
    return middle - radius, middle + radius


def floor_of(hessian):
    """Smallest curvature to be told from none: FLOOR, or the rounding of the largest."""
    _, high = eigenvalues(hessian)
    return jnp.maximum(16 * epsilon(high.dtype) * high, FLOOR)


def extent(pair: Pair) -> Float[Array, ""]:
    """Largest coordinates of the pair: roundings of f and of its gradient are in units of it."""
    return _furthest(pair.a) + _furthest(pair.b)


def _furthest(vertices):
    """Largest coordinate."""
    return largest(largest(jnp.abs(vertices)))


def newton_step(m: Model, noise: Float[Array, ""] | float = 0.0):
    """-|H|^-1 g, downhill also at a saddle; |eigenvalues| not below FLOOR.

    Along an eigenvector no step is taken where the gradient is not above `noise` and the curvature
    so small that such a gradient would move the direction.
    """
    (g1, g2), (a, b, c) = m.gradient, m.hessian
    low, high = eigenvalues(m.hessian)
    # (H - middle I) g over the spread of the eigenvalues. Their difference would be rounded, and
    # with it the share of the gradient; below rounding any share is right.
    half = 0.5 * (a - c)
    least = epsilon(a.dtype) * jnp.maximum(jnp.maximum(jnp.abs(low), jnp.abs(high)), FLOOR)
    spread = jnp.maximum(2 * jnp.sqrt(half * half + b * b), least)
    h1, h2 = (half * g1 + b * g2) / spread, (b * g1 - half * g2) / spread

    def part(curvature, p1, p2):
        """Of the step, along one eigenvalue."""
        level = (p1 * p1 + p2 * p2 <= noise * noise) & (curvature < CURVED)
        inverse = jnp.where(level, 0, 1 / jnp.maximum(jnp.abs(curvature), FLOOR))
        return inverse * p1, inverse * p2

    u1, u2 = part(low, 0.5 * g1 - h1, 0.5 * g2 - h2)
    v1, v2 = part(high, 0.5 * g1 + h1, 0.5 * g2 + h2)
    return -u1 - v1, -u2 - v2


def _walk(d, step, trust):
    """Move along a tangent step no longer than `trust`, back onto the sphere; and its length."""
    e1, e2 = tangents(d)
    length = jnp.sqrt(step[0] ** 2 + step[1] ** 2)
    k = jnp.minimum(1, trust / jnp.maximum(length, jnp.finfo(d.dtype).tiny))
    moved = d + (k * step[0]) * e1 + (k * step[1]) * e2
    return moved / jnp.sqrt(total(moved * moved)), jnp.minimum(length, trust)


def anneal(pair: Pair, d, first, steps: int):
    """`steps` Newton steps while the sharpness rises from `first` towards `pair.beta`."""
    rate = jnp.log(pair.beta / first) / max(steps, 1)
    noise = _noise(pair)

    def body(d, i):
        beta = first * jnp.exp(rate * i)
        m = model(pair._replace(beta=beta), d)
        return _walk(d, newton_step(m, noise), jnp.minimum(TRUST / beta, LONGEST))[0], None

    return jax.lax.scan(body, d, jnp.arange(steps, dtype=d.dtype))[0]


def polish(pair: Pair, d, steps: int):
    """`steps` Newton steps at fixed sharpness that do not raise f; the direction and its f.

    A rise within rounding is let pass: close to the minimum f no longer tells two directions apart,
    but the gradient does.
    """

    def radii(trust, length, *_):
        return jnp.minimum(1.5 * trust, WIDEST), 0.25 * length

    return _newton(pair, d, steps, jnp.minimum(TRUST / pair.beta, WIDEST), radii)


def descend(pair: Pair, d, steps: int):
    """As `polish`, from a direction that may be 0.3 rad off, of a pair whose cores are apart.

    f is then convex. Of two flat faces it is a valley with a sharp floor, 1 / beta wide, on whose
    sides the Hessian says nothing: where the slope turns round along a step, the next one is as
    long as to the point where the tangents of both ends meet.
    """

    def radii(trust, length, d, m, new, m_new):
        fall, rise = _slope(d, m, new - d), _slope(new, m_new, new - d)
        turned = (fall < 0) & (rise > 0)
        meet = (m_new.value - m.value - rise) / jnp.where(turned, fall - rise, 1)
        meet = jnp.clip(meet, 0.1, 0.9)
        ahead = jnp.where(turned, (1 - meet) * length, jnp.minimum(GROWTH * trust, WIDEST))
        return ahead, jnp.where(turned, meet, 0.25) * length

    return _newton(pair, d, steps, jnp.asarray(WIDE, d.dtype), radii)


def _newton(pair: Pair, d, steps: int, trust, radii):
    """Newton steps that do not raise f, each within a radius; the direction and its f.

    Args:
        pair: the two shapes.
        d: start.
        steps: how many.
        trust: first radius.
        radii: from a radius, a step's length and both its ends with their models: the next radius
            where the step is taken, and where it is not.
    """
    slack = 8 * epsilon(d.dtype) * (1 + _furthest(pair.b))
    noise = _noise(pair)

    def body(carry, _):
        d, m, trust = _unpacked(carry)
        new, length = _walk(d, newton_step(m, noise), trust)
        m_new = model(pair, new)
        onward, back = radii(trust, length, d, m, new, m_new)
        better = m_new.value <= m.value + slack
        return jnp.where(better, _packed(new, m_new, onward), _packed(d, m, back)), None

    end, _ = jax.lax.scan(body, _packed(d, model(pair, d), trust), None, length=steps)
    return end[:3], end[3]


def _packed(d, m: Model, trust):
    """What a step hands to the next one as a single array: XLA copies each one that it is given."""
    return jnp.concatenate([d, jnp.stack([m.value, *m.gradient, *m.hessian, trust])])


def _unpacked(v):
    """Direction, model and radius from `_packed`."""
    return v[:3], Model(v[3], (v[4], v[5]), (v[6], v[7], v[8])), v[9]


def _slope(d, m: Model, way):
    """Change of f along a way from d, by its gradient there."""
    e1, e2 = tangents(d)
    return m.gradient[0] * total(e1 * way) + m.gradient[1] * total(e2 * way)


def _noise(pair: Pair):
    """A gradient up to this is rounding."""
    return NONE * epsilon(pair.a.dtype) * extent(pair)


@functools.lru_cache(None)
def coarse_directions(count: int):
    """Fibonacci directions (count, 3) and the seven nearest neighbours of each (count, 7)."""
    i = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * i / count), np.pi * (1 + 5**0.5) * i
    d = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], 1)
    return d, np.argsort(-d @ d.T, axis=1)[:, 1:8]


def sharp_table(vertices: Float[Array, "3 n"], count: int) -> Float[Array, " count"]:
    """max_i v_i . d over the coarse directions."""
    x, y, z = jnp.asarray(coarse_directions(count)[0].T, vertices.dtype)[:, :, None]
    u, v, w = vertices[:, None]
    return largest(x * u + y * v + z * w)


def starts(pair: Pair, table, centre, count: int):
    """The `count - 1` lowest local minima of the table, and the direction between the centres."""
    directions, neighbours = coarse_directions(table.shape[0])
    f = table + sharp_table(-pair.b, table.shape[0])
    f = f - LEAD * extent(pair) * jnp.asarray(directions @ np.asarray(PREFERRED), f.dtype)
    minimum = jnp.all(f[:, None] <= f[neighbours], axis=1)
    ranked = jnp.where(minimum, f, f + (jnp.max(f) - jnp.min(f)))
    best, _ = lowest(ranked, count - 1)
    return jnp.concatenate([jnp.asarray(directions, f.dtype)[best], centre[None]])


def find_normal(pair: Pair, table, centre, settings: Settings):
    """Direction of the lowest minimum found, and whether another one is as low.

    Args:
        pair: the two shapes.
        table: max_i v_i . d of A over the coarse directions.
        centre: unit vector from the centre of A to that of B.
    """
    s = settings
    first = jnp.minimum(jnp.asarray(FIRST_SHARPNESS, pair.beta.dtype), pair.beta)
    share = s.coarse_steps / (s.coarse_steps + s.fine_steps)
    middle = first * (pair.beta / first) ** share
    d = starts(pair, table, centre, s.starts)
    rough = pair._replace(beta=middle)
    d = jax.vmap(lambda d: anneal(rough, d, first, s.coarse_steps))(d)
    d = d[_survivors(pair, d, s.survivors)]

    def finish(d):
        d = anneal(pair, d, middle, s.fine_steps)
        return polish(pair, d, s.final_steps)

    return _choose(pair, *jax.vmap(finish)(d))


def _survivors(pair: Pair, d, count: int):
    """The lowest directions; of those that have come together only the lowest is kept first."""
    sharp = jax.vmap(lambda d: largest(heights(pair.a, d)) + largest(heights(-pair.b, d)))(d)
    rank = sharp - LEAD * extent(pair) * _along(d)
    together = jnp.sum(d[:, None] * d[None], axis=2) > SAME
    again = jnp.any(together & (rank[None] < rank[:, None]), axis=1)
    last = jnp.max(rank) - jnp.min(rank)
    return lowest(rank + jnp.where(again, last, 0), count)[0]


def _choose(pair: Pair, d, f):
    """The lowest direction, of equal ones the preferred one; whether separate ones are equal.

    Survivors in one minimum differ by how far they have come: the lowest of those is taken.
    """
    above = f - jnp.min(f)
    rounding = EQUAL * epsilon(f.dtype) * extent(pair)
    best = d[jnp.argmax(jnp.where(above <= rounding, _along(d), -2))]
    apart = jnp.sum(d * best[None], axis=1) < SAME
    equal = above <= jnp.maximum(2 * rounding, TIED * extent(pair))
    return d[jnp.argmin(jnp.where(apart, jnp.inf, f))], jnp.any(apart & equal)


def _along(d):
    """Components along `PREFERRED`."""
    x, y, z = PREFERRED
    return x * d[:, 0] + y * d[:, 1] + z * d[:, 2]
