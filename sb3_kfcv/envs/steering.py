"""How a scripted body gets where it wants to go: the force for a velocity, braking in time, the nearest of many points."""

from __future__ import annotations

import numpy as np

from sb3_kfcv.envs.physics import DAMPING, DT

KEPT = 1 - DAMPING
"""Share of the velocity that is left after a step: v ← KEPT · v + accel · u · DT, then x ← x + DT · v."""

# Share of the remaining offset, per unit of time, that a braking body aims to cover. At this gain a body at its top
# speed of 0.4 · accel can just brake in time: full reverse force halves the speed in one step, and so does the offset.
_BRAKING_GAIN = 5.0


def top_speed(accel: float) -> float:
    """Speed along an axis that a steady full force ends at."""
    return accel * DT / DAMPING


def force_for(wanted: np.ndarray, velocity: np.ndarray, accel: float) -> np.ndarray:
    """
    The force that brings the velocity as near to the wanted one as a single step allows.

    :param wanted: velocity after the step (…, 2)
    :param velocity: velocity before the step (…, 2)
    :param accel: acceleration under full force
    :return: forces in [-1, 1] (…, 2)
    """
    return np.clip((wanted - KEPT * velocity) / (accel * DT), -1, 1)


def approach_velocity(offset: np.ndarray, accel: float) -> np.ndarray:
    """
    The velocity for going to a point as fast as possible and stopping there.

    :param offset: from the body to the point (…, 2)
    :param accel: acceleration under full force
    :return: velocities (…, 2)
    """
    speed = top_speed(accel)
    return np.clip(_BRAKING_GAIN * offset, -speed, speed)


def nearest(offsets: np.ndarray, present: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """
    The nearest of several points.

    :param offsets: from the body to the points (…, points, 2)
    :param present: which points count (…, points); by default all
    :return: index of the nearest point (…), and its distance (…), infinite if none counts
    """
    distances = np.hypot(offsets[..., 0], offsets[..., 1])
    if present is not None:
        distances = np.where(present, distances, np.inf)
    index = distances.argmin(axis=-1)
    return index, distances.min(axis=-1)


def pick(values: np.ndarray, index: np.ndarray) -> np.ndarray:
    """
    One point of several: ``values`` (…, points, 2) at ``index`` (…).

    :return: (…, 2)
    """
    return np.take_along_axis(values, index[..., None, None], axis=-2)[..., 0, :]
