"""The finite element specimen of fits/virtual_trachea, by stiffnesses from its moduli.

The factors of `material.Factors` were fitted to presses on this specimen, also to those below; what
is checked is that the errors are those which the page and the docstrings name.
"""

from pathlib import Path

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea.measurements.read import read_measurements
from jaxtrachea.mechanics.sections.material import Factors, Wall, from_wall, neutral_radius
from jaxtrachea.mechanics.sections.press import SectionOptions, press_sections
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry

pytestmark = pytest.mark.compiling
VIRTUAL = Path(__file__).parents[2] / "fits" / "virtual_trachea"
RINGS = 10.0 * np.arange(1, 16)
GEOMETRY = Geometry.create(160.0, RINGS, radius=11.7)


def test_the_composite_ring():
    """By hand: 1.04 mm of 0.65 MPa under 1.56 mm of 5.8 MPa, 4 mm wide, beside 6 mm of ligament."""
    assert neutral_radius(10.0) == pytest.approx(11.730, abs=1e-3)
    material = from_wall(GEOMETRY)
    one = material.EI_C / 1.08 * (1 - 0.45**2)
    np.testing.assert_allclose(one, 11.837 + 5.712, atol=2e-3)
    np.testing.assert_allclose(material.EI_M, 2.0)
    with pytest.raises(ValueError, match="h_C is 3.0 mm; expected at most"):
        Wall(h_C=3.0)


def test_a_tool_slides_as_cerruti_s_half_space():
    """The tangential load of a stuck disc, P / (2 pi a sqrt(a^2 - r^2)), by Cerruti's solution.

    Displacement along a unit load at a distance r: ((1 - nu) + nu cos^2) / (2 pi G r).
    """
    wall, a = Wall(), 3.0
    G = wall.E_L / 2 / (1 + wall.nu)
    turn, rise = np.meshgrid(
        2 * np.pi * np.arange(64) / 64, np.pi / 2 * (np.arange(64) + 0.5) / 64
    )  # r = a sin(rise), dr / sqrt(a^2 - r^2) = d rise
    pull = (1 - wall.nu + wall.nu * np.cos(turn) ** 2) / (2 * np.pi * G) / (2 * np.pi * a)
    slides = np.mean(pull) * 2 * np.pi * np.pi / 2
    material = from_wall(GEOMETRY, wall, Factors(slide=1.0), a)
    np.testing.assert_allclose([material.c_t, material.c_t_ring], slides, rtol=1e-12)


@pytest.mark.slow
def test_finite_strain_on_the_midline():
    """D to 6 mm: force within 3 % of its peak, markers 3 % of D (rms, none under the tool)."""
    curves = read_measurements(VIRTUAL / "finite_strain.h5").curves
    s_c = np.array([curve.s_c for curve in curves])
    keys = ("displacement", "force", "joint_displacement")
    D, force, markers = (np.array([getattr(curve, k)[1:] for curve in curves]) for k in keys)

    def one(s, path):
        return press_sections(
            GEOMETRY, from_wall(GEOMETRY), s, 0.0, path, options=SectionOptions(midline=True)
        )

    got = jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(jnp.asarray(s_c), jnp.asarray(D)))
    assert np.all(got.status == PressStatus.OK)
    off = np.abs(-got.force[..., 1] - force).max(1) / force.max(1)
    assert np.all(off < 0.03)
    away = np.abs(RINGS - s_c[:, None]) > 3
    error = (-got.joints[..., 1] - markers) / D[..., None]
    for row, far in zip(error, away, strict=True):
        assert np.sqrt(np.mean(row[:, far] ** 2)) < 0.03


@pytest.mark.slow
def test_finite_strain_off_the_midline():
    """30 and 90 degrees to 6 mm: force within 4.2 % of its peak, side force over it 0.065.

    Of the force itself, from 0.5 mm on, 7.5 %: a shallow press at 90 degrees is too stiff by that.
    """
    presses = [p for p in read_measurements(VIRTUAL / "off_midline.h5").curves if p.phi_c > 0]
    s_c, phi_c = (np.array([getattr(p, k) for p in presses]) for k in ("s_c", "phi_c"))
    keys = ("displacement", "force", "side_force")
    D, force, side = (np.array([getattr(p, k)[1:] for p in presses]) for k in keys)

    def one(s, phi, path):
        return press_sections(GEOMETRY, from_wall(GEOMETRY), s, phi, path)

    got = jax.jit(jax.vmap(one))(*map(jnp.asarray, (s_c, phi_c, D)))
    assert np.all(np.asarray(got.status) == PressStatus.OK)
    axes = np.array([[-np.cos(phi_c), -np.sin(phi_c)], [-np.sin(phi_c), np.cos(phi_c)]])
    found, aside = np.einsum("acp,pnc->apn", axes, np.asarray(got.force)[..., 1:])
    assert np.all(np.abs(found - force).max(1) < 0.042 * force.max(1))
    deep = D[0] >= 0.5
    assert np.all(np.abs(found / force - 1)[:, deep] < 0.075)
    assert np.all(np.abs(aside / found - side / force)[:, deep] < 0.065)


@pytest.mark.slow
def test_small_strain_off_the_midline():
    """Force within 8 %, side force 0.05 of it, markers and ring ends 3 % of D."""
    with h5py.File(VIRTUAL / "vectors.h5") as file:
        data = {name: column[()] for name, column in file.items()}
    rows = data["phi_c"] > 0
    data = {name: column[rows] for name, column in data.items()}
    D = 1e-3

    def one(s, phi):
        return press_sections(GEOMETRY, from_wall(GEOMETRY), s, phi, jnp.asarray([D]))

    got = jax.jit(jax.vmap(one))(jnp.asarray(data["s_c"]), jnp.asarray(data["phi_c"]))
    got = jax.tree.map(lambda v: np.asarray(v)[:, 0], got)
    for i, phi in enumerate(data["phi_c"]):
        frame = np.array([[0, -np.cos(phi), -np.sin(phi)], [0, -np.sin(phi), np.cos(phi)]])
        force, wanted = frame @ got.force[i] / D, frame @ data["force"][i]
        assert abs(force[0] / wanted[0] - 1) < 0.08
        assert abs(force[1] / force[0] - wanted[1] / wanted[0]) < 0.05
        far = np.abs(RINGS - data["s_c"][i]) > 3
        for name in ("joints", "end_U", "end_V"):
            error = getattr(got, name)[i] / D - data[name][i]
            assert np.sqrt(np.mean(error[far, 1:] ** 2)) < 0.03, name
