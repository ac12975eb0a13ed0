"""Links that everybody knows, as polylines."""

import numpy as np


def closed(points):
    points = np.asarray(points, float)
    return np.concatenate([points, points[:1]])


def turns(count):
    return np.linspace(0, 2 * np.pi, count, endpoint=False)


def circle(radius=1.0, centre=(0.0, 0.0, 0.0), axes=(0, 1), count=24):
    points = np.tile(np.asarray(centre, float), (count, 1))
    points[:, axes[0]] += radius * np.cos(turns(count))
    points[:, axes[1]] += radius * np.sin(turns(count))
    return closed(points)


def torus_link(k, count=60):
    """T(2, 2k): two curves that wind k times around each other; their linking number is k."""
    t = turns(count)

    def strand(phase):
        reach = 2 + 0.7 * np.cos(k * t + phase)
        return closed(np.stack([reach * np.cos(t), reach * np.sin(t), -0.7 * np.sin(k * t + phase)], axis=1))

    return strand(0), strand(np.pi)


def whitehead_link(count=60):
    """A circle and a figure of eight, which goes over the circle, under itself, over the circle, and so on.

    Going over and under in turn makes the diagram alternating; it is also reduced. Such a diagram shows the
    least number of crossings, here the five of the Whitehead link: the curves are linked, with number 0.
    """
    t = turns(count)
    eight = np.stack([2 * np.cos(t), np.sin(2 * t), np.sin(t) + 1.5 * np.sin(3 * t)], axis=1)
    return circle(1.0, count=count), closed(eight)


def borromean_rings(count=40):
    """Three ellipses in the planes of the axes, each inside the next."""
    long, short, zero = 2 * np.cos(turns(count)), np.sin(turns(count)), np.zeros(count)
    return tuple(
        closed(np.stack(rows, axis=1))
        for rows in ([long, short, zero], [zero, long, short], [short, zero, long])
    )


def random_rotation(rng):
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))
