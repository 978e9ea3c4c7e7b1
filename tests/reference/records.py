"""Records of presses from a beam of its own, with the faults that people record; numpy only."""

import numpy as np

#: Rings and length of the paper's Table 1, mm.
RINGS, LENGTH = np.linspace(10, 150, 15), 160.0
PLACES = (40.0, 60.0, 80.0, 100.0)


def compliance(EI, k_M, s):
    """Deflection under a unit force at s, mm/N: Hermite elements on springs, clamped ends."""
    x = np.unique([0, LENGTH, s, *RINGS])
    K = np.zeros((2 * len(x), 2 * len(x)))
    for e, h in enumerate(np.diff(x)):
        part = slice(2 * e, 2 * e + 4)
        K[part, part] += EI / h**3 * np.array(
            [[12, 6 * h, -12, 6 * h], [6 * h, 4 * h * h, -6 * h, 2 * h * h],
             [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h * h, -6 * h, 4 * h * h]]
        )  # fmt: skip
    for ring in RINGS:
        K[2 * np.argmin(abs(x - ring)), 2 * np.argmin(abs(x - ring))] += k_M
    at = 2 * int(np.argmin(abs(x - s)))
    load = np.zeros(2 * len(x))
    load[at] = 1
    return np.linalg.solve(K[2:-2, 2:-2], load[2:-2])[at - 2]


def force(D, c, k_1, k_3):
    """Force of k_1 d + k_3 d^3 in series with a compliance c, D = d + c F, by Newton steps."""
    D = np.maximum(D, 0.0)
    d = D / (1 + c * k_1)
    for _ in range(40):
        d = d - ((1 + c * k_1 + c * k_3 * d * d) * d - D) / (1 + c * k_1 + 3 * c * k_3 * d * d)
    return k_1 * d + k_3 * d**3


def clean(rng, count, samples, *, soft, first=0.0, noise=(0.002, 0.05)):
    """Displacements and forces of presses from first touch on, noise in shares of the peak.

    Of soft ones k_1 is small and k_3 large: their beginning looks like air.
    """
    D, F = [], []

    def draw(low, high):
        return np.exp(rng.uniform(np.log(low), np.log(high)))

    for _ in range(count):
        k_1, k_3 = (draw(0.02, 0.5), draw(1, 50)) if soft else (draw(0.5, 20), draw(0.01, 20))
        depth = rng.uniform(2, 8)
        d = np.linspace(first, depth, samples)
        if rng.random() < 0.5:
            d = np.sort(np.concatenate([[first], rng.uniform(first, depth, samples - 1)]))
        f = force(d, draw(0.05, 5), k_1, k_3)
        D.append(d)
        F.append(f + draw(*noise) * f.max() * rng.normal(size=samples))
    return D, F


def recorded(
    rng, count=1, *, air=0.0, preload=0.0, offset=0.0, slope=0.0, samples=50, noise=0.005,
    k_1=8.0, k_3=20.0, depth=5.0,
):  # fmt: skip
    """Places, displacements and forces of `count` presses at each of `PLACES`.

    EI_L 900 N mm^2, k_M 0.3 N/mm; recorded from `air` mm before first touch on or from a `preload`
    (N) on, with an offset (N) and a slope (N/mm) of the load cell.
    """
    s, D, F = [], [], []
    fine = np.linspace(0, 1, 3001)
    for k in range(count * len(PLACES)):
        place = PLACES[k % len(PLACES)]
        c = compliance(900.0, 0.3, place)
        before = np.interp(preload, force(fine, c, k_1, k_3), fine) if preload else 0.0
        d = np.linspace(0, depth, samples)
        f = force(d - air + before, c, k_1, k_3) + offset + slope * d
        s.append(place)
        D.append(d)
        F.append(f + noise * rng.normal(size=samples))
    return s, D, F
