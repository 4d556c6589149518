"""The ``quality`` object of ``calibration.json``: the figures by which each stage is judged, with units in the names."""

from typing import Any

import numpy as np

from rotaline.calibration.joint.model import JointCalibration
from rotaline.pipeline.calibrate import CalibrationParts


def quality_figures(parts: CalibrationParts) -> dict[str, dict[str, Any]]:
    """One object for each stage that was done; standard uncertainties (k = 1) begin with ``u_``."""
    quality: dict[str, dict[str, Any]] = {}
    if (camera := parts.camera) is not None:
        quality["camera"] = {
            "rms_px": camera.rms_px,
            "mean_error_px": camera.mean_error_px,
            "n_views": len(camera.views),
            "n_views_used": sum(v.used for v in camera.views),
            "views_left_out": {v.name: v.reason for v in camera.views if not v.used},
            "u": dict(zip(camera.parameter_names, camera.u_parameters.tolist(), strict=True)),
        }
    if (plane := parts.laser_plane) is not None:
        quality["laser_plane"] = {
            "rms_mm": plane.rms_mm,
            "n_poses": len(plane.views),
            "n_poses_used": sum(v.used for v in plane.views),
            "poses_left_out": {v.name: v.reason for v in plane.views if not v.used},
            "n_points": sum(len(v.points_camera) for v in plane.views if v.used),
            "u_normal_rad": list(plane.u_normal_rad),
            "u_offset_mm": plane.u_offset_mm,
        }
    if (ratio := parts.cross_ratio) is not None:
        quality["cross_ratio"] = {
            "interval_rmse_before_mm": ratio.rmse_before_mm,
            "interval_rmse_after_mm": ratio.rmse_after_mm,
            "n_intervals": len(ratio.reference_mm),
            "accepted": ratio.accepted,
            "reason": ratio.reason,
            "n_iterations": ratio.n_iterations,
            "converged": ratio.converged,
        }
    if (axis := parts.axis) is not None:
        angles = np.array([f.angle_rad for f in axis.frames if f.used])
        quality["axis"] = {
            "circle_rms_mm": axis.rms_mm,
            "centre_line_rms_mm": axis.centre_line_rms_mm,
            "n_frames": len(axis.frames),
            "n_frames_used": len(angles),
            "frames_left_out": {f.name: f.reason for f in axis.frames if not f.used},
            "u_direction_rad": axis.u_direction_rad,
            "u_position_mm": axis.u_position_mm,
        }
    if (artifact := parts.artifact) is not None:
        quality["artifact"] = {
            "method": artifact.method,
            "mean_distance_before_mm": artifact.mean_distance_before_mm,
            "mean_distance_mm": artifact.mean_distance_mm,
            "n_iterations": artifact.n_iterations,
            "converged": artifact.converged,
            "u_direction_rad": artifact.u_direction_rad,
            "u_position_mm": artifact.u_position_mm,
            "mounts": {
                m.name: {
                    "n_frames": len(m.frame_used),
                    "n_frames_used": sum(m.frame_used),
                    "mean_distance_before_mm": m.mean_distance_before_mm,
                    "mean_distance_mm": m.mean_distance_mm,
                    "eccentricity_mm": m.eccentricity_mm,
                }
                for m in artifact.mounts
            },
        }
    if parts.joint is not None:
        quality["joint"] = _joint_figures(parts.joint)
    return quality


def _joint_figures(joint: JointCalibration) -> dict[str, Any]:
    figures: dict[str, Any] = {
        "n_observations": joint.n_observations,
        "n_parameters": joint.n_parameters,
        "n_iterations": joint.n_iterations,
        "converged": joint.converged,
        "groups": [
            {
                "kind": g.kind,
                "name": g.name,
                "rms_px": g.rms_px,
                "sigma_px": g.sigma_px,
                "rms_mm": g.rms_mm,
                "predicted_px": g.predicted_px,
                "correlation_length": g.correlation_length,
                "n_points": g.n_points,
                "n_points_used": g.n_used,
                "frames_left_out": {v.name: v.reason for v in g.views if not v.used},
            }
            for g in joint.groups
        ],
        "mounts": {
            m.name: {
                "mean_mm": dict(zip(m.surfaces, m.mean_mm.tolist(), strict=True)),
                "rms_mm": dict(zip(m.surfaces, m.rms_mm.tolist(), strict=True)),
                "held_out_rms_mm": m.held_out_rms_mm,
                "eccentricity_mm": m.eccentricity_mm,
                "u_eccentricity_mm": m.u_eccentricity_mm,
                "tilt_rad": m.tilt_rad,
                "n_points": len(m.weight),
                "n_points_used": int(m.used.sum()),
            }
            for m in joint.mounts
        },
        "optional": {
            o.name: {
                "on": o.on,
                "reason": o.reason,
                "improvement": o.improvement,
                "value": o.values,
                "u": o.u,
                "unit": o.units,
            }
            for o in joint.optional
        },
        "parameters": {
            q.name: {"value": q.value, "u": q.u, "unit": q.unit, "frame": q.frame} for q in joint.parameters
        },
        "weak_directions": [
            {"quantity": w.quantity, "u": w.u, "unit": w.unit, "share": w.share, "text": w.text, "action": w.action}
            for w in joint.weak_directions
        ],
    }
    if (table := joint.table) is not None:
        units = {"angle": "rad", "run-out": "mm", "lift": "mm", "wobble": "rad"}
        figures["table"] = {
            name: {"sigma": float(sigma), "u": float(u), "unit": units[name]}
            for name, sigma, u in zip(table.names, table.sigma, table.u_sigma, strict=True)
        }
    return figures
