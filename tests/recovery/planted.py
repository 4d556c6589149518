"""Sessions of the twin with one cause of bad calibrations planted in each: edits of the observations, of the plan or of the rig."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.model import TargetView
from rotaline.calibration.observations import MountObservation, SessionObservations
from rotaline.calibration.stripe_on_board import StripeView
from rotaline.geometry.primitives import SteppedCylinder
from rotaline.io.rig_file import read_preset
from rotaline.pipeline.twin import TracedTwin, TwinSession, trace_twin
from rotaline.simulation.ideal.observed_session import IdealSession
from rotaline.simulation.plan import CapturePlan, SessionPlan, Shot
from rotaline.simulation.rig import Rig
from rotaline.vision.stripe.model import StripePoints
from rotaline.vision.targets.model import Target, TargetDetection

TARGET_PX, STRIPE_PX = 0.02, 0.06
"""Noise of a good session."""


def rig_and_plan(preset: str = "demo", every: int = 2) -> tuple[Rig, SessionPlan]:
    """A preset without its scans, with every other frame of the artefact (``every``)."""
    file = read_preset(preset)
    plan = file.plan()
    captures = [
        replace(c, shots=c.shots[::every]) if c.role == "artifact" else c for c in plan.captures if c.role != "scan"
    ]
    return file.rig(), replace(plan, captures=tuple(captures), measurements=())


def traced(rig: Rig, plan: SessionPlan, like: TracedTwin | None = None, changed: Sequence[str] = ()) -> TracedTwin:
    """Coarse enough for a test, fine enough for its statistics; captures that are not ``changed`` are those of ``like``."""
    spacing_px = 4.0 * rig.camera.image_size[0] / 800
    if like is None:
        return trace_twin(rig, plan, spacing_px=spacing_px)
    old = {c.plan.folder: c for c in like.ideal.captures}
    anew = replace(plan, captures=tuple(c for c in plan.captures if c.folder in changed))
    new = {c.plan.folder: c for c in trace_twin(rig, anew, spacing_px=spacing_px).ideal.captures} if changed else {}
    captures = tuple(new.get(c.folder) or old[c.folder] for c in plan.captures)
    return replace(like, rig=rig, plan=plan, ideal=IdealSession(captures))


def observed(twin: TracedTwin, seed: int = 1, noise: float = 1.0) -> SessionObservations:
    """With the noise of a good session, ``noise`` times."""
    session: TwinSession = twin.observed(noise * TARGET_PX, noise * STRIPE_PX, seed)
    return session.observations


# edits of the observations -------------------------------------------------------------------------------------------


def with_pitch(observations: SessionObservations, name: type, factor: float) -> SessionObservations:
    """The targets of a kind stated with ``factor`` times their true pitch."""

    def stated(detection: TargetDetection) -> TargetDetection:
        target: Target = detection.target
        return (
            replace(detection, target=replace(target, pitch=factor * target.pitch))
            if isinstance(target, name)
            else detection
        )

    def views(old: tuple[TargetView, ...]) -> tuple[TargetView, ...]:
        return tuple(replace(v, detection=stated(v.detection)) for v in old)

    plates: tuple[StripeView, ...] = tuple(replace(v, detection=stated(v.detection)) for v in observations.plate_views)
    return replace(
        observations,
        camera_views=views(observations.camera_views),
        plate_views=plates,
        table_views=views(observations.table_views),
    )


def with_angles(
    observations: SessionObservations,
    read: Callable[[float], float],
    folders: Sequence[str] = ("axis", "stepped-1", "stepped-2"),
) -> SessionObservations:
    """The angles of some captures as a wrong read-out gives them; rad."""
    table = observations.table_views
    if "axis" in folders:
        table = tuple(replace(v, angle_rad=read(float(v.angle_rad or 0.0))) for v in table)
    mounts = tuple(
        replace(m, angles_rad=np.array([read(float(a)) for a in m.angles_rad])) if m.name in folders else m
        for m in observations.mounts
    )
    return replace(observations, table_views=table, mounts=mounts)


def with_artifact(observations: SessionObservations, **sizes: float) -> SessionObservations:
    """The stepped cylinder stated with other sizes."""

    def stated(mount: MountObservation) -> MountObservation:
        assert isinstance(mount.artifact, SteppedCylinder)
        return replace(mount, artifact=replace(mount.artifact, **sizes))

    return replace(observations, mounts=tuple(stated(m) for m in observations.mounts))


def with_saturation(
    observations: SessionObservations, fraction: float, bias_px: float, seed: int = 1
) -> SessionObservations:
    """A part of the stripes clipped: flat tops, whose middle is off by slowly changing amounts."""
    rng = np.random.default_rng(seed)

    def clipped(stripe: StripePoints) -> StripePoints:
        if not len(stripe):
            return stripe
        place = np.linspace(0, 1, len(stripe))
        where = ((place + rng.uniform()) % 1.0) < fraction
        bias = bias_px * np.sin(2 * np.pi * (3 * place + rng.uniform())) * where
        return replace(
            stripe,
            uv=stripe.uv + bias[:, None] * stripe.normal,
            width_px=np.where(where, 1.6, 1.0) * stripe.width_px,
            intensity=np.where(where, 253.0, stripe.intensity),
            saturated=where,
        )

    return replace(
        observations,
        plate_views=tuple(replace(v, stripe=clipped(v.stripe)) for v in observations.plate_views),
        mounts=tuple(replace(m, stripes=tuple(clipped(s) for s in m.stripes)) for m in observations.mounts),
    )


# edits of the plan ---------------------------------------------------------------------------------------------------


def plan_with(plan: SessionPlan, folder: str, edit: Callable[[CapturePlan], CapturePlan]) -> SessionPlan:
    """The plan with one capture changed."""
    return replace(plan, captures=tuple(edit(c) if c.folder == folder else c for c in plan.captures))


def with_plates_moved(plan: SessionPlan, shift_mm: Callable[[int], float]) -> SessionPlan:
    """The plate of each pose slips along its normal before its laser-on frame, by so much (mm) of the pose's number."""

    def moved(shot: Shot) -> Shot:
        by = RigidTransform.from_translation([0.0, 0.0, shift_mm(int(shot.pose)) if shot.laser else 0.0])
        return replace(shot, held=tuple(replace(p, frame_from_part=p.frame_from_part * by) for p in shot.held))

    return plan_with(plan, "laser", lambda c: replace(c, shots=tuple(moved(s) for s in c.shots)))


def with_poses_alike(
    rig: Rig, plan: SessionPlan, folder: str, shifts_mm: float, turns_deg: float, index: int = 0, seed: int = 3
) -> SessionPlan:
    """All poses of a target near one of them: moved in and across the depth by up to ``shifts_mm``, turned by up to ``turns_deg``."""
    rng = np.random.default_rng(seed)

    def alike(capture: CapturePlan) -> CapturePlan:
        first = capture.shots[index].held[0]
        camera_from_board = rig.camera_from_base * first.frame_from_part
        centre = camera_from_board.apply(np.array([first.shape.centre_board()]))[0]  # type: ignore[attr-defined]
        shots, pose_of = [], {}
        for shot in capture.shots:
            if not shot.pose or shot.pose not in pose_of:
                turn = Rotation.from_rotvec(np.radians(turns_deg) * rng.uniform(-1, 1, 3))
                shift = shifts_mm * rng.uniform(-1, 1, 3)
                about = RigidTransform.from_components(centre + shift - turn.apply(centre), turn)
                pose_of[shot.pose] = rig.camera_from_base.inv() * about * camera_from_board
            shots.append(replace(shot, held=(replace(shot.held[0], frame_from_part=pose_of[shot.pose]),)))
        return replace(capture, shots=tuple(shots))

    return plan_with(plan, folder, alike)


def without(plan: SessionPlan, *folders: str) -> SessionPlan:
    """The plan without some captures."""
    return replace(plan, captures=tuple(c for c in plan.captures if c.folder not in folders))


def with_camera_moved(twin: TracedTwin, first: str, shift_mm: Sequence[float], turn_rad: Sequence[float]) -> TracedTwin:
    """The camera moves before capture ``first`` and stays there; ``shift_mm`` and ``turn_rad`` along its axes."""
    by = RigidTransform.from_components(list(shift_mm), Rotation.from_rotvec(list(turn_rad)))
    folders = [c.folder for c in twin.plan.captures]
    moved = replace(twin.rig, camera_from_base=by * twin.rig.camera_from_base)
    return traced(moved, twin.plan, twin, folders[folders.index(first) :])
