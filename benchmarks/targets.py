"""How exactly and how fast targets are detected, beside OpenCV: ``.venv/bin/python benchmarks/targets.py``."""

import time
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.simulation.ideal.targets import pixel_rays, render_target
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.detect import detect_target
from rotaline.vision.targets.measure import measure_grid
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid, Target

CAMERA = CameraModel((1280, 960), 1800.0, 1800.0, 645.0, 470.0, k1=-0.2, k2=0.05, p1=1e-3, p2=-5e-4)
CHECKERBOARD = Checkerboard((18, 16), 4.0)
DOTS = DotGrid((9, 9), 6.0, 3.0)
CHARUCO = CharucoBoard((12, 9), 8.0, 6.0, "DICT_5X5_100")
NOISE = 2.0
VIEWS = 12


def poses(target: Target, tilt_deg: float | None = None) -> list[RigidTransform]:
    """Poses with any roll, tilted up to 35 deg (or exactly by ``tilt_deg``), the target in the middle of the picture."""
    rng = np.random.default_rng(5)
    middle = target.points_board().mean(axis=0)
    size = float(np.linalg.norm(middle))
    result = []
    for _ in range(VIEWS):
        roll, azimuth = rng.uniform(0, 360, 2)
        tilt = rng.uniform(0, 35) if tilt_deg is None else tilt_deg
        rotation = Rotation.from_euler("zxz", [azimuth, tilt, roll - azimuth], degrees=True)
        at = np.array([rng.uniform(-3, 3), rng.uniform(-3, 3), 4.9 * size])
        result.append(RigidTransform.from_components(at - rotation.apply(middle), rotation))
    return result


def rms_error(target: Target, ids: np.ndarray, uv: np.ndarray, truth: np.ndarray) -> float:
    """Under the turn or reflection of the grid that fits best (OpenCV's grids may come out either way), px."""
    columns, rows = target.grid_size
    numbers = np.arange(columns * rows).reshape(rows, columns)
    ways = [numbers, numbers[::-1], numbers[:, ::-1], numbers[::-1, ::-1]]
    ways += [w.T for w in ways] if columns == rows else []
    return min(float(np.sqrt(np.mean((uv - truth[w.ravel()[ids]]) ** 2))) for w in ways)


def own(target: Target, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """This project."""
    detection = detect_target(image, target)
    return detection.point_ids, detection.uv


def corner_sub_pix(target: Target, image: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """OpenCV's findChessboardCorners and cornerSubPix."""
    found, corners = cv2.findChessboardCorners(image, target.grid_size)
    if not found:
        return None
    corners = cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), (3, 40, 1e-3))
    return np.arange(len(corners)), corners.reshape(-1, 2)


def sector_based(target: Target, image: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """OpenCV's findChessboardCornersSB, exhaustive and accurate."""
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(image, target.grid_size, flags=flags)
    return (np.arange(len(corners)), corners.reshape(-1, 2)) if found else None


def circles_grid(target: Target, image: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """OpenCV's findCirclesGrid with clustering."""
    flags = cv2.CALIB_CB_SYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING
    found, centres = cv2.findCirclesGrid(image, target.grid_size, flags=flags)
    return (np.arange(len(centres)), centres.reshape(-1, 2)) if found else None


def charuco_detector(target: Target, image: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """OpenCV's CharucoDetector."""
    assert isinstance(target, CharucoBoard)
    dictionary = cv2.aruco.getPredefinedDictionary(int(getattr(cv2.aruco, target.dictionary)))
    board = cv2.aruco.CharucoBoard(target.squares, target.pitch, target.marker, dictionary)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(image)
    return None if ids is None else (ids.ravel(), corners.reshape(-1, 2))


@dataclass(frozen=True)
class Detected:
    """One way to detect one target: seconds of each view, views found, error."""

    target: str
    way: str
    seconds: tuple[float, ...]
    n_found: int
    rms_px: float


def main() -> None:
    """Print the tables."""
    measure()
    measure_bias()


def measure() -> list[Detected]:
    """Views with noise: print and return a row for each target and way."""
    rows = []
    rays = pixel_rays(CAMERA)
    rng = np.random.default_rng(0)
    print(
        f"{VIEWS} views, {CAMERA.image_size[0]} x {CAMERA.image_size[1]}, lens blur 0.6 px, noise {NOISE:g} grey values"
    )
    print(f"{'target':<14}{'method':<34}{'found':>6}{'rms px':>9}{'ms':>7}")
    methods = {
        "checkerboard": (CHECKERBOARD, (own, corner_sub_pix, sector_based)),
        "dots": (DOTS, (own, circles_grid)),
        "charuco": (CHARUCO, (own, charuco_detector)),
    }
    for name, (target, functions) in methods.items():
        pictures = []
        for pose in poses(target):
            clean = render_target(CAMERA, pose, target, rays=rays, blur_px=0.6).over(60.0)
            noisy = np.clip(np.round(clean + rng.normal(0, NOISE, clean.shape)), 0, 255).astype(np.uint8)
            pictures.append((noisy, CAMERA.project(pose.apply(target.points_board()))))
        for function in functions:
            squares, times = [], []
            for image, truth in pictures:
                start = time.perf_counter()
                found = function(target, image)
                times.append(time.perf_counter() - start)
                if found is not None:
                    squares.append(rms_error(target, *found, truth) ** 2)
            rms, label = np.sqrt(np.mean(squares)), (function.__doc__ or "").rstrip(".")
            print(f"{name:<14}{label[:33]:<34}{len(squares):>6}{rms:>9.4f}{1e3 * np.median(times):>7.0f}")
            rows.append(Detected(name, label, tuple(times), len(squares), float(rms)))
    return rows


def measure_bias() -> None:
    """Views without noise: print the largest error and, for dots, that of the centre of the outline."""
    rays = pixel_rays(CAMERA)
    print("\nbias: noise-free, distortion k1 = -0.2")
    print(f"{'target':<14}{'tilt deg':>9}{'largest error px':>18}{'centre of outline, px':>23}")
    for name, target in (("checkerboard", CHECKERBOARD), ("dots", DOTS)):
        for tilt in (0.0, 30.0, 45.0):
            worst, outline = 0.0, 0.0
            for pose in poses(target, tilt)[:4]:
                clean = render_target(CAMERA, pose, target, rays=rays, blur_px=0.6).over(60.0)
                truth = CAMERA.project(pose.apply(target.points_board()))
                measured = measure_grid(
                    clean, target, np.arange(len(truth)), truth + 0.2, 1.5 if target is DOTS else None
                )
                worst = max(worst, float(np.abs(measured.uv - truth[measured.point_ids]).max()))
                angle = np.linspace(0, 2 * np.pi, 180, endpoint=False)
                for x, y, _ in target.points_board() if target is DOTS else ():
                    ring = np.column_stack([x + 1.5 * np.cos(angle), y + 1.5 * np.sin(angle), np.zeros(180)])
                    centre = CAMERA.project(pose.apply(np.array([[x, y, 0.0]])))[0]
                    off = CAMERA.project(pose.apply(ring)).mean(axis=0) - centre
                    outline = max(outline, float(np.abs(off).max()))
            print(
                f"{name:<14}{tilt:>9.0f}{worst:>18.4f}{outline:>23.4f}"
                if outline
                else f"{name:<14}{tilt:>9.0f}{worst:>18.4f}"
            )


if __name__ == "__main__":
    main()
