"""Ways of a ball on a round tube for `Session`: touch, slide, jitter, roll, jump, lift, a bad pose.

Numbers come from a seed. `s` (mm), `phi` (rad) and depth (mm) of the ball's lowest point are turned
into poses of its centre; the tube is straight, along x.
"""

from typing import NamedTuple

import numpy as np

#: Radius of the ball, mm.
RADIUS = 5.0


class Way(NamedTuple):
    """Poses in order.

    Attributes:
        rotation: shape (poses, 3, 3).
        translation: mm; shape (poses, 3).
    """

    rotation: np.ndarray
    translation: np.ndarray


def turn(vector: np.ndarray) -> np.ndarray:
    """Rotation by a vector (Rodrigues)."""
    angle = np.linalg.norm(vector)
    x, y, z = vector / max(angle, 1e-300)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def placed(places: np.ndarray, outer: float) -> np.ndarray:
    """Centres of the ball from (s, phi, depth); shape (..., 3)."""
    s, phi, depth = np.moveaxis(np.asarray(places, float), -1, 0)
    r = outer + RADIUS - depth
    return np.stack([s, r * np.cos(phi), r * np.sin(phi)], axis=-1)


def random_way(count: int, outer: float, seed: int = 0, *, rolls: bool = True) -> Way:
    """A mixed way of `count` poses."""
    rng, places, turns = np.random.default_rng(seed), [np.array([75.0, 0.0, -1.0])], [np.zeros(3)]

    def lead(to, step):
        """In equal steps in s, arc and depth."""
        start, end = places[-1], np.asarray(to, float)
        size = np.linalg.norm((end - start) * [1, outer, 1])
        for share in np.linspace(0, 1, max(int(size / step), 1) + 1)[1:]:
            places.append(start + share * (end - start))
            turns.append(turns[-1])

    def somewhere(near, by):
        s, phi = near[0] + rng.normal(0, by), near[1] + rng.normal(0, by) / outer
        return np.clip(s, 25, 135), np.clip(phi, -1.1, 1.1)

    while len(places) < count:
        step = 10 ** rng.uniform(-2.2, -0.5)
        lead([*somewhere(places[-1], 0.5), rng.uniform(0.3, 3.5)], step)
        for _ in range(rng.integers(1, 5)):
            what = rng.choice(["slide", "jitter", "roll", "jump", "press", "nan"])
            last = places[-1]
            if what == "slide":
                lead([*somewhere(last, 6), last[2]], max(step, 0.05))
            elif what == "press":
                lead([*somewhere(last, 0.3), rng.uniform(0.1, 3.5)], step)
            elif what == "jump":
                s = last[0] + np.where(last[0] > 80, -20, 20)
                lead([s, last[1], last[2]], 100.0)
            elif what == "nan":
                places.append(np.full(3, np.nan))
                turns.append(turns[-1])
                places.append(last + [0.01, 0, 0])
                turns.append(turns[-1])
            else:
                size, still = 10 ** rng.uniform(-4, -1), turns[-1]
                for _ in range(20):
                    places.append(last + rng.normal(0, size, 3) * [1, 1 / outer, 1])
                    more = rng.normal(0, 0.02, 3) if what == "roll" and rolls else np.zeros(3)
                    still = still + more
                    turns.append(still)
        lead([*somewhere(places[-1], 1.5), -rng.uniform(0.2, 1)], step)
    turned = np.array([turn(v) for v in turns[:count]])
    return Way(turned, placed(np.array(places[:count]), outer))


def closed_loop(seed: int, steps: int, outer: float) -> np.ndarray:
    """Centres of the ball on a smooth loop that begins and ends in the air; (steps + 1, 3)."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 2 * np.pi, steps + 1)
    waves = np.arange(1, 4)[:, None]
    a, b = rng.normal(size=(2, 3, 3)) / np.arange(1, 4)
    wave = a @ np.sin(waves * t) + b @ (np.cos(waves * t) - 1)
    size = np.array([rng.uniform(0.5, 4), rng.uniform(0.5, 2.5) / outer, 0.2])
    depth = (1 - np.cos(t)) * rng.uniform(0.4, 1.7) - 0.3
    mid = np.array([rng.uniform(30, 130), rng.uniform(-0.6, 0.6), 0])
    places = mid + (size[:, None] * wave).T
    places[:, 2] = depth * np.exp(places[:, 2])
    return placed(places, outer)


def step_lengths(translation: np.ndarray, rotation: np.ndarray | None = None) -> np.ndarray:
    """Largest motion of a point of the ball from pose to pose, mm; shape (poses - 1,)."""
    size = np.linalg.norm(np.diff(translation, axis=0), axis=1)
    if rotation is not None:
        size += RADIUS * np.linalg.norm(np.diff(rotation, axis=0), axis=(1, 2)) / np.sqrt(2)
    return size
