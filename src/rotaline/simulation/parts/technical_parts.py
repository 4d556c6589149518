"""A pipe connector with a thread, and a casting with flash at its parting line."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from rotaline.simulation.parts.detailed_body import ComplexPart, Detail, DetailedBody
from rotaline.simulation.parts.loft import Rings, between, circle, fine_near, graded, plateau, round_rings, skin
from rotaline.simulation.parts.material import Material
from rotaline.simulation.parts.mesh import MeshPart


def thread_connector() -> ComplexPart:
    """A plastic pipe connector: pipe, hexagon of 32 mm across flats, external thread of 32 mm with 2 mm pitch, 1.1 mm deep."""
    # a column at each corner of the hexagon, and more of them at the mark on the side at phi = 0
    corners = np.deg2rad(np.arange(-30.0, 331.0, 60.0))
    spacing = fine_near(0.018, 0.007, (0.0, 0.08))
    phi = np.concatenate([graded(a, b, spacing)[:-1] for a, b in pairwise(corners)])
    major, depth, pitch = 16.0, 1.1, 2.0
    bottom, top = 20.6, 38.0  # of the thread

    z = np.arange(bottom, top, 0.095)[:, None]
    along = (z / pitch - phi / (2 * np.pi)) % 1.0
    ridge = 0.5 + (0.25 - np.abs(along - 0.5)) * pitch / (depth * np.tan(np.pi / 6))  # flanks of 30 deg
    ridge = _soft_clip(ridge, 0.08)
    ends = np.minimum((z - bottom) * 1.5, (top - z) * 1.2)
    thread = np.minimum(major - depth + depth * ridge, major - depth - 0.5 + ends)

    hexagon = 16.0 / np.cos((phi + np.pi / 6) % (np.pi / 3) - np.pi / 6)
    z_hex = graded(10.0, 19.0, fine_near(0.4, 0.1, (10.7, 0.7), (14.5, 1.0), (18.3, 0.7)))[:, None]
    collar = np.minimum(hexagon, 15.7 + 1.9 * np.minimum(z_hex - 10.0, 19.0 - z_hex))

    rings = np.concatenate(
        [
            between(circle(phi, 12.0, 0.0), circle(phi, 12.6, 0.6), 3),
            between(circle(phi, 12.6, 0.6), circle(phi, 12.6, 10.0), 12),
            between(circle(phi, 12.6, 10.0), round_rings(phi, collar[:1], z_hex[:1]), 6),
            round_rings(phi, collar, z_hex),
            between(round_rings(phi, collar[-1:], z_hex[-1:]), circle(phi, 14.2, 19.0), 5)[1:],
            between(circle(phi, 14.2, 19.0), round_rings(phi, thread[:1], z[:1]), 5),
            round_rings(phi, thread, z),
            between(circle(phi, 14.3, top), circle(phi, 11.5, top), 6),
            between(circle(phi, 11.5, top), circle(phi, 11.0, top - 0.5), 2),
            between(circle(phi, 11.0, top - 0.5), circle(phi, 11.0, 0.5), 30),
            between(circle(phi, 11.0, 0.5), circle(phi, 11.5, 0.0), 2),
            between(circle(phi, 11.5, 0.0), circle(phi, 12.0, 0.0), 2),
        ]
    )
    body = DetailedBody.of(rings, pipe=True)
    mark = (16.0, 0.0, 14.5)
    body = body.raised(0.3 * plateau(body.distances_from(mark), 0.9, 0.25))
    depth_rounded = float(np.ptp(ridge)) * depth
    radial = np.array([1.0, 0.0, 0.0])
    crests = tuple(
        Detail(
            f"thread, turn {turn}", body.points[body.nearest((major, 0.0, height))], depth_rounded, radial, pitch / 2
        )
        for turn, height in ((2, 25.0), (5, 31.0), (7, 35.0))
    )
    vertices, triangles = skin(body.points, pipe=True)
    shape = MeshPart(vertices, triangles, Material(0.75, 0.1))
    return ComplexPart(shape, (*crests, body.detail("raised mark", mark, 0.3, 1.2)))


def casting_with_flash() -> ComplexPart:
    """An aluminium casting of 34 x 28 mm with ribs, a boss with a hole, and flash 0.3-0.4 mm thick around its parting line."""
    phi = _casting_columns()
    parting, top = 16.0, 30.0

    def outline(z: np.ndarray) -> np.ndarray:
        draft = 0.035 * np.abs(z - parting)
        return _rounded_rectangle(phi, 17.0 - draft, 14.0 - draft)

    # the flash is ragged: up to 0.8 mm wide, 0.4 mm thick at its root
    ragged = 0.72 + 0.06 * np.sin(7 * phi + 1.0) + 0.02 * np.sin(31 * phi)
    at_parting = outline(np.array([[parting]]))

    def flash(fraction: float, offset: float) -> Rings:
        return round_rings(phi, at_parting + fraction * ragged, np.array([[parting + offset]]))

    lower = np.concatenate(
        [np.linspace(0.8, 2.5, 6), graded(2.8, parting - 0.2, fine_near(0.45, 0.06, (parting - 0.2, 0.1)))]
    )
    upper = graded(parting + 0.2, top - 1.0, fine_near(0.45, 0.06, (parting + 0.2, 0.1)))
    edge = np.linspace(0.0, np.pi / 2, 8)[1:]
    rounded_z = (top - 1.0 + np.sin(edge))[:, None]
    rim = outline(np.array([[top - 1.0]]))
    boss, hole = circle(phi, 9.4, top), circle(phi, 4.5, top + 7.0)

    rings = np.concatenate(
        [
            between(round_rings(phi, outline(np.array([[0.0]])) - 0.8, np.array([[0.0]])), _bare(phi, outline, 0.8), 5),
            round_rings(phi, outline(lower[:, None]), lower[:, None]),
            between(_bare(phi, outline, parting - 0.2), flash(1.0, -0.15), 9)[1:],
            between(flash(1.0, -0.15), flash(1.0, 0.15), 4),
            between(flash(1.0, 0.15), _bare(phi, outline, parting + 0.2), 9),
            round_rings(phi, outline(upper[:, None]), upper[:, None]),
            round_rings(phi, rim - (1.0 - np.cos(edge))[:, None], rounded_z),
            between(round_rings(phi, rim - 1.0, np.array([[top]])), boss, 56)[1:],
            _fillet(phi, 9.4, top, 1.0),
            between(circle(phi, 8.4, top + 1.0), circle(phi, 8.1, top + 6.6), 20)[1:],
            between(circle(phi, 8.1, top + 6.6), circle(phi, 7.7, top + 7.0), 4),
            between(circle(phi, 7.7, top + 7.0), hole, 16),
            between(hole, circle(phi, 4.4, top - 2.0), 30),
            between(circle(phi, 4.4, top - 2.0), circle(phi, 0.3, top - 2.0), 20),
        ]
    )
    body = DetailedBody.of(rings)
    x, y, z = np.moveaxis(rings, -1, 0)
    on_side = plateau(z - 23.4, 4.0, 0.8) + plateau(z - 8.0, 4.8, 0.8)
    for at in _RIBS_Y:
        body = body.raised(1.0 * plateau(y - at, 0.5, 0.35) * on_side * (np.abs(x) > 12.0))
    pin, pip = (*_PIN, top), (0.0, -14.0, 23.0)
    body = body.raised(-0.4 * plateau(body.distances_from(pin), 1.0, 0.4))
    body = body.raised(0.5 * plateau(body.distances_from(pip), 0.7, 0.3))
    vertices, triangles = skin(body.points)
    middle = np.array([0.0, 0.0, parting])
    flash_details = tuple(
        Detail(name, middle + reach * direction, float(reach - start), direction, 1.2)
        for name, direction, reach, start in (
            ("flash, long side", np.array([0.0, 1.0, 0.0]), *_at(phi, np.pi / 2, at_parting[0], ragged)),
            ("flash, short side", np.array([1.0, 0.0, 0.0]), *_at(phi, 0.0, at_parting[0], ragged)),
        )
    )
    shape = MeshPart(vertices, triangles, Material(0.6, 0.25, 12.0))
    return ComplexPart(
        shape,
        (
            *flash_details,
            body.detail("rib", (17.0, _RIBS_Y[1], 23.0), 1.0, 1.2),
            body.detail("ejector pin mark", pin, -0.4, 1.5),
            body.detail("raised pip", pip, 0.5, 1.1),
        ),
    )


_RIBS_Y = (-5.0, 5.0)
_PIN = (13.0, 7.0)


def _casting_columns() -> Float[np.ndarray, " n"]:
    """Columns, more of them at the ribs and the ejector pin, and one exactly at each middle of a side."""
    ribs = [(float(np.arctan2(y, 17.0)) % (2 * np.pi), 0.07) for y in _RIBS_Y]
    ribs += [(np.pi - at, half) for at, half in ribs]
    places = [(at % (2 * np.pi), half) for at, half in ribs]
    spacing = fine_near(0.016, 0.0075, *places, (float(np.arctan2(_PIN[1], _PIN[0])), 0.09))
    quarters = [graded(k * np.pi / 2, (k + 1) * np.pi / 2, spacing)[:-1] for k in range(4)]
    return np.concatenate(quarters)


def _rounded_rectangle(phi: np.ndarray, half_x: np.ndarray, half_y: np.ndarray) -> np.ndarray:
    """Radius of a rectangle with rounded corners (a superellipse of power 8)."""
    return ((np.abs(np.cos(phi)) / half_x) ** 8 + (np.abs(np.sin(phi)) / half_y) ** 8) ** (-1 / 8)


def _bare(phi: np.ndarray, outline: Callable[[np.ndarray], np.ndarray], z: float) -> Rings:
    height = np.array([[z]])
    return round_rings(phi, outline(height), height)


def _fillet(phi: np.ndarray, radius: float, z: float, size: float) -> Rings:
    """From the plane at z, at ``radius``, upwards onto a cylinder ``size`` smaller: a hollow quarter of a circle."""
    angle = np.linspace(0.0, np.pi / 2, 9)[:, None]
    return round_rings(phi, radius - size * np.sin(angle), z + size * (1.0 - np.cos(angle)))


def _at(phi: np.ndarray, angle: float, start: np.ndarray, width: np.ndarray) -> tuple[float, float]:
    """Outer and inner radius of the flash at an angle."""
    column = int(np.abs(phi - angle).argmin())
    return float(start[column] + width[column]), float(start[column])


def _soft_clip(values: np.ndarray, softness: float) -> np.ndarray:
    """Values kept between 0 and 1, with rounded corners, reaching both exactly enough: within a hundredth of the softness."""
    return np.asarray(softness * (np.logaddexp(0.0, values / softness) - np.logaddexp(0.0, (values - 1.0) / softness)))
