"""Time of the joint estimate against the number of frames and of mounts, and against a general solver on the same rows.

The article's rig at the level of observations, two mounts of the stepped cylinder. The general solver is ``scipy.optimize.least_squares`` with the same residuals
and sparse analytic derivatives, a Cauchy loss, and the scales of the noise that the joint estimate has found: it need not learn them, assigns no
point anew, switches nothing on and makes no covariance.

.venv/bin/python benchmarks/joint.py
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import sparse
from scipy.optimize import least_squares

from rotaline.calibration.joint import estimate, iterate, linear
from rotaline.calibration.joint.model import JointCalibration, JointStart
from rotaline.calibration.joint.noise import CAUCHY, Noise
from rotaline.calibration.joint.rows import plate_pivot
from rotaline.calibration.joint.state import State
from rotaline.calibration.observations import SessionObservations
from rotaline.io.rig_file import parse_rig, preset_text
from rotaline.pipeline import calibrate_joint
from rotaline.pipeline.calibrate import calibrate_observations
from rotaline.pipeline.options import CalibrationOptions, Options
from rotaline.pipeline.summary import machine, versions
from rotaline.pipeline.twin import trace_twin

STEPS_DEG = (16.0, 8.0, 4.0, 2.0)
MOUNTS = (1, 2, 4, 7, 10)
MOUNT_STEP_DEG = 8.0
REPEATS = 3


@dataclass(frozen=True)
class Estimated:
    """Time of one problem: seconds of CPU of each repeat; ``general_s`` of scipy's solver on it, NaN where that was not asked for."""

    n_mounts: int
    n_frames: int
    n_points: int
    n_iterations: int
    seconds: tuple[float, ...]
    general_s: float
    general_evaluations: int


def measure_frames(steps_deg: Sequence[float] = STEPS_DEG, repeats: int = REPEATS) -> list[Estimated]:
    """Two mounts, more and more frames of each; print seconds and the exponent of the growth, and the comparison for the first."""
    rows = []
    for step in steps_deg:
        text = preset_text("article").replace("step_deg = 4.0", f"step_deg = {step}")
        rows.append(_estimate(text, repeats, general=step == steps_deg[0]))
        _print(rows[-1])
    _print_exponent(rows, [r.n_frames for r in rows], "frames")
    return rows


def measure_mounts(mounts: Sequence[int] = MOUNTS, repeats: int = REPEATS) -> list[Estimated]:
    """More and more mounts of the same number of frames."""
    rows = []
    for n in mounts:
        rows.append(_estimate(_with_mounts(n), repeats))
        _print(rows[-1])
    _print_exponent(rows, [r.n_mounts for r in rows], "mounts")
    return rows


def main() -> None:
    """Print the tables."""
    measure_frames()
    measure_mounts()
    print(", ".join([machine(), *(f"{name} {version}" for name, version in versions().items())]))


def _with_mounts(n: int) -> str:
    """The article's rig with n mounts, 5 mm off centre in directions spread over the turn."""
    head, rest = preset_text("article").split("[[captures]]                          # nearly centred", 1)
    tail = rest[rest.index('[[captures]]\nfolder = "ball"') :]
    captures = ""
    for k in range(n):
        angle = 2 * np.pi * k / n + 0.6
        captures += f"""[[captures]]
folder = "stepped-{k + 1}"
role = "artifact"
part = "stepped-cylinder"
step_deg = {MOUNT_STEP_DEG}
mount = {{ position_mm = [{5 * np.cos(angle):.3f}, {5 * np.sin(angle):.3f}], turn_deg = {36 * k}.0 }}

"""
    return head + captures + tail


def _estimate(text: str, repeats: int, general: bool = False) -> Estimated:
    rig_file = parse_rig(text, "preset article")
    twin = trace_twin(rig_file.rig(), rig_file.plan(1), spacing_px=2.0).observed(0.02, 0.05, 1)
    start = _start(twin.observations)
    seconds = []
    for _ in range(repeats):
        began = time.process_time()
        found = estimate.estimate_jointly(twin.observations, start)
        seconds.append(time.process_time() - began)
    other = (float("nan"), 0)
    if general:
        setting, layout, state, noise, band = estimate.begin(twin.observations, start)
        other = _general(twin.observations, start, iterate.iterate(setting, layout, state, noise, band).noise)
    n_frames = sum(len(m.frame_names) for m in found.mounts)
    n_points = sum(len(m.surface) for m in found.mounts)
    return Estimated(len(found.mounts), n_frames, n_points, found.n_iterations, tuple(seconds), *other)


def _print(row: Estimated) -> None:
    median, spread = float(np.median(row.seconds)), float(np.ptp(row.seconds))
    print(
        f"{row.n_mounts:3d} mounts, {row.n_frames:5d} frames, {row.n_points:7d} points: {median:6.2f} s CPU "
        f"(spread {spread:.2f}), {row.n_iterations} iterations"
    )
    if np.isfinite(row.general_s):
        times = row.general_s / median
        print(
            f"      scipy: {row.general_s:.2f} s CPU, {row.general_evaluations} evaluations, {times:.1f} times as long"
        )


def _print_exponent(rows: Sequence[Estimated], sizes: Sequence[int], what: str) -> None:
    per_iteration = [float(np.median(r.seconds)) / r.n_iterations for r in rows]
    exponent = float(np.polyfit(np.log(sizes), np.log(per_iteration), 1)[0])
    print(f"seconds an iteration grow with the power {exponent:.2f} of the number of {what}")


def _start(observations: SessionObservations) -> JointStart:
    """What the stages hand to the joint estimate."""
    kept: list[JointStart] = []

    def keep(given: SessionObservations, start: JointStart, options: estimate.JointOptions) -> JointCalibration:
        kept.append(start)
        return estimate.estimate_jointly(given, start, options)

    original = calibrate_joint.estimate_jointly
    calibrate_joint.estimate_jointly = keep
    try:
        calibrate_observations(observations, Options(calibration=CalibrationOptions(method="joint")))
    finally:
        calibrate_joint.estimate_jointly = original
    return kept[0]


def _general(observations: SessionObservations, start: JointStart, noise: Noise) -> tuple[float, int]:
    """Seconds and iterations of scipy's robust sparse solver from the same start, with the noise that the joint estimate found."""
    setting, layout, state, _, band = estimate.begin(observations, start)
    data = setting.data
    pivots = [linear.board_pivot(data, b) for b in range(data.n_boards)]
    plate_pivots = [plate_pivot(state, f, p) for f, p in zip(data.plates, state.plates, strict=True)]
    priors = [noise.local_prior(9 if f.stripe is not None else 6, -1) for f in data.plates]
    priors += [noise.local_prior(6, 0)] * (len(data.tables) + len(data.mount_frames))
    ends = np.cumsum([layout.size, *(len(p) for p in priors)])
    places = [slice(a, b) for a, b in pairwise(ends)]
    assigned = [
        f.mount.chosen for f in linear.linearise(setting, state, noise, band, None, {}, 1) if f.mount is not None
    ]

    def at(x: np.ndarray) -> tuple[State, tuple[linear.FrameResiduals, ...]]:
        steps = {k: (x[places[k]][:6], plate_pivots[k]) for k in range(len(data.plates))}
        moved = state.after(layout, x[: layout.size], setting.camera_names, steps, pivots, data.artifact_groups)
        return moved, linear.linearise(setting, moved, noise, 10 * band, None, {}, 1)

    def rows(x: np.ndarray) -> tuple[list[np.ndarray], list[tuple[np.ndarray, np.ndarray]]]:
        moved, frames = at(x)
        values, blocks = [], []
        for k, (frame, place) in enumerate(zip(frames, places, strict=True)):
            on_table = k >= len(data.plates)
            r = frame.rows
            w = 1.0 / (noise.scale[r.group] * r.u)
            shared = np.zeros((len(r.residuals), layout.size))
            for name, columns in r.common.items():
                if name in layout:
                    shared[:, layout.of(name)] += columns
            for name, motion in (linear.frame_motions(data, layout, moved, k) if on_table else {}).items():
                if name in layout:
                    shared[:, layout.of(name)] += r.local[:, :6] @ motion
            random = slice(0 if on_table else 6, None)
            value = (r.residuals + r.local[:, random] @ x[place][random]) * w
            if frame.mount is not None:  # the same points at every evaluation
                keep = np.searchsorted(frame.mount.chosen, assigned[k - len(data.plates) - len(data.tables)])
                keep = np.clip(keep, 0, len(value) - 1)
                value, shared, local, w = value[keep], shared[keep], r.local[keep], w[keep]
            else:
                local = r.local
            values.append(value)
            blocks.append((shared * w[:, None], local * w[:, None]))
        return values, blocks

    def residuals(x: np.ndarray) -> np.ndarray:
        values, _ = rows(x)
        return np.concatenate([*values, *(p * x[place] for p, place in zip(priors, places, strict=True))])

    def jacobian(x: np.ndarray) -> sparse.csr_matrix:
        _, blocks = rows(x)
        shared = sparse.csr_matrix(np.vstack([b[0] for b in blocks]))
        own = sparse.block_diag([b[1] for b in blocks], format="csr")
        below = sparse.hstack([sparse.csr_matrix((own.shape[1], layout.size)), sparse.diags(np.concatenate(priors))])
        return sparse.vstack([sparse.hstack([shared, own]), below], format="csr")

    began = time.process_time()
    found = least_squares(
        residuals,
        np.zeros(ends[-1]),
        jac=jacobian,
        loss="cauchy",
        f_scale=CAUCHY,
        x_scale="jac",
        tr_solver="lsmr",
        max_nfev=60,
    )
    return time.process_time() - began, int(found.nfev)


if __name__ == "__main__":
    main()
