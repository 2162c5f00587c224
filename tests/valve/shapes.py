"""Simple surfaces whose measurements are known by hand."""

import numpy as np


def circle(radius, n=120, z=0.0):
    angle = np.arange(n) * 2 * np.pi / n
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(n, z)])


def bands(rings, close=False):
    """Triangles between consecutive rings of equal size; `close` joins the last to its centre."""
    n = len(rings[0])
    vertices = np.concatenate(rings)
    here = np.arange(n)
    after = (here + 1) % n
    triangles = []
    for k in range(len(rings) - 1):
        a, b, c, d = here + k * n, after + k * n, after + (k + 1) * n, here + (k + 1) * n
        triangles += [np.column_stack([a, b, c]), np.column_stack([a, c, d])]
    if close:
        last = (len(rings) - 1) * n
        tip = np.full(n, len(vertices))
        vertices = np.concatenate([vertices, rings[-1].mean(axis=0)[None]])
        triangles.append(np.column_stack([here + last, after + last, tip]))
    return vertices, np.concatenate(triangles)


def cone(radius=15.0, tip_radius=1e-3, height=12.0, n=180, layers=12):
    """Cone along +z from the annulus circle at z = 0, normals outwards of the funnel."""
    rings = []
    for s in np.linspace(0.0, 1.0, layers + 1):
        rings.append(circle(radius + s * (tip_radius - radius), n, s * height))
    return bands(rings)


def plate(corner, first, second, n=10):
    """Rectangle ``corner + s * first + t * second`` with normal along ``first x second``."""
    s, t = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1), indexing="ij")
    vertices = (
        np.asarray(corner, float)
        + s.ravel()[:, None] * np.asarray(first, float)
        + t.ravel()[:, None] * np.asarray(second, float)
    )
    number = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[1:, :-1], number[1:, 1:],
                                            number[:-1, 1:]))  # fmt: skip
    return vertices, np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def join(*surfaces):
    """One surface of several; also the triangles of each with their new numbers."""
    vertices, parts, offset = [], [], 0
    for points, triangles in surfaces:
        vertices.append(points)
        parts.append(triangles + offset)
        offset += len(points)
    return np.concatenate(vertices), np.concatenate(parts), parts


def box(size=(1.0, 1.0, 1.0)):
    """Closed box, twelve outward triangles."""
    x, y, z = size
    vertices = np.array(
        [[0, 0, 0], [x, 0, 0], [x, y, 0], [0, y, 0], [0, 0, z], [x, 0, z], [x, y, z], [0, y, z]],
        dtype=float,
    )
    quads = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
    triangles = [[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)]
    return vertices, np.array(triangles)


def sphere(radius=1.0, subdivisions=2):
    """Icosahedron subdivided and projected on the sphere, outward triangles."""
    g = (1 + 5**0.5) / 2
    vertices = [[-1, g, 0], [1, g, 0], [-1, -g, 0], [1, -g, 0], [0, -1, g], [0, 1, g], [0, -1, -g],
                [0, 1, -g], [g, 0, -1], [g, 0, 1], [-g, 0, -1], [-g, 0, 1]]  # fmt: skip
    triangles = [[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4],
                 [11, 10, 2], [10, 7, 6], [7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8],
                 [3, 8, 9], [4, 9, 5], [2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1]]  # fmt: skip
    points = [np.array(v, float) / np.linalg.norm(v) for v in vertices]
    for _ in range(subdivisions):
        middle, finer = {}, []
        for a, b, c in triangles:
            numbers = []
            for pair in ((a, b), (b, c), (c, a)):
                key = tuple(sorted(pair))
                if key not in middle:
                    middle[key] = len(points)
                    point = points[key[0]] + points[key[1]]
                    points.append(point / np.linalg.norm(point))
                numbers.append(middle[key])
            d, e, f = numbers
            finer += [[a, d, f], [d, b, e], [f, e, c], [d, e, f]]
        triangles = finer
    return radius * np.array(points), np.array(triangles)
