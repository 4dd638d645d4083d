"""A segment of a run: keyframes, the motions between them, and the tag observations taken from them."""

from dataclasses import dataclass, replace

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray, plural
from groundsbot.calib.robot import Gyro, NoiseParameters
from groundsbot.offline.measurements.covariance_components import CovarianceParts
from groundsbot.offline.measurements.keyframes import (
    cameras_at_candidates,
    candidate_stamps,
    choose_keyframes,
    keyframe_at,
    tags_at_candidates,
)
from groundsbot.offline.measurements.motion_model.heading_fusion import (
    FusedOdometry,
    GyroEstimate,
    with_estimated_gyro,
    with_gyro,
)
from groundsbot.offline.measurements.motion_model.motion_model import SegmentOdometry, WheelSegment, compose_odometry
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.sensor_model.imported_positions import read_positions, with_position_noise
from groundsbot.offline.measurements.sensor_model.observations import Observations, concatenate_observations
from groundsbot.offline.measurements.sensor_model.sensor_model import read_detections
from groundsbot.offline.measurements.speeds import SpeedProfile, speed_profile
from groundsbot.offline.measurements.tags import TagKey


@dataclass(frozen=True)
class Segment:
    """Keyframes with unbroken odometry.

    Attributes:
        name: name of the run, with a number where the run has several segments.
        run: that the segment is part of.
        stamps_ns: (K,) of the keyframes; the first is the segment's first wheel reading.
        odometry: the K-1 motions between them.
        tags: observed tags, sorted; `observations.tag` indexes them.
        observations: tag observations, ordered by keyframe.
        warnings: messages for the user.
        speeds: what a report shows of the wheel readings, where the run no longer has these.
    """

    name: str
    run: Run
    stamps_ns: IntArray
    odometry: SegmentOdometry
    tags: tuple[TagKey, ...]
    observations: Observations
    warnings: tuple[str, ...] = ()
    speeds: SpeedProfile | None = None

    def __repr__(self) -> str:
        return f"<Segment {self.name}: {plural(len(self.stamps_ns), 'keyframe')}, {plural(len(self.tags), 'tag')}>"

    @property
    def T_base_sensor(self) -> FloatArray:
        """(M, 3) nominal planar pose in base of the frame of each observation: of its camera, or base itself."""
        robot, observations = self.run.robot, self.observations
        mounts = [robot.with_camera(name).mount for name in robot.camera_names]
        of_camera = np.array([[mount.x_m, mount.y_m, mount.yaw_rad] for mount in mounts])
        return np.where(observations.in_camera[:, None], of_camera[observations.camera], 0.0)

    @property
    def along_m(self) -> FloatArray:
        """(K,) distance driven until each keyframe."""
        return np.append(0.0, np.cumsum(self.odometry.distance_m))

    def prefix(self, n_keyframes: int) -> "Segment":
        """Return the first keyframes of the segment, with the tags observed from them."""
        return self.part(0, n_keyframes)

    def part(self, first: int, end: int) -> "Segment":
        """Return keyframes first to end - 1 of the segment, with the tags observed from them."""
        inside = (self.observations.keyframe >= first) & (self.observations.keyframe < end)
        observations = self.observations.where(inside)
        tags, observations = index_observed_tags(self.tags, observations)
        return replace(
            self,
            stamps_ns=self.stamps_ns[first:end],
            odometry=self.odometry.part(first, end - 1),
            tags=tags,
            observations=replace(observations, keyframe=observations.keyframe - first),
        )

    def with_observations(self, which: BoolArray) -> "Segment":
        """Return the segment with the observations selected by a mask (M,), and their tags only."""
        if which.all():
            return self
        tags, observations = index_observed_tags(self.tags, self.observations.where(which))
        return replace(self, tags=tags, observations=observations)

    def with_noise(self, noise: NoiseParameters) -> "Segment":
        """Return the segment with covariances for other noise parameters."""
        return replace(self, odometry=self.odometry.with_noise(noise), observations=self.observations.with_noise(noise))

    def with_fixed_noise(self, most_times: int) -> "Segment":
        """Return the segment without what a fit of the noise and a solve on corners need, most of its memory.

        Covariances depend on no noise parameter then, no observation is from corners, and the run has no wheel
        readings, of which the speeds of at most so many times are kept.
        """
        return replace(
            self,
            run=replace(self.run, wheel_segments=()),
            odometry=replace(self.odometry, parts=CovarianceParts.constant(self.odometry.covariance)),
            observations=self.observations.without_corners(),
            speeds=speed_profile(self.run, self.stamps_ns, self.along_m, most_times),
        )

    def with_position_noise(self, names: tuple[str, ...]) -> "Segment":
        """Return the segment with some of `POSITION_NOISE` added to the observations from corners."""
        return replace(self, observations=with_position_noise(self.observations, names))


def index_observed_tags(
    tags: tuple[TagKey, ...], observations: Observations
) -> tuple[tuple[TagKey, ...], Observations]:
    """Return those of some tags that are observed, and the observations with indices into these."""
    observed, tag = np.unique(observations.tag, return_inverse=True)
    return tuple(tags[i] for i in observed), replace(observations, tag=tag)


def segments_of(run: Run, noise: NoiseParameters, gyro: GyroEstimate | None = None) -> list[Segment]:
    """Return the segments of a run, one for each of its wheel segments, with warnings that begin with their names.

    Args:
        run: the run.
        noise: sigmas of wheels and tag observations.
        gyro: what is known of the run's gyro; None: its noise is fitted.
    """
    several = len(run.wheel_segments) > 1
    segments = []
    for i, wheel_segment in enumerate(run.wheel_segments):
        name = run.name if i == 0 else f"{run.name}_stretch{i + 1}"
        segment = _segment(name, run, wheel_segment, noise, gyro)
        where = f"{name}: " if several else f"{run.name}: "
        segments.append(replace(segment, warnings=tuple(where + warning for warning in segment.warnings)))
    lost = sorted(set(run.tags) - {tag for segment in segments for tag in segment.tags})
    if lost:
        names = ", ".join(f"{tag.tag_id} ({tag.family})" for tag in lost)
        warning = (
            f"{run.name}: tag {names} was detected, but no observation of it can be used, so this run does not "
            "determine its position"
        )
        segments[0] = replace(segments[0], warnings=(*segments[0].warnings, warning))
    return segments


def _segment(
    name: str, run: Run, wheel_segment: WheelSegment, noise: NoiseParameters, estimate: GyroEstimate | None
) -> Segment:
    stamps_ns = candidate_stamps(run, wheel_segment)
    seen = tags_at_candidates(run, stamps_ns), cameras_at_candidates(run, stamps_ns)
    keyframe_stamps_ns, keyframe_of = choose_keyframes(wheel_segment, stamps_ns, *seen, run.robot.wheels.track_m)
    twist = wheel_segment.twist_at(keyframe_stamps_ns, run.robot.wheels.track_m)
    odometry = compose_odometry(wheel_segment, keyframe_stamps_ns, run.robot.wheels.track_m, noise)
    fused = FusedOdometry(odometry, None, np.zeros(len(keyframe_stamps_ns)), [])
    if run.gyro is not None:
        gyro, sigmas = run.robot.gyro or Gyro(), np.array(run.robot.wheels.relative_sigmas)
        if estimate is None:
            fused = with_gyro(odometry, run.gyro, keyframe_stamps_ns, gyro, sigmas, noise, name)
        else:
            fused = with_estimated_gyro(odometry, run.gyro, keyframe_stamps_ns, estimate, noise, name)
        if fused.fit is not None:
            bias_rad_s = None if estimate is None else float(estimate.calibration[-1])
            twist[:, 2] = run.gyro.yaw_rates(keyframe_stamps_ns, twist[:, 2], bias_rad_s)
    observations, warnings = _observations(run, stamps_ns, keyframe_of, twist, noise)
    tags, observations = index_observed_tags(run.tags, observations)
    if fused.heading_jitter_rad.any():
        observations = observations.with_heading_jitter(fused.heading_jitter_rad[observations.keyframe])
    return Segment(
        name=name,
        run=run,
        stamps_ns=keyframe_stamps_ns,
        odometry=fused.odometry,
        tags=tags,
        observations=observations,
        warnings=(*warnings, *fused.warnings),
    )


def _observations(
    run: Run, stamps_ns: IntArray, keyframe_of: IntArray, twist: FloatArray, noise: NoiseParameters
) -> tuple[Observations, list[str]]:
    """Return the observations of one segment and warnings; pictures between keyframes are left out."""
    detections, positions = run.detections, run.positions
    keyframe = keyframe_at(detections.stamps_ns, stamps_ns, keyframe_of)
    kept = keyframe >= 0
    from_corners, warnings = read_detections(run, detections.where(kept), keyframe[kept], twist, noise)
    keyframe = keyframe_at(positions.stamps_ns, stamps_ns, keyframe_of)
    kept = keyframe >= 0
    imported, more_warnings = read_positions(run.robot, positions.where(kept), keyframe[kept], twist, noise)
    return concatenate_observations(from_corners, imported), warnings + more_warnings
