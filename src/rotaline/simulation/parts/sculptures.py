"""A bust with a small ball on its nose, and a rubber duck with small bumps: free forms, as a plaster and a rubber model are."""

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from rotaline.simulation.parts.detailed_body import ComplexPart, DetailedBody
from rotaline.simulation.parts.loft import Rings, Spacing, fine_near, graded, half_ball, level, plateau, skin
from rotaline.simulation.parts.material import Material
from rotaline.simulation.parts.mesh import MeshPart


def bust() -> ComplexPart:
    """A head on a plinth, 46 mm high, face towards +x; a ball of 0.6 mm radius sits on the bridge of the nose."""
    phi = _columns(0.019, 0.0065, (0.0, 0.12))
    z = _heights(
        fine_near(0.3, 0.09, (26.3, 0.9), (20.6, 0.8), (23.4, 0.5), (4.2, 0.3), (2.2, 0.8)),
        crown=33.0,
        top=46.0,
    )[:, None]
    # half axes of the head's cross-section: forwards, backwards, sideways
    front = _profile(z, _BUST_Z, (12.6, 13.0, 13.0, 11.5, 8.8, 7.4, 7.2, 8.6, 11.6, 11.4, 11.5, 11.5, 11.3, 11.8, 11.9))
    back = _profile(z, _BUST_Z, (12.6, 13.0, 13.0, 11.5, 9.0, 8.0, 8.4, 9.0, 10.2, 11.6, 13.0, 14.1, 14.9, 15.2, 15.3))
    side = _profile(z, _BUST_Z, (12.6, 13.0, 13.0, 11.5, 8.8, 7.4, 7.4, 8.2, 9.3, 10.0, 10.6, 10.9, 11.1, 11.3, 11.3))
    dome = np.sqrt(1.0 - (np.maximum(z - 33.0, 0.0) / 13.0) ** 2)
    radius = _egg(phi, front * dome, back * dome, side * dome)
    x, y = radius * np.cos(phi), radius * np.sin(phi)

    face = np.cos(phi) > 0
    nose = np.interp(z, [22.7, 23.6, 24.3, 30.5, 32.0], [0.0, 2.6, 3.6, 0.9, 0.0])
    width = np.interp(z, [23.0, 25.0, 31.0], [1.9, 1.5, 1.2])
    features = nose * _bell(y / width)
    for eye in (-4.2, 4.2):
        features += -1.9 * _bell((y - eye) / 2.3, (z - 29.0) / 1.5) + 1.1 * _bell((y - eye) / 1.2, (z - 28.9) / 0.8)
    features += 0.7 * _bell((z - 31.4) / 0.8) * _bell(y / 6.5)  # brows
    features += 0.45 * _bell((z - 21.3) / 0.6, y / 2.6) + 0.5 * _bell((z - 19.8) / 0.7, y / 2.2)  # lips
    features += -0.5 * _bell((z - 20.6) / 0.28) * plateau(y, 2.0, 1.6)  # mouth
    features += 0.9 * _bell((z - 17.6) / 1.3, y / 2.6)  # chin
    features *= face
    ears = 2.4 * _bell((x + 1.2) / 1.5, (z - 26.8) / 2.8) - 1.5 * _bell((x + 0.7) / 0.7, (z - 27.2) / 1.4)
    features += ears * (np.abs(np.sin(phi)) > 0.7)
    hairline = 34.5 - 11.0 * plateau(np.pi - np.abs(phi), 1.35, 0.5)
    hair = plateau(np.minimum(z - hairline - 0.8, 0.0), 0.0, 0.8)
    features += hair * (0.7 + 0.16 * np.cos(22 * phi + 0.9 * np.sin(0.5 * z)) * dome)
    rings = _rings(phi, radius + features, z)

    body = DetailedBody.of(rings)
    ball, mole, dimple = (14.0, 0.0, 26.3), (9.5, 6.5, 22.5), (13.0, 0.0, 2.2)
    body = body.raised(half_ball(body.distances_from(ball), 0.6))
    body = body.raised(0.4 * _bell(body.distances_from(mole) / 0.45))
    body = body.raised(-0.4 * _cushion(body.distances_from(dimple), 0.9))
    vertices, triangles = skin(body.points)
    return ComplexPart(
        MeshPart(vertices, triangles, Material(0.85)),
        (
            body.detail("ball on the nose", ball, 0.6, 0.75),
            body.detail("mole", mole, 0.4, 1.0),
            body.detail("dimple in the plinth", dimple, -0.4, 1.0),
        ),
    )


_BUST_Z = (0.0, 0.5, 4.0, 4.3, 6.0, 9.0, 12.5, 15.0, 17.5, 20.5, 23.0, 26.0, 29.0, 32.0, 33.0)


def rubber_model() -> ComplexPart:
    """A toy duck, 42 mm long and 41 mm high, bill towards +x, with bumps of 0.5 mm around its breast and on its head."""
    phi = _columns(0.016, 0.009, (0.0, 0.3))
    s = np.linspace(0.0, 1.0, 2000)
    knots = np.linspace(0.0, 1.0, len(_DUCK))
    z, middle, front, back, side = PchipInterpolator(knots, np.array(_DUCK))(s).T
    path = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(z), np.hypot(np.diff(middle - back), np.diff(side))))])
    at = graded(0.0, float(path[-1]), fine_near(0.28, 0.2, (float(np.interp(29.0, z, path)), 2.5)))
    z, middle, front, back, side = (np.interp(at, path, values)[:, None] for values in (z, middle, front, back, side))
    radius = _egg(phi, front, back, side)
    x, y = middle + radius * np.cos(phi), radius * np.sin(phi)
    head = z > 21.0

    bill = 4.6 * _bell((z - 28.2) / 1.25) * plateau(y, 1.6, 3.2) * (np.cos(phi) > 0) * head
    bill -= 0.9 * _bell((z - 28.1) / 0.35) * plateau(y, 2.0, 2.6) * (np.cos(phi) > 0) * head
    tail = _bell((x + 18.0) / 2.6, y / 4.5) * plateau(z - 17.0, 3.5, 2.5)
    rings = level(x + bill - 1.6 * tail, y, z + 4.0 * tail)

    body = DetailedBody.of(rings)
    wing = np.hypot((x + 4.0) / 10.0, (z - 12.0 - 0.15 * (x + 4.0)) / 5.5)
    feathers = 0.16 * np.cos(2 * np.pi * (x + 0.8 * z) / 2.4)
    body = body.raised((1.0 + feathers) * plateau(wing, 0.85, 0.2) * (np.abs(y) > 4.0) * ~head)
    eyes = [(14.5, sign * 6.0, 33.0) for sign in (1.0, -1.0)]
    for eye in eyes:
        body = body.raised(0.6 * plateau(body.distances_from(eye), 0.5, 0.7))
    bumps = [
        (19.0 * np.cos(a), 15.0 * np.sin(a), height)
        for a in np.deg2rad([-40, -20, 0, 20, 40])
        for height in (8.0, 12.0)
    ]
    crest = [(7.0 + reach, 0.0, 41.0) for reach in (-4.0, 0.0, 4.0)]
    for bump in bumps + crest:
        body = body.raised(0.5 * _cushion(body.distances_from(bump), 0.8))
    vertices, triangles = skin(body.points)
    return ComplexPart(
        MeshPart(vertices, triangles, Material(0.6, 0.1, 15.0)),
        (
            body.detail("bump on the breast", bumps[5], 0.5, 1.0),
            body.detail("bump on the side of the breast", bumps[8], 0.5, 1.0),
            body.detail("bump on the head", crest[1], 0.5, 1.0),
            body.detail("left eye", eyes[0], 0.6, 1.4),
        ),
    )


_DUCK = (
    # z, middle x, half axes: forwards, backwards, sideways
    (0.0, 0.0, 13.5, 13.5, 10.0),
    (0.4, 0.0, 14.6, 14.6, 11.0),
    (4.0, 0.0, 18.4, 18.2, 14.2),
    (9.0, 0.0, 19.6, 20.2, 15.4),
    (13.0, 0.5, 18.6, 20.4, 15.0),
    (16.5, 2.0, 15.2, 20.0, 12.8),
    (18.7, 4.5, 10.8, 16.0, 10.0),
    (20.4, 7.0, 7.4, 10.0, 7.6),
    (22.0, 7.6, 7.6, 7.6, 7.6),
    (25.0, 7.4, 9.6, 9.4, 9.4),
    (30.0, 7.0, 10.6, 10.4, 10.4),
    (35.0, 7.0, 9.0, 8.8, 8.8),
    (38.6, 7.0, 5.8, 5.6, 5.6),
    (40.1, 7.0, 2.8, 2.8, 2.8),
    (40.4, 7.0, 0.2, 0.2, 0.2),
)


def _columns(coarse: float, fine: float, place: tuple[float, float]) -> Float[np.ndarray, " n"]:
    """Angles once around, from the back, finer at a place."""
    return graded(-np.pi, np.pi, fine_near(coarse, fine, place))[:-1]


def _heights(spacing: Spacing, crown: float, top: float) -> Float[np.ndarray, " m"]:
    """Heights of the rings: by ``spacing`` up to the crown, from there evenly along the dome up to just below the top."""
    dome = np.linspace(0.0, np.pi / 2, 60)[1:-1]
    return np.concatenate([graded(0.0, crown, spacing), crown + (top - crown) * np.sin(dome)])


def _profile(
    z: Float[np.ndarray, "m 1"], knots: tuple[float, ...], values: tuple[float, ...]
) -> Float[np.ndarray, "m 1"]:
    """A curve through knots without overshoot, constant above the last."""
    return np.asarray(PchipInterpolator(knots, values)(np.minimum(z, knots[-1])))


def _egg(
    phi: Float[np.ndarray, " n"],
    front: Float[np.ndarray, "m 1"],
    back: Float[np.ndarray, "m 1"],
    side: Float[np.ndarray, "m 1"],
) -> Float[np.ndarray, "m n"]:
    """Radius of an oval of two half ellipses."""
    along = np.where(np.cos(phi) > 0, front, back)
    return np.asarray(1.0 / np.sqrt((np.cos(phi) / along) ** 2 + (np.sin(phi) / side) ** 2))


def _rings(phi: Float[np.ndarray, " n"], radius: Float[np.ndarray, "m n"], z: Float[np.ndarray, "m 1"]) -> Rings:
    return level(radius * np.cos(phi), radius * np.sin(phi), z)


def _bell(*arguments: np.ndarray) -> np.ndarray:
    """1 at zero, falling smoothly on all sides: exp(-sum of squares)."""
    return np.asarray(np.exp(-sum(np.square(argument) for argument in arguments)))


def _cushion(distance: np.ndarray, radius: float) -> np.ndarray:
    """1 in the middle, falling to 0 at the radius with a horizontal tangent at both."""
    return np.where(distance < radius, 0.5 + 0.5 * np.cos(np.pi * np.minimum(distance / radius, 1.0)), 0.0)
