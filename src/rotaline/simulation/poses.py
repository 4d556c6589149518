"""Where a plate is held so that a camera, a laser sheet and a turntable can be calibrated with it.

A pose is drawn at random, moved to where the image has room for it, and taken if the print is wholly in view, sharp, and seen
and lit from the front. ChArUco boards may be partly out of view: their corners have numbers.
"""

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.errors import RigError
from rotaline.geometry.primitives import unit
from rotaline.simulation.parts.boards import Plate
from rotaline.simulation.rig import Laser, Rig
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import CharucoBoard

V = TypeVar("V")

_ATTEMPTS = 80
"""Poses drawn before the next distance is tried, for each pose that is wanted."""

_DISTANCES = tuple(float(1.08**k) for k in range(10))
"""Where a plate fills the view, it is moved away, up to twice as far."""

_MAX_DEFOCUS = 0.08
"""Blur of a plate that is out of focus, at most, in pitches of its print."""

_TURN_AND_FREEDOM = ((0.0, 1.0), (0.0, 0.3), (np.pi / 2, 1.0), (np.pi / 2, 0.3))
"""Where a plate fills the view of the laser sheet, it is held straighter, then turned in its plane."""

_CORNERS = ((-1, -1), (1, 1), (-1, 1), (1, -1), (0, 0))


def in_image(
    camera: CameraModel, points_camera: Float[np.ndarray, "n 3"], margin_px: float = 0.0
) -> Bool[np.ndarray, " n"]:
    """Whether points are in front of the camera and in the image, at least ``margin_px`` from its border."""
    uv = camera.project(points_camera)
    inside = np.all((uv >= margin_px) & (uv <= np.array(camera.image_size) - 1 - margin_px), axis=1)
    # a strong distortion folds: what is far outside may be projected into the image
    seen = points_camera[inside]
    back = camera.rays(uv[inside])[:, :2]
    inside[inside] = np.all(np.abs(back - seen[:, :2] / seen[:, 2:]) < 1e-6, axis=1)
    return np.asarray(inside)


def view_mm(camera: CameraModel, depth_mm: float) -> Float[np.ndarray, "2"]:
    """Width and height that a camera sees at a depth, mm."""
    return np.array(camera.image_size) / (camera.fx, camera.fy) * depth_mm


def in_fan(laser: Laser, points_base: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Whether the fan of the laser reaches as far to the side as these points."""
    rays = points_base - laser.position_base
    return np.asarray(rays @ laser.beam_base > np.cos(np.radians(laser.fan_deg / 2)) * np.linalg.norm(rays, axis=1))


def is_sharp(rig: Rig, plate: Plate, depths_mm: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Whether the print can be measured at these depths: defocus blurs it by less than a small part of its pitch."""
    defocus_px = np.sqrt(np.maximum(rig.optics.blur_px_at(depths_mm, rig.camera.fx) ** 2 - rig.optics.blur_px**2, 0.0))
    return np.asarray(defocus_px * depths_mm <= _MAX_DEFOCUS * rig.camera.fx * plate.target.pitch)


def _is_visible(rig: Rig, plate: Plate, camera_from_board: RigidTransform) -> bool:
    # the white rim around the print may be cut off
    corners = camera_from_board.apply(plate.print_corners_board())
    if np.any(corners[:, 2] <= 0) or not np.all(is_sharp(rig, plate, corners[:, 2])):
        return False
    margin_px = 0.013 * min(rig.camera.image_size)
    if isinstance(plate.target, CharucoBoard):
        return float(in_image(rig.camera, camera_from_board.apply(plate.target.points_board()), margin_px).mean()) > 0.6
    return bool(np.all(in_image(rig.camera, corners, margin_px)))


def _facing(direction: np.ndarray, up: np.ndarray, roll_rad: float) -> Rotation:
    """Orientation of a board whose front looks along ``direction``, its top towards ``up``, then turned in its plane."""
    z = -unit(direction)
    y = unit(-up + (up @ z) * z)
    return Rotation.from_matrix(np.column_stack([np.cross(y, z), y, z])) * Rotation.from_rotvec([0.0, 0.0, roll_rad])


def _board_at(centre: np.ndarray, rotation: Rotation, plate: Plate) -> RigidTransform:
    return RigidTransform.from_components(centre - rotation.apply(plate.centre_board()), rotation)


def _pixel_with_room(
    camera: CameraModel, plate: Plate, camera_from_board: RigidTransform, fraction: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "2"]:
    """Where the plate's middle goes, px: ``fraction`` (-1 to 1) of the way from the image's middle to where the plate meets the border.

    ``camera_from_board`` has the middle of the plate in the middle of the image.
    """
    middle = (np.array(camera.image_size) - 1) / 2
    uv = camera.project(camera_from_board.apply(plate.corners_board()))
    least = 0.15 if isinstance(plate.target, CharucoBoard) else 0.0
    room = np.where(fraction > 0, 2 * middle - uv.max(axis=0), uv.min(axis=0))
    room = np.clip(np.nan_to_num(room), -middle, middle)
    return np.asarray(middle + fraction * np.maximum(room, least * middle))


def _poses_that_fit(
    n: int,
    draw: Callable[[int, V], RigidTransform],
    fits: Callable[[RigidTransform], bool],
    variants: tuple[V, ...],
) -> list[RigidTransform]:
    """n poses of the first variant that has as many, else the most that a variant has."""
    best: list[RigidTransform] = []
    for variant in variants:
        poses: list[RigidTransform] = []
        for index in range(n):
            drawn = (draw(index, variant) for _ in range(_ATTEMPTS))
            pose = next((pose for pose in drawn if fits(pose)), None)
            if pose is None:
                break
            poses.append(pose)
        best = poses if len(poses) > len(best) else best
        if len(best) == n:
            break
    return best


def _why(rig: Rig, plate: Plate, depth_mm: float) -> str:
    x0, x1, y0, y1 = plate.extent
    width, height = view_mm(rig.camera, depth_mm)
    depths = np.linspace(0.3, 3.0, 541) * depth_mm
    sharp = depths[is_sharp(rig, plate, depths)]
    text = f"The plate is {x1 - x0:.0f} x {y1 - y0:.0f} mm; at a distance of {depth_mm:.0f} mm the camera sees {width:.0f} x {height:.0f} mm"
    if len(sharp) == 0:
        return f"{text}, and the print is sharp nowhere near. Take a larger f-number, a coarser target, or another focus distance."
    if len(sharp) < len(depths):
        text += f", and the print is sharp from {sharp[0]:.0f} to {sharp[-1]:.0f} mm"
    return f"{text}. Take a smaller target, move the camera away, or take a shorter focal length or a larger f-number."


def _usual_depth(rig: Rig, what: str) -> float:
    """Depth at which plates are held, mm: what is in focus, else where the table is."""
    table_mm = float(rig.camera_from_base.translation[2])
    if table_mm <= 0:
        raise RigError(
            f"{what}: the camera looks away from the table: the middle of the table top lies {-table_mm:.0f} mm behind it. "
            "Point it at the middle of the table."
        )
    return table_mm if rig.optics.focus_mm is None else rig.optics.focus_mm


def camera_poses(rig: Rig, plate: Plate, n: int, rng: np.random.Generator, what: str) -> list[RigidTransform]:
    """Poses ``camera_from_board`` for the calibration of the camera: in the corners and the middle of the image, tilted 20 to 42 deg to all sides.

    Parameters
    ----------
    rig, plate : what sees what
    n : number of poses
    rng : random numbers
    what : the capture and its target, for messages

    Raises
    ------
    RigError
        If the plate does not fit into the view, or is not sharp, up to twice the usual distance.
    """
    usual_mm = _usual_depth(rig, what)
    centre_ray = rig.camera.rays((np.array(rig.camera.image_size)[None] - 1) / 2)[0]

    def draw(index: int, distance: float) -> RigidTransform:
        towards, tilt = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(20, 42))
        tilted = Rotation.from_rotvec(tilt * np.array([np.cos(towards), np.sin(towards), 0.0]))
        rotation = tilted * Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
        depth_mm = usual_mm * distance * rng.uniform(0.92, 1.1)
        fraction = np.array(_CORNERS[index % len(_CORNERS)]) * rng.uniform(0.5, 0.95, 2)
        uv = _pixel_with_room(rig.camera, plate, _board_at(centre_ray * depth_mm, rotation, plate), fraction)
        return _board_at(rig.camera.rays(uv[None])[0] * depth_mm, rotation, plate)

    poses = _poses_that_fit(n, draw, lambda pose: _is_visible(rig, plate, pose), _DISTANCES)
    if len(poses) < n:
        raise RigError(
            f"{what}: only {len(poses)} of {n} poses are wholly in view and sharp. {_why(rig, plate, usual_mm)}"
        )
    return poses


def laser_poses(rig: Rig, plate: Plate, n: int, rng: np.random.Generator, what: str) -> list[RigidTransform]:
    """Poses ``camera_from_board`` with the plate in the laser sheet, all over the part of the sheet that the camera sees.

    The front looks between camera and laser, and the stripe runs along the columns of the print, so that it crosses all rows.

    Parameters
    ----------
    rig, plate, n, rng, what : see :func:`camera_poses`

    Raises
    ------
    RigError
        If the plate does not fit into the view in the sheet, is not sharp there, or cannot be seen and lit at once.
    """
    usual_mm = _usual_depth(rig, what)
    sheet, camera_from_base = rig.laser_plane_camera, rig.camera_from_base
    laser_camera = camera_from_base.apply(rig.laser.position_base[None])[0]
    up_camera = camera_from_base.rotation.apply([0.0, 0.0, 1.0])
    half_length = (plate.extent[3] - plate.extent[2]) / 2

    def on_sheet(uv: np.ndarray) -> np.ndarray:
        ray = rig.camera.rays(uv[None])[0]
        return np.asarray(ray * (-sheet.offset / (ray @ sheet.normal)))

    def towards_both(centre: np.ndarray) -> np.ndarray:
        return unit(unit(-centre) + 0.7 * unit(laser_camera - centre))

    def draw(_: int, variant: tuple[float, float]) -> RigidTransform:
        turned_rad, freedom = variant
        noise, roll = freedom * rng.normal(0.0, 0.25, 3), turned_rad + freedom * rng.uniform(-0.3, 0.3)
        fraction = rng.uniform(-0.95, 0.95, 2)

        def held_at(centre: np.ndarray) -> RigidTransform:
            front = unit(towards_both(centre) + noise)
            along = np.cross(front, sheet.normal)
            return _board_at(centre, _facing(front, along if along @ up_camera >= 0 else -along, roll), plate)

        middle = on_sheet((np.array(rig.camera.image_size) - 1) / 2)
        return held_at(on_sheet(_pixel_with_room(rig.camera, plate, held_at(middle), fraction)))

    def fits(camera_from_board: RigidTransform) -> bool:
        centre = camera_from_board.apply(plate.centre_board()[None])[0]
        centre_base = camera_from_base.inv().apply(centre[None])[0]
        if not 0.6 < centre[2] / usual_mm < 1.7 or centre_base[2] < 0:
            return False
        front = -camera_from_board.rotation.as_matrix()[:, 2]
        lit = front @ unit(laser_camera - centre) > 0.4 and front @ unit(-centre) > 0.6
        across_sheet = abs(front @ sheet.normal) < 0.7  # not so oblique that the stripe gets wide
        along = camera_from_base.inv().rotation.apply(unit(np.cross(front, sheet.normal)))
        ends_base = centre_base + 0.7 * half_length * np.array([[-1.0], [0.0], [1.0]]) * along
        if not (lit and across_sheet and np.all(in_fan(rig.laser, ends_base))):
            return False
        return _is_visible(rig, plate, camera_from_board)

    poses = _poses_that_fit(n, draw, fits, _TURN_AND_FREEDOM)
    if len(poses) < n:
        raise RigError(
            f"{what}: only {len(poses)} of {n} poses of the plate in the laser sheet are wholly in view, sharp and lit. "
            f"{_why(rig, plate, usual_mm)} The fan of the laser ({rig.laser.fan_deg:.0f} deg) must reach over most of the plate."
        )
    return poses


def axis_pose(rig: Rig, plate: Plate, angles_deg: tuple[float, ...], what: str) -> RigidTransform:
    """Pose ``table_from_board`` of a plate that stands on the table and leans back; in the middle of the turn it faces the camera.

    Parameters
    ----------
    rig, plate, what : see :func:`camera_poses`
    angles_deg : at each of which the plate is in view

    Raises
    ------
    RigError
        If there is no such pose.
    """
    _usual_depth(rig, what)
    camera_base = np.asarray(rig.camera_from_base.inv().translation)
    azimuth = float(np.arctan2(camera_base[1], camera_base[0]))
    elevation_deg = float(np.degrees(np.arcsin(camera_base[2] / np.linalg.norm(camera_base))))
    middle = rig.base_from_table((min(angles_deg) + max(angles_deg)) / 2)
    turns = [rig.camera_from_base * rig.base_from_table(angle) * middle.inv() for angle in angles_deg]

    def standing(nearer_mm: float, lean_deg: float, turned: bool, raised_mm: float) -> RigidTransform:
        lean = np.radians(lean_deg)
        front = np.array([np.cos(azimuth) * np.cos(lean), np.sin(azimuth) * np.cos(lean), np.sin(lean)])
        rotation = _facing(front, np.array([0.0, 0.0, 1.0]), 0.03 + turned * np.pi / 2)
        lowest = _board_at(np.zeros(3), rotation, plate).apply(plate.corners_board())[:, 2].min()
        centre = np.array([nearer_mm * np.cos(azimuth), nearer_mm * np.sin(azimuth), raised_mm + 0.2 - lowest])
        return _board_at(centre, rotation, plate)

    def in_view(camera_from_board: RigidTransform) -> bool:
        front = -camera_from_board.rotation.as_matrix()[:, 2]
        centre = camera_from_board.apply(plate.centre_board()[None])[0]
        return bool(front @ unit(-centre) > 0.35) and _is_visible(rig, plate, camera_from_board)

    leans_deg = tuple(float(np.clip(elevation_deg + d, 0.0, 80.0)) for d in (-12.0, 8.0, -30.0))
    best = 0
    for raised_mm in (0.0, 15.0):
        for nearer_mm in (4.0, 12.0, 20.0, 30.0, -10.0, -25.0, -50.0):
            for turned in (False, True):
                for lean_deg in leans_deg:
                    base_from_board = standing(nearer_mm, lean_deg, turned, raised_mm)
                    n_seen = sum(in_view(turn * base_from_board) for turn in turns)
                    if n_seen == len(turns):
                        return middle.inv() * base_from_board
                    best = max(best, n_seen)
    raise RigError(
        f"{what}: standing on the table, the plate is wholly in view and sharp in {best} of {len(turns)} frames at best "
        f"({min(angles_deg):g} to {max(angles_deg):g} deg). {_why(rig, plate, float(rig.camera_from_base.translation[2]))} "
        "Or turn the table less."
    )
