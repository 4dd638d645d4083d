"""Tag poses in a camera's optical frame -> positions on the floor, as an imported log holds them."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from groundsbot.calib.foundation import FloatArray, plural
from groundsbot.offline.importing.bags.tags import BagPicture, BagTag
from groundsbot.offline.importing.run_writer import Entry
from groundsbot.onboard.log import TagObservation, TagObservations

# No observation is accurate to a hundredth of a millimetre: smaller variances are placeholders.
_LEAST_SIGMA_M: Final = 1e-5
# Tolerance of symmetry, relative to the largest entry: rounding, even to float32.
_ASYMMETRY: Final = 1e-6


def position_entries(
    looks: Sequence[BagPicture], R_planar_frame: Rotation, frame: str
) -> tuple[list[Entry], list[str]]:
    """Return messages for `/tags/observations`, and a remark about their covariances.

    Args:
        looks: pictures with positions, in order of time.
        R_planar_frame: rotates vectors from the pictures' frame into axes x forward, y left, z up.
        frame: "camera_planar" or "base", the frame of the resulting positions.
    """
    entries: list[Entry] = []
    n, n_sane, n_zero = 0, 0, 0
    for look in looks:
        observations = []
        for each in look.tags:
            if each.position_m is None:
                continue
            covariance = planar_covariance(each, R_planar_frame)
            observations.append(_observation(each, each.position_m, R_planar_frame, covariance))
            n, n_sane = n + 1, n_sane + (covariance is not None)
            n_zero += each.covariance is None or not each.covariance.any()
        if observations:
            message = TagObservations(stamp_ns=look.stamp_ns, frame=frame, observations=observations)
            entries.append((look.stamp_ns, "/tags/observations", message))
    return entries, _covariance_sentence(n, n_sane, n_zero)


def planar_covariance(sighting: BagTag, R_planar_frame: Rotation) -> FloatArray | None:
    """Return the covariance (2, 2) of the position on the floor; None if the message's is implausible.

    It must be finite, symmetric and positive definite, with sigmas between a hundredth of a millimetre and the tag's
    distance.
    """
    given, position_m = sighting.covariance, sighting.position_m
    if given is None or position_m is None or not np.isfinite(given).all():
        return None
    if np.abs(given - given.T).max() > _ASYMMETRY * np.abs(given).max():
        return None
    turned = R_planar_frame.as_matrix()
    planar: FloatArray = (turned @ (0.5 * (given + given.T)) @ turned.T)[:2, :2]
    smallest, largest = np.linalg.eigvalsh(planar)
    is_sane = bool(np.linalg.eigvalsh(given)[0] > 0.0)
    return planar if is_sane and smallest >= _LEAST_SIGMA_M**2 and largest <= position_m @ position_m else None


def _observation(
    each: BagTag, position_m: FloatArray, R_planar_frame: Rotation, covariance: FloatArray | None
) -> TagObservation:
    message = TagObservation(family=each.family, tag_id=each.tag_id)
    x_m, y_m, z_m = R_planar_frame.apply(position_m).tolist()
    message.cartesian.x_m, message.cartesian.y_m, message.cartesian.z_m, message.cartesian.has_z = x_m, y_m, z_m, True
    if covariance is not None:
        message.covariance.extend(covariance.ravel().tolist())
    if each.quaternion_xyzw is not None and 0.5 < np.linalg.norm(each.quaternion_xyzw) < 2.0:
        turned = R_planar_frame * Rotation.from_quat(each.quaternion_xyzw)
        message.quaternion_xyzw.extend(turned.as_quat(canonical=True).tolist())
    return message


def _covariance_sentence(n: int, n_sane: int, n_zero: int) -> list[str]:
    """Return the remark about covariances."""
    if n_sane == n:
        return ["covariances: as in the messages"]
    why = (
        "are zeros" if n_zero == n - n_sane else "are invalid (zeros, not symmetric or positive definite, or too large)"
    )
    return [f"covariances: those of {plural(n - n_sane, 'observation')} of {n} {why}; the noise model is used instead"]
