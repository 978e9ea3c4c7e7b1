"""Inverses of blocks of given condition, and their inertia: against mpmath and eigenvalues.

The truth is of the matrix as the dtype holds it: mpmath's inverse with 40 digits, and the signs of
the eigenvalues by LAPACK in float64 (roundings of 1e-16, the smallest eigenvalue is 1e-6).

Tolerances: of such positive definite matrices elimination entry by entry has
errors of 0.015 eps cond (median of 400) and 0.3 eps cond (the largest). Pivots are not exchanged,
so that of indefinite ones the median is looser.
"""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from jaxtrachea.mechanics.sections import block

COUNT = 40
EPS = {np.float32: 1.2e-7, np.float64: 2.3e-16}
SIZES = [4, 7, 8, 14]


def spectra(rng, m, cond, negative=0):
    """Symmetric matrices with eigenvalues evenly in the logarithm from 1 to 1 / cond."""
    Q = np.linalg.qr(rng.normal(size=(COUNT, m, m)))[0]
    w = rng.permuted(np.tile(np.logspace(0, -np.log10(cond), m), (COUNT, 1)), axis=1)
    w[:, :negative] *= -1
    return (Q * w[:, None]) @ Q.transpose(0, 2, 1)


def true_inverse(A):
    if np.finfo(A.dtype).eps > 1e-10:  # of float32 float64 knows it to 1e-10
        return np.linalg.inv(A.astype(float))
    with mpmath.workdps(40):
        made = [mpmath.matrix(a.tolist()) ** -1 for a in A[:20]]
        return np.array([[[float(v) for v in row] for row in X.tolist()] for X in made])


inverse = jax.jit(jax.vmap(block.invert))


def errors(A, scale=1.0, *, symmetric=True):
    """Errors over the inverse, spectral norms with scales taken off, and the inertia."""
    X, negative = inverse(jnp.asarray(A))
    assert X.dtype == A.dtype
    frame = np.ones(A.shape[:2]) * scale
    truth = true_inverse(A)

    def size(v):
        v = v * (frame[: len(v), :, None] * frame[: len(v), None] if symmetric else
                 frame[: len(v), None] / frame[: len(v), :, None])  # fmt: skip
        return np.linalg.norm(v, 2, axis=(1, 2))

    return size(np.array(X, float)[: len(truth)] - truth) / size(truth), np.array(negative)


@pytest.mark.parametrize("m", SIZES)
@pytest.mark.parametrize(
    ("dtype", "cond"),
    [(np.float32, 1e2), (np.float32, 1e4), (np.float32, 1e6), (np.float64, 1e2), (np.float64, 1e6)],
)
def test_positive_definite(dtype, cond, m):
    """Errors of an elimination, not of its square; no false fold."""
    A = spectra(np.random.default_rng(m), m, cond).astype(dtype)
    assert np.linalg.eigvalsh(A.astype(float)).min() > 0
    error, negative = errors(A)
    assert np.median(error) < 0.1 * EPS[dtype] * cond
    assert error.max() < EPS[dtype] * cond
    np.testing.assert_array_equal(negative, 0)


@pytest.mark.parametrize("m", SIZES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [1, 2])
def test_inertia_of_indefinite(count, dtype, m):
    """No missed fold; pivots are not exchanged, so that single errors may be large."""
    for cond in (1e2, 1e4, 1e6):
        A = spectra(np.random.default_rng(m), m, cond, count).astype(dtype)
        wanted = np.sum(np.linalg.eigvalsh(A.astype(float)) < 0, axis=1)
        np.testing.assert_array_equal(wanted, count)
        error, negative = errors(A)
        np.testing.assert_array_equal(negative, wanted)
        assert np.median(error) < 0.3 * EPS[dtype] * cond


@pytest.mark.parametrize("m", [7, 14])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_scales_of_unknowns_cost_nothing(dtype, m):
    """Blocks of a stiff ring or a stiff muscle: cond of 1e10 by the sizes of unknowns alone."""
    rng = np.random.default_rng(m)
    size = rng.permuted(np.tile(np.logspace(0, 4, m), (COUNT, 1)), axis=1)
    A = spectra(rng, m, 1e2) * size[:, :, None] * size[:, None]
    assert np.linalg.cond(A).min() > 1e7
    error, negative = errors(A.astype(dtype), size)
    assert error.max() < 1e2 * EPS[dtype]
    np.testing.assert_array_equal(negative, 0)


@pytest.mark.parametrize("m", [4, 8])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [0, 1])
def test_one_plus_the_product_of_two(count, dtype, m):
    """I + S M of the contact, S diagonal: as many negative pivots as S^-1 + M has eigenvalues."""
    rng = np.random.default_rng(m)
    S = 10 ** rng.uniform(-3, 1, (COUNT, m))
    root = np.sqrt(S)
    for cond in (1e2, 1e4, 1e6):
        K = spectra(rng, m, cond, count)
        A = (K * root[:, :, None] / root[:, None]).astype(dtype)
        back = A.astype(float) / root[:, :, None] * root[:, None]
        wanted = np.sum(np.linalg.eigvalsh((back + back.transpose(0, 2, 1)) / 2) < 0, axis=1)
        np.testing.assert_array_equal(wanted, count)
        error, negative = errors(A, root, symmetric=False)
        np.testing.assert_array_equal(negative, wanted)
        assert np.median(error) < 0.3 * EPS[dtype] * cond


@pytest.mark.parametrize("m", [4, 8])
def test_modes_without_compliance_of_their_own(m):
    """On a ring the span gives nothing: S = 0, and the inverse is I there."""
    rng = np.random.default_rng(m)
    S = np.tile(np.where(np.arange(m) < m // 2, 0.0, 0.3), (COUNT, 1))
    A = np.eye(m) + S[:, :, None] * spectra(rng, m, 1e2)
    error, negative = errors(A, symmetric=False)
    assert error.max() < 1e-13
    np.testing.assert_array_equal(negative, 0)
    rows = inverse(jnp.asarray(A))[0][:, : m // 2]
    np.testing.assert_array_equal(rows, np.broadcast_to(np.eye(m)[: m // 2], rows.shape))


@pytest.mark.slow
@pytest.mark.compiling
def test_derivative_is_that_of_an_inverse():
    """-X dA X forward, -X^T c X^T reverse; for symmetric changes of symmetric matrices."""
    m = 14
    rng = np.random.default_rng(m)
    A, dA, c = (spectra(rng, m, 1e2)[0] for _ in range(3))
    X = np.linalg.inv(A)

    def value(A):
        return block.invert(A)[0]

    got, rate = jax.jit(lambda A, t: jax.jvp(value, (A,), (t,)))(A, dA)
    tolerance = 1e-11 * np.abs(X).max() ** 2
    np.testing.assert_allclose(got, X, atol=tolerance)
    np.testing.assert_allclose(rate, -X @ dA @ X, atol=tolerance)
    back = jax.jit(lambda A, c: jax.vjp(value, A)[1](c)[0])(A, c)
    np.testing.assert_allclose((back + back.T) / 2, -X @ c @ X, atol=tolerance)
