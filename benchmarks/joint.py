"""Time of the joint estimate against the number of frames, and against a general solver on the same rows.

The article's rig at the level of observations, two mounts of the stepped cylinder. The general solver is ``scipy.optimize.least_squares`` with the same residuals
and sparse analytic derivatives, a Cauchy loss, and the scales of the noise that the joint estimate has found: it need not learn them, assigns no
point anew, switches nothing on and makes no covariance.

.venv/bin/python benchmarks/joint.py
"""

import time
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
REPEATS = 3


def main() -> None:
    """Print seconds and the exponent of the growth, then the comparison."""
    rows = []
    for step in STEPS_DEG:
        text = preset_text("article").replace("step_deg = 4.0", f"step_deg = {step}")
        rig_file = parse_rig(text, "preset article")
        twin = trace_twin(rig_file.rig(), rig_file.plan(1), spacing_px=2.0).observed(0.02, 0.05, 1)
        start = _start(twin.observations)
        setting, layout, state, noise, band = estimate.begin(twin.observations, start)
        noise = iterate.iterate(setting, layout, state, noise, band).noise
        seconds = []
        for _ in range(REPEATS):
            began = time.process_time()
            found = estimate.estimate_jointly(twin.observations, start)
            seconds.append(time.process_time() - began)
        n_frames = sum(len(m.frame_names) for m in found.mounts)
        n_points = sum(len(m.surface) for m in found.mounts)
        rows.append((n_frames, n_points, float(np.median(seconds)), float(np.ptp(seconds)), found.n_iterations))
        print(
            f"{n_frames:5d} frames of mounts, {n_points:7d} points: {rows[-1][2]:6.2f} s CPU (spread {rows[-1][3]:.2f}), {found.n_iterations} iterations"
        )
        if step == STEPS_DEG[0]:
            general, n_evaluations = _general(twin.observations, start, noise)
            print(
                f"      scipy: {general:.2f} s CPU, {n_evaluations} evaluations, {general / rows[-1][2]:.1f} times as long"
            )
    frames, per_iteration = np.array([(r[0], r[2] / r[4]) for r in rows]).T
    exponent = float(np.polyfit(np.log(frames), np.log(per_iteration), 1)[0])
    print(f"seconds an iteration grow with the power {exponent:.2f} of the number of frames")
    print(", ".join([machine(), *(f"{name} {version}" for name, version in versions().items())]))


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
