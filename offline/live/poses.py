"""Poses of robots in a finished map while their runs are recorded."""

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.errors import GroundsbotError
from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.localization import GyroDifference, OnlineLocalizer, OnlinePose, TagMeasurement
from groundsbot.offline.maps import MapResult
from groundsbot.offline.measurements import ALONE, GrowingRun, Run, Segment, TagKey, segments_of

# A picture is in the log this long after its wheel readings at most; later ones are not used.
_PICTURE_DELAY_NS: Final = 2_000_000_000
_GYRO_DELAY_NS: Final = 500_000_000  # a gyro that is silent for longer is not waited for
# Of a motion too short to be a keyframe's, in metres and radians.
_SHORT_MOTION_SIGMA: Final = 1e-4


class StampedPose(NamedTuple):
    """A pose of a robot in a map, or why it is not known.

    Attributes:
        run: name of the run.
        stamp_ns: time of the pose, on the run's clock.
        pose: pose in the map frame; None if it is not known.
        reason: why the pose is not known; empty if it is.
    """

    run: str
    stamp_ns: int
    pose: OnlinePose | None
    reason: str


class RunLocalizer:
    """Localizes the robot of one run in a map, by what is new in its log."""

    def __init__(self, growing: GrowingRun, known: MapResult) -> None:
        """Begin without reading.

        Args:
            growing: the run; what it has read is forgotten once it is used.
            known: the map; poses are in the frame of its largest component.
        """
        self._why_away = self._why_unusable = ""
        self._is_refused = False
        self._run_name = ""
        self._growing = growing
        self._known = known
        self._online: OnlineLocalizer | None = None
        self._at_ns = 0  # of the localizer's last pose
        self._sent_ns = 0  # of the newest pose returned
        self._seen: set[tuple[TagKey, int]] = set()  # from that pose, by which camera

    @property
    def trouble(self) -> str:
        """Why the log cannot be read or localised, or not yet; else empty."""
        return self._why_away or self._why_unusable

    @property
    def is_finished(self) -> bool:
        """Whether the recorder has finished the run, or it is one that the map was made of."""
        return self._is_refused or self._growing.is_finished

    def advance(self) -> list[StampedPose]:
        """Read what is new, and return the poses at new keyframes and at the newest wheel reading, in order of time."""
        if self._is_refused:
            return []
        self._why_away, n_new = "", 0
        try:
            n_new = self._growing.read()
        except GroundsbotError as error:
            self._why_away = str(error)
        if n_new == 0:
            return []
        try:
            run = self._growing.measurements(ALONE)
        except GroundsbotError as error:
            self._why_unusable = str(error)
            return []
        self._why_unusable = ""
        if run.name != self._run_name:
            self._run_name, self._online, self._at_ns, self._sent_ns = run.name, None, 0, 0
        if run.name in {each.run for each in self._known.runs}:  # its measurements would count twice
            self._why_unusable = (
                f"{run.log}: {run.name} is in the map already; follow a run that the map was not made of"
            )
            self._is_refused = True
            return []
        wheels = run.wheel_segments[-1]
        if self._online is None or len(run.wheel_segments) > 1:  # the motion before a reset is not known
            if run.gyro is None and wheels.stamps_ns[-1] < wheels.stamps_ns[0] + _GYRO_DELAY_NS:
                return []  # it may still come
            self._online = OnlineLocalizer(self._known, run.robot, has_gyro=run.gyro is not None)
            self._at_ns, self._seen = int(wheels.stamps_ns[0]), set()
        found = [each for each in self._add(self._online, run) if each.stamp_ns > self._sent_ns]
        self._growing.forget(self._at_ns, run)
        self._sent_ns = max([self._sent_ns, *(each.stamp_ns for each in found)])
        return found

    def _add(self, online: OnlineLocalizer, run: Run) -> list[StampedPose]:
        """Add what was measured since the last pose; the motion after the last picture is only predicted."""
        wheels, begin_ns = run.wheel_segments[-1], self._at_ns
        last_ns = int(wheels.stamps_ns[-1])
        if last_ns <= begin_ns:
            return []
        # Later gyro samples may be on their way, without which the motion would be by the wheels alone.
        until_ns = last_ns
        if run.gyro is not None and last_ns - run.gyro.stamps_ns[-1] < _GYRO_DELAY_NS:
            until_ns = min(last_ns, int(run.gyro.stamps_ns[-1]))
        pictures_ns = run.picture_stamps_ns[(run.picture_stamps_ns > begin_ns) & (run.picture_stamps_ns <= until_ns)]
        added_ns = max(int(pictures_ns.max(initial=begin_ns)), last_ns - _PICTURE_DELAY_NS)
        stamps_ns = np.union1d(pictures_ns, [each for each in (added_ns, last_ns) if each > begin_ns])
        part = replace(
            run,
            wheel_segments=(wheels.after(begin_ns),),
            picture_stamps_ns=stamps_ns,
            picture_camera=_cameras_at(run, stamps_ns),
            detections=run.detections.where(run.detections.stamps_ns > begin_ns),
            positions=run.positions.where(run.positions.stamps_ns > begin_ns),
        )
        estimate = online.gyro_estimate()
        if estimate is None:
            part = replace(part, gyro=None)
        (segment,) = segments_of(part, self._known.noise, estimate)
        n_added = max(1, int((segment.stamps_ns <= added_ns).sum()))
        found = [self._add_keyframe(online, segment, k) for k in range(n_added)][1:]
        if n_added == 1 and added_ns - begin_ns >= _PICTURE_DELAY_NS:  # it stands or creeps
            motion = wheels.motions(np.array(begin_ns), np.array(added_ns), run.robot.wheels.track_m)
            online.add_motion(motion, _SHORT_MOTION_SIGMA**2 * np.eye(3), np.zeros((3, 3)))
            self._at_ns = added_ns
        motion = wheels.motions(np.array(self._at_ns), np.array(last_ns), run.robot.wheels.track_m)
        covariance = np.zeros((3, 3))
        if len(segment.stamps_ns) > n_added:
            motion, covariance = segment.odometry.motion[n_added - 1], segment.odometry.covariance[n_added - 1]
        pose = online.pose
        newest = None if pose is None else _predict(pose, motion, covariance)
        return [*found, StampedPose(run.name, last_ns, newest, online.reason)]

    def _add_keyframe(self, online: OnlineLocalizer, segment: Segment, k: int) -> StampedPose:
        """Add one keyframe; of a pose at which the robot stands each tag counts once."""
        odometry, observations = segment.odometry, segment.observations
        if k:
            difference = _difference(segment, k - 1)
            online.add_motion(odometry.motion[k - 1], odometry.covariance[k - 1], odometry.jacobian[k - 1], difference)
            self._at_ns, self._seen = int(segment.stamps_ns[k]), set()
        for m in np.flatnonzero(observations.keyframe == k).tolist():
            tag, camera = segment.tags[observations.tag[m]], int(observations.camera[m])
            if (tag, camera) in self._seen:
                continue
            self._seen.add((tag, camera))
            online.add_observation(
                TagMeasurement(
                    tag.family,
                    tag.tag_id,
                    observations.value[m],
                    observations.covariance[m],
                    observations.by_camera[m] if observations.by_camera.any() else None,
                    bool(observations.polar[m]),
                    bool(observations.in_camera[m]),
                    segment.run.robot.camera_names[camera],
                )
            )
        return StampedPose(segment.run.name, self._at_ns, online.pose, online.reason)


def _cameras_at(run: Run, stamps_ns: IntArray) -> IntArray:
    """Return the camera of the picture with each stamp; the first where there is none."""
    camera = dict(zip(run.picture_stamps_ns.tolist(), run.picture_camera.tolist(), strict=True))
    return np.array([camera.get(stamp_ns, 0) for stamp_ns in stamps_ns.tolist()], dtype=np.int64)


def _difference(segment: Segment, step: int) -> GyroDifference | None:
    """Return the difference between gyro and wheels of one motion; None where it was not fused with a gyro."""
    differences = segment.odometry.differences
    at = np.zeros(0) if differences is None else np.flatnonzero(differences.step == step)
    if differences is None or not len(at):
        return None
    duration_s = float(segment.stamps_ns[step + 1] - segment.stamps_ns[step]) * 1e-9
    return GyroDifference(differences.rows[at[0]], float(differences.values[at[0]]), duration_s)


def _predict(pose: OnlinePose, motion: FloatArray, covariance: FloatArray) -> OnlinePose:
    """Return the pose after a motion (3,) with the covariance (3, 3) of its right tangent."""
    after = se2.compose(pose.T_map_base, motion)
    x_m, y_m, _ = after - pose.T_map_base
    by_pose = np.array([[1.0, 0.0, -y_m], [0.0, 1.0, x_m], [0.0, 0.0, 1.0]])
    cos, sin = np.cos(after[2]), np.sin(after[2])
    rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return OnlinePose(after, by_pose @ pose.covariance @ by_pose.T + rotation @ covariance @ rotation.T)
