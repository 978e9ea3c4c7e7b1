"""Presses on deforming cross-sections: linear limit, work, derivatives, hard cases, statuses."""

import functools

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from sections_linear import linear_force

from jaxtrachea.mechanics import press as mat
from jaxtrachea.mechanics.sections import press as press_module
from jaxtrachea.mechanics.sections import system
from jaxtrachea.mechanics.sections.contact import place_on
from jaxtrachea.mechanics.sections.material import SectionMaterial
from jaxtrachea.mechanics.sections.press import SectionOptions, build, press_sections
from jaxtrachea.mechanics.sections.solve import _flat as flat
from jaxtrachea.mechanics.sections.solve import _newton as newton_step
from jaxtrachea.mechanics.sections.solve import _size as size_of_step
from jaxtrachea.mechanics.sections.solve import solve_path
from jaxtrachea.mechanics.sections.span import Wall, make_forms, make_span
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material

pytestmark = pytest.mark.compiling
RINGS = 10.0 * np.arange(1, 7)
LENGTH, RADIUS = 70.0, 11.7
VALUES = {
    "offset": 0.9, "EI_C": 24.2, "EI_M": 2.0, "Et_M": 0.68, "bed_n": 0.0186, "bed_t": 0.0018,
    "Gt_L": 20.9, "Et_L": 1.19, "D_L": 3.5, "c_W": 0.68, "c_K": 22.3, "rho": 1e-3, "k_end": 0.146,
    "c_end": 0.4, "footprint": 2.74, "c_n": 0.003, "c_t": 0.1, "c_t_ring": 0.01,
}  # fmt: skip
#: Gauss points of the work from 0 to 6 mm, and 6 mm.
POINTS, WEIGHTS = np.polynomial.legendre.leggauss(8)
PATH = np.append(3 * (POINTS + 1), 6.0)
SMALL = np.linspace(0.2e-4, 1e-4, 9)
LANES = 12  # of every call, so that all share one program


@functools.cache
def program(midline=False, dtype="float64"):
    geometry = Geometry.create(LENGTH, RINGS, radius=RADIUS, dtype=dtype)

    def one(values, s_c, phi_c, path):
        material = SectionMaterial(**values)
        return press_sections(
            geometry, material, s_c, phi_c, path, options=SectionOptions(midline=midline)
        )

    return jax.jit(jax.vmap(one))


def press(cases, midline=False, dtype="float64"):
    """Many presses (changed values, s_c, phi_c, path); as NumPy, one each."""
    got = []
    for i in range(0, len(cases), LANES):
        rows = cases[i : i + LANES]
        rows = rows + [({}, 30.0, 0.0, SMALL)] * (LANES - len(rows))
        values = {k: np.array([(VALUES | c[0])[k] for c in rows]) for k in VALUES}
        rest = (np.array([c[j] for c in rows]) for j in (1, 2, 3))
        arrays = jax.tree.map(lambda v: jnp.asarray(v, dtype), (values, *rest))
        out = jax.tree.map(np.asarray, program(midline, dtype)(*arrays))
        got += [jax.tree.map(lambda v, j=j: v[j], out) for j in range(LANES)]
    return got[: len(cases)]


def inward(p, phi):
    """Force along the inward normal and the circumference at phi."""
    normal, around = [0, -np.cos(phi), -np.sin(phi)], [0, -np.sin(phi), np.cos(phi)]
    return np.stack([p.force @ normal, p.force @ around], -1)


LINEAR = [
    ({"footprint": 1.0, **change}, s, phi, SMALL)
    for change, s, phi in [
        ({}, 30.0, 0.0),
        ({}, 35.0, 0.0),
        ({"k_end": np.inf}, 12.5, 1.0),
        ({"k_end": 0.0}, 8.0, -1.9),
        ({"rho": 0.3}, 62.0, np.pi / 2),
    ]
]


@pytest.mark.slow
def test_linear_limit():
    """Against the differential equations, linearised by hand; D = 1e-4 mm leaves 1e-6."""
    for case, got in zip(LINEAR, press(LINEAR), strict=True):
        change, s, phi, path = case
        p = VALUES | change | {"R": RADIUS, "alpha": 2 * np.pi / 3}
        p |= {"k_n": p["bed_n"], "k_t": p["bed_t"]}
        wanted = linear_force(p, LENGTH, RINGS, s, phi)
        force = inward(got, phi)[-1] / path[-1]
        np.testing.assert_allclose(force, wanted, atol=2e-5 * wanted[0])
        near = abs(phi) > np.pi / 2
        assert np.all(got.status == (PressStatus.NEAR_RING_END if near else PressStatus.OK))


WORK = [({}, 30.0, 0.0, PATH), ({}, 33.0, 1.0, PATH), ({}, 40.0, np.pi / 2, PATH),
        ({"c_K": 0.0}, 25.0, -1.5, -0.7 * PATH)]  # fmt: skip


@pytest.mark.slow
def test_work_is_the_stored_energy():
    """8 Gauss points of the force along the path; a draw as well."""
    for case, got in zip(WORK, press(WORK), strict=True):
        assert np.all(got.status == PressStatus.OK)
        assert np.all(got.imbalance < 1e-10)
        force = inward(got, case[2])[:, 0]
        work = case[3][-1] / 2 * (WEIGHTS @ force[:-1])
        assert work == pytest.approx(got.energy[-1], rel=1e-8)
        # The tool's way is local indentation and motion of the surface.
        way = got.depth + got.skeleton
        normal = np.array([0, -np.cos(case[2]), -np.sin(case[2])])
        np.testing.assert_allclose(way, case[3][:, None] * normal, atol=1e-12)


@pytest.mark.slow
def test_the_midline_program_is_the_other_one():
    cases = [({}, 33.0, 0.0, PATH), ({"k_end": np.inf}, 0.0, 0.0, PATH), ({}, 70.0, 0.0, -PATH)]
    for one, other in zip(press(cases, midline=True), press(cases), strict=True):
        assert np.all(one.status == PressStatus.OK)
        for name in ("force", "skeleton", "joints", "end_U", "end_V", "modes", "energy"):
            a, b = getattr(one, name), getattr(other, name)
            np.testing.assert_allclose(a, b, atol=1e-9 * max(1, np.abs(b).max()), err_msg=name)
    off = press([({}, 33.0, 0.1, PATH)], midline=True)[0]
    assert np.all(off.status == PressStatus.OFF_PLAN)
    assert np.all(np.isnan(off.force))


@pytest.mark.slow
@pytest.mark.compiling
def test_continuous_where_the_contact_crosses_a_ring_or_mid_span():
    places = [29.999, 30.0, 30.001, 34.999, 35.0, 35.001]
    changes = ({}, {"footprint": 1.0})
    got = press([(change, s, 0.9, PATH) for change in changes for s in places])
    force = np.stack([p.force[-1] for p in got]).reshape(4, 3, 3)
    assert np.all(np.abs(np.diff(force, axis=1)) < 3e-3)
    np.testing.assert_allclose(force[:, 0] + force[:, 2], 2 * force[:, 1], atol=2e-3)
    with_footprint = np.abs(np.diff(force[:1], axis=1))
    assert np.all(with_footprint < 1e-6)  # on the ring


HARD = {
    "10 mm": ({}, 30.0, 0.0, np.linspace(2, 10, 9)),
    "10 mm at 90 deg": ({}, 30.0, np.pi / 2, np.linspace(2, 10, 9)),
    "draw": ({}, 35.0, 0.7, -PATH),
    "on a clamp": ({}, 0.0, 0.3, PATH),
    "at the ring's end": ({}, 35.0, 2 * np.pi / 3, PATH),
    "hard rings": ({"EI_C": 24e4, "EI_M": 2e4}, 35.0, 0.7, PATH / 2),
    "soft wall": ({"Gt_L": 2e-3, "Et_L": 1e-4, "D_L": 4e-4}, 30.0, 0.7, PATH / 2),
    "hard wall": ({"Gt_L": 2e5, "Et_L": 1e4, "D_L": 4e4}, 35.0, 0.7, PATH / 2),
    "hard bed": ({"bed_n": 189.0, "bed_t": 18.0}, 35.0, 0.7, PATH / 2),
    "soft bed": ({"bed_n": 2e-6, "bed_t": 2e-7}, 35.0, 0.7, PATH / 2),
    "hard muscle": ({"Et_M": 6.8e3}, 35.0, 0.7, PATH / 2),
    "one step, back and forth": ({}, 30.0, 0.7, np.array([6.0, -3, 0, 6, 6, 1, 2, -2, 4])),
}


@pytest.mark.slow
def test_hard_cases():
    """Every one is in balance, pushes back, and stores the energy that its force does."""
    for (name, case), got in zip(HARD.items(), press(list(HARD.values())), strict=True):
        rest = np.asarray(case[3]) == 0
        solved = PressStatus.NEAR_RING_END if name == "at the ring's end" else PressStatus.OK
        wanted = np.where(rest, PressStatus.NO_CONTACT, solved)
        np.testing.assert_array_equal(got.status, wanted, err_msg=name)
        force = inward(got, case[2])[:, 0]
        assert np.all(force * np.sign(case[3]) >= 0), name
        assert np.all(force[rest] == 0), name
        assert np.all(got.imbalance < 1e-6), (name, got.imbalance)
    # The state belongs to the displacement, not to the way there.
    repeated = press([HARD["one step, back and forth"]])[0].force
    np.testing.assert_allclose(repeated[[3, 4]], repeated[[0, 0]], atol=1e-10)


@pytest.mark.slow
def test_near_the_ends_of_the_rings_is_said():
    """From 90 degrees on, on either side; with values, also on the way; a lift-off is none."""
    right = np.asarray(np.pi / 2, "float64").astype(float)
    angles = [right, right * (1 + 1e-5), -right, -right * (1 + 1e-5), 2.0]
    path = np.append(PATH[:-1], 0.0)
    got = press([({}, 30.0, phi, path) for phi in angles], dtype="float64")
    for phi, row in zip(angles, got, strict=True):
        wanted = PressStatus.OK if abs(phi) <= right else PressStatus.NEAR_RING_END
        assert np.all(row.status[:-1] == wanted)
        assert row.status[-1] == PressStatus.NO_CONTACT
        assert np.all(np.isfinite(row.force))
    np.testing.assert_allclose(inward(got[1], angles[1]), inward(got[0], right), atol=1e-3)
    assert float(press_module.validated_angle(jnp.asarray(1.7))) == pytest.approx(1.7 - np.pi / 6)


@pytest.mark.slow
@pytest.mark.compiling
def test_deeper_than_the_radius_is_said():
    """By how far the wall moves: a tool on a soft spring may move further."""
    [got] = press([({}, 30.0, 0.0, np.array([1.0, 5, 11, 11.65, 12, 13, 14, 9, -2]))])
    moved = -got.skeleton[:, 1]
    assert np.all(np.isfinite(got.force))
    np.testing.assert_array_equal(got.status == PressStatus.TOO_DEEP, moved > RADIUS)
    assert np.sum(moved > RADIUS) == 3


@pytest.mark.slow
def test_past_a_fold():
    """Soft rings snap through under a tool on a soft spring: no row from there on looks valid.

    With a hard tool the force peaks at 0.0110 N, some 6 mm deep, and falls by more than 1e-3 N/mm:
    against a spring of 2000 mm/N there is no equilibrium for D above about 6 + 2000 * 0.011.
    """
    soft = {"EI_C": 24e-4, "EI_M": 2e-4, "c_K": 0.0, "c_W": 0.0,
            "Gt_L": 2e-3, "Et_L": 1e-4, "D_L": 4e-4}  # fmt: skip
    spring = soft | {"c_n": 2000.0}
    way = np.array([1.0, 3, 5, 6, 7, 8, 9, 10, 11])
    fold = np.array([5.0, 10, 15, 20, 25, 35, 20, 10, 5])
    cases = [(soft, 30.0, 0.0, way), (spring, 30.0, 0.0, fold), ({}, 30.0, 0.0, PATH)]
    hard, folded, other = press(cases)
    force = inward(hard, 0.0)[:, 0]
    assert np.all(hard.status == PressStatus.OK)  # held, it is stable all the way
    assert 2 < np.argmax(force) < 7
    top = np.max(way - 0.003 * force + 2000 * force)
    assert 25 < top < 35
    reached = np.arange(9) != 5
    wanted = np.where(reached, PressStatus.OK, PressStatus.PAST_FOLD)
    np.testing.assert_array_equal(folded.status, wanted)
    assert np.all(np.isnan(folded.force[5]) & np.isnan(folded.skeleton[5]))
    # On the way back it is where it was on the way there, between surface and spring.
    way = -folded.skeleton[:, 1] + 2000 * inward(folded, 0.0)[:, 0]
    np.testing.assert_allclose(way[reached], fold[reached], rtol=1e-9)
    np.testing.assert_allclose(folded.force[[6, 7, 8]], folded.force[[3, 1, 0]], atol=1e-12)
    assert np.all(other.status == PressStatus.OK)  # its neighbour


@pytest.mark.slow
def test_an_equilibrium_that_is_no_minimum_is_seen():
    """Where the force falls as the surface moves, a tool on a soft spring has one way down."""
    soft = VALUES | {"EI_C": 24e-4, "EI_M": 2e-4, "c_K": 0.0, "c_W": 0.0,
                     "Gt_L": 2e-3, "Et_L": 1e-4, "D_L": 4e-4}  # fmt: skip
    geometry = Geometry.create(LENGTH, RINGS, radius=RADIUS)

    @jax.jit
    def pressed(path):
        parts = build(
            geometry,
            SectionMaterial(**soft),
            jnp.asarray(30.0),
            jnp.asarray(0.0),
            jnp.asarray([1.0, 0.0]),
            midline=True,
        )
        return parts, solve_path(parts, path).state

    parts, states = pressed(jnp.asarray([3.0, 10.9, 11.0]))
    slope = float(states.force[2, 0, 0] - states.force[1, 0, 0]) / 0.1
    assert slope < -1e-3
    excess = jax.jit(lambda state, parts: system.excess_negative(
        system.linearise(state, jnp.asarray(0.0), parts)[1]))  # fmt: skip
    for row, give, wanted in (
        (2, 0.003, 0),
        (2, 0.9 / -slope, 0),
        (2, 1.1 / -slope, 1),
        (0, 1e4, 0),
    ):
        state = jax.tree.map(lambda v, row=row: v[row], states)
        assert int(excess(state, parts._replace(give=jnp.asarray([give])))) == wanted


@pytest.mark.slow
def test_accepted_states_are_equilibria():
    """Three more of Newton's steps move no mode: walls soft and stiff, paths fine and coarse."""
    geometry = Geometry.create(LENGTH, RINGS, radius=RADIUS)

    @jax.jit
    @jax.vmap
    def moved(values, path):
        place = tuple(jnp.asarray(v) for v in (34.0, 0.4, [1.0, 0.3]))
        parts = build(geometry, SectionMaterial(**values), *place, midline=False)
        found = solve_path(parts, path)

        def further(state, displacement):
            z = begin = flat(state)
            for _ in range(3):
                z = z - newton_step(z, displacement, parts)[0]
            return size_of_step(z - begin, parts)

        return found.solved, jax.vmap(further)(found.state, path)

    changes = [{}, {"EI_C": 2.4e3}, {"D_L": 3.5e2}, {"Gt_L": 0.2}, {}, {}]
    paths = np.array([np.linspace(0.75, 6, 8)] * 4 + [np.linspace(0.1, 0.8, 8), -PATH[:8] / 2])
    values = {k: jnp.asarray([(VALUES | v)[k] for v in changes]) for k in VALUES}
    solved, change = moved(values, jnp.asarray(paths))
    assert solved.all()
    assert np.max(change / np.abs(paths)) <= 1e-12


@pytest.mark.long
def test_refusals():
    nan = np.where(np.arange(9) == 4, np.nan, PATH)
    cases = {
        PressStatus.OFF_TUBE: ({}, 70.1, 0.0, PATH),
        PressStatus.BEHIND_GAP: ({}, 30.0, 2.2, PATH),
        PressStatus.BAD_MATERIAL: ({"bed_n": -1.0}, 30.0, 0.0, PATH),
        PressStatus.NON_FINITE: ({"EI_C": np.nan}, 30.0, 0.0, PATH),
    }
    zero = ({"Gt_L": 0.0}, 30.0, 0.0, PATH)
    blunt = ({"footprint": 0.5}, 30.0, 0.0, PATH)
    got = press([*cases.values(), zero, blunt, ({}, 30.0, 0.0, nan), ({}, np.nan, 0.0, PATH)])
    for status, row in zip([*cases, *[PressStatus.BAD_MATERIAL] * 2], got, strict=False):
        assert np.all(row.status == status)
        for v in (row.force, row.joints, row.end_U, row.modes, row.energy):
            assert np.all(np.isnan(v))
    wanted = np.where(np.arange(9) == 4, PressStatus.NON_FINITE, PressStatus.OK)
    np.testing.assert_array_equal(got[6].status, wanted)
    assert np.all(got[7].status == PressStatus.NON_FINITE)
    geometry = Geometry.create(LENGTH, RINGS)
    material = SectionMaterial(**(VALUES | {"EI_C": np.ones(5)}))
    with pytest.raises(ValueError, match=r"SectionMaterial.EI_C has 5 values; .* 6 values"):
        press_sections(geometry, material, 30.0, 0.0, PATH)


@pytest.mark.slow
def test_a_beam_on_springs_is_the_limit():
    """Rings that do not bend and uncoupled modes: the paper's ligament with shear on k_M.

    Also under a punch, of which both edges are in one span, in two, and far apart. The line has one
    local law for all of it, here each edge has its own: added by hand to the line's compliances at
    the edges, with c_12 from that of the punch, w = (c_11 c_22 - c_12^2) / (c_11 + c_22 - 2 c_12).
    """
    half_width = 2.4
    k_M, EI, GA, c_n = 0.216, 1402.0, 9.31, 0.003
    geometry = Geometry.create(160.0, 10.0 * np.arange(1, 16), radius=RADIUS)
    bed = k_M / (2 * np.pi / 3 * 10 * (RADIUS + 0.9))
    rigid = {
        "EI_C": 1e9,
        "EI_M": 1e9,
        "Et_M": 1e9,
        "bed_n": bed,
        "bed_t": bed,
        "Gt_L": GA,
        "Et_L": EI,
    }
    material = SectionMaterial(
        **(VALUES | rigid | {"k_end": np.inf, "footprint": 1.0, "D_L": 0.0, "c_n": c_n})
    )
    beam = Material(EI_L=EI, GA_L=GA, k_M=k_M, k_1=1 / c_n, k_3=0.0)
    options = mat.Options(shear=True)
    wide = mat.Options(shear=True, half_width=half_width)
    edges = jnp.asarray([-half_width, half_width] if half_width else [0.0])

    @jax.jit
    def force(s_c):
        along = jnp.asarray([1.0, 0.0])
        parts = build(geometry, material, s_c, 0 * s_c, along, midline=True, half_width=half_width)
        forms = make_forms(parts.grid, parts.shape)
        forms = jax.tree.map(jnp.zeros_like, forms)._replace(
            shear_front=jnp.eye(4)[None] / RADIUS, stretch_front=jnp.eye(3)[None] / RADIUS**3
        )
        wall = Wall(*(jnp.asarray(v) for v in (GA, EI, 0.0, 0.0, 0.0)))
        one = make_span(wall, jnp.asarray(10.0), forms, parts.shape)
        spans = jax.tree.map(lambda v: jnp.broadcast_to(v, (16, *v.shape)), one)
        nodes = jnp.concatenate([jnp.zeros(1), geometry.ring_positions, geometry.length[None]])
        place = place_on(nodes, s_c + edges, spans, jnp.asarray(1.0))
        a_1 = jnp.asarray([[1.0, 0.0, 0.0, 0.0]])
        place = place._replace(
            own=a_1[None, None] * place.own, shares=a_1[None, None, :, :, None] * place.shares
        )
        parts = parts._replace(spans=spans, place=place)
        r, tangent = system.linearise(system.at_rest(parts), jnp.asarray(1.0), parts)
        return -jnp.sum(system.solve_linear(tangent, r).force)

    @jax.jit
    def today(s_c):
        if half_width == 0:
            return mat.press(geometry, beam, s_c, jnp.asarray([1.0]), options).force[0]
        c_11, c_22 = mat.compliance(geometry, beam, s_c + edges, options)
        w = mat.compliance(geometry, beam, s_c[None], wide)[0]
        c_12 = w - jnp.sqrt((c_11 - w) * (c_22 - w))
        c_11, c_22 = c_11 + 2 * c_n, c_22 + 2 * c_n
        return (c_11 + c_22 - 2 * c_12) / (c_11 * c_22 - c_12**2)

    for s in (22.0, 70.0, 75.0, 107.0, *([] if half_width else [3.0])):
        s_c = jnp.asarray(s)
        assert float(force(s_c)) == pytest.approx(float(today(s_c)), rel=1e-6)
