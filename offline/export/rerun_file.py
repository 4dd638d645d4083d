"""A recording with a blueprint for the Rerun viewer: the map from above, robots that drive in it, and their speeds."""

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.maps import SIGMAS_95, Component, RunResult, drawn_covariances

if TYPE_CHECKING:
    import rerun
    from rerun.blueprint import Blueprint

_APPLICATION: Final = "groundsbot map"
# Drives of different days are shown side by side, each since its own start.
_TIMELINE: Final = "time_since_start"
_ELLIPSE_STEPS: Final = 32
# Sizes on the screen, which stay the same when the map is zoomed: radii of a tag, of an ellipse and a trajectory.
_TAG_UI, _ELLIPSE_UI, _TRAJECTORY_UI = 3.0, 0.5, 1.0
_ARROW: Final = 0.03  # of the extent: length of the arrow that stands for a robot
_SUGGESTION: Final = "--format rerun needs the package rerun-sdk; install it (pip install rerun-sdk) and try again"
# The viewer's field of view is somewhat less than a right angle.
_EYE_HEIGHT: Final = 0.6  # relative to the extent of the map


def write_rerun(component: Component, path: Path) -> None:
    """Write a component as a Rerun recording (.rrd) with a blueprint, so that it opens with the right panels.

    Entities: `map/tags` (points with ids), `map/ellipses` (95 %, as in map.png), `map/runs/<run>` (trajectory, and the
    robot along the timeline `time_since_start`), `speed/<run>` in m/s. Positions are in metres in the component's
    frame, z up.

    Raises:
        OfflineError: rerun-sdk is not installed.
        OSError: the file cannot be written.
    """
    try:
        import rerun
    except ImportError as error:
        raise OfflineError(_SUGGESTION) from error

    recording = rerun.RecordingStream(_APPLICATION)
    recording.save(path, default_blueprint=_blueprint(component))
    recording.log("map", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_tags(recording, component)
    extent_m = float(np.ptp(_positions_m(component), axis=0).max())
    for run in component.runs:
        _log_run(recording, run, arrow_m=max(_ARROW * extent_m, 0.1))
    recording.flush()
    recording.disconnect()


def _blueprint(component: Component) -> "Blueprint":
    import rerun.blueprint as panels

    places_m = _positions_m(component)
    low_m, high_m = places_m.min(axis=0), places_m.max(axis=0)
    x_m, y_m = ((low_m + high_m) / 2.0).tolist()
    height_m = max(_EYE_HEIGHT * float((high_m - low_m).max()), 1.0)
    eye = panels.EyeControls3D(position=[x_m, y_m, height_m], look_target=[x_m, y_m, 0.0], eye_up=[0.0, 1.0, 0.0])
    return panels.Blueprint(
        panels.Vertical(
            panels.Spatial3DView(origin="map", name="map (m)", eye_controls=eye),
            panels.TimeSeriesView(origin="speed", name="speed (m/s)"),
            row_shares=[3, 1],
        ),
        collapse_panels=True,
    )


def _positions_m(component: Component) -> FloatArray:
    """Return the positions (N, 2) of trajectories and tags."""
    tags = [tag.position_m[np.newaxis, :2] for tag in component.tags]
    return np.concatenate([run.T_map_base[:, :2] for run in component.runs] + tags)


def _log_tags(recording: "rerun.RecordingStream", component: Component) -> None:
    import rerun

    if not component.tags:
        return
    places_m = np.array([[*tag.position_m[:2], 0.0] for tag in component.tags])
    labels = [tag.label for tag in component.tags]
    recording.log(
        "map/tags",
        rerun.Points3D(places_m, labels=labels, radii=rerun.Radius.ui_points(_TAG_UI), show_labels=True),
        static=True,
    )
    covariances = drawn_covariances(component)
    known = np.isfinite(covariances).all(axis=(1, 2))
    recording.log(
        "map/ellipses",
        rerun.LineStrips3D(
            list(_ellipses(places_m[known], covariances[known])), radii=rerun.Radius.ui_points(_ELLIPSE_UI)
        ),
        static=True,
    )


def _ellipses(places_m: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return closed 95 % ellipses (N, steps + 1, 3) around places (N, 3) with covariances (N, 2, 2)."""
    angles = np.linspace(0.0, 2.0 * np.pi, _ELLIPSE_STEPS + 1)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    variances, axes = np.linalg.eigh(covariances)
    half_axes = axes * SIGMAS_95 * np.sqrt(np.maximum(variances, 0.0))[:, np.newaxis, :]
    rings = np.repeat(places_m[:, np.newaxis], len(angles), axis=1)
    rings[..., :2] += np.einsum("nij,kj->nki", half_axes, circle)
    return rings


def _log_run(recording: "rerun.RecordingStream", run: RunResult, *, arrow_m: float) -> None:
    import rerun

    path = rerun.new_entity_path(["map", "runs", run.name])
    zeros = np.zeros((len(run.T_map_base), 1))
    places_m = np.concatenate([run.T_map_base[:, :2], zeros], axis=1)
    recording.log(
        path,
        rerun.LineStrips3D(
            [places_m], labels=[run.name], show_labels=False, radii=rerun.Radius.ui_points(_TRAJECTORY_UI)
        ),
        static=True,
    )
    recording.log(f"{path}/robot", rerun.Arrows3D(vectors=[[arrow_m, 0.0, 0.0]]), static=True)
    seconds = (run.stamps_ns - run.stamps_ns[0]) / 1e9
    half_turns = run.T_map_base[:, 2:3] / 2.0
    quaternions = np.concatenate([zeros, zeros, np.sin(half_turns), np.cos(half_turns)], axis=1)  # x, y, z, w
    recording.send_columns(
        f"{path}/robot",
        [rerun.TimeColumn(_TIMELINE, duration=seconds)],
        rerun.Transform3D.columns(translation=places_m, quaternion=quaternions),
    )
    if len(seconds) > 1:
        speeds_m_s = np.linalg.norm(np.diff(places_m, axis=0), axis=1) / np.diff(seconds)
        recording.send_columns(
            rerun.new_entity_path(["speed", run.name]),
            [rerun.TimeColumn(_TIMELINE, duration=seconds[1:])],
            rerun.Scalars.columns(scalars=speeds_m_s),
        )
