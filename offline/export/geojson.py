"""A component as GeoJSON (RFC 7946): tags as points, trajectories as lines, in WGS 84."""

from math import atan2, cos, degrees, hypot, radians, sin, sqrt
from typing import Any, Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.export.options import ExportOptions, numbers
from groundsbot.offline.maps import Component

# WGS 84: NIMA TR8350.2, third edition, table 3.1.
_A_M: Final = 6378137.0
_FLATTENING: Final = 1.0 / 298.257223563
_B_M: Final = _A_M * (1.0 - _FLATTENING)
_E2: Final = _FLATTENING * (2.0 - _FLATTENING)
_DIGITS: Final = 9  # 0.1 mm
_MAX_LATITUDE_DEG: Final = 89.9  # at a pole east and north are undefined


class TangentPlane:
    """The map's floor as the tangent plane of the ellipsoid at the map's origin."""

    def __init__(self, origin: str) -> None:
        """Args: origin: LAT_DEG,LON_DEG,HEADING_DEG.

        Raises:
            OfflineError: the origin is not a valid position.
        """
        self.latitude_deg, self.longitude_deg, heading_deg = numbers("--origin", origin, "LAT_DEG,LON_DEG,HEADING_DEG")
        if abs(self.latitude_deg) > _MAX_LATITUDE_DEG or abs(self.longitude_deg) > 180.0:
            raise OfflineError(
                f"--origin {origin}: latitude must lie within {_MAX_LATITUDE_DEG} and longitude within 180 degrees; "
                "latitude comes first"
            )
        heading = radians(heading_deg)
        # Columns: the map's x and y axes as (east, north).
        self.R_east_map: FloatArray = np.array([[sin(heading), -cos(heading)], [cos(heading), sin(heading)]])

    def longitude_latitude(self, position_m: FloatArray) -> list[float]:
        """Return degrees, longitude first as in RFC 7946, of a position (2,) in map.

        East, north -> earth-centred -> geodetic: Bowring, "Transformation from spatial to geographical coordinates",
        Survey Review 23 (1976), exact to far below a millimetre this near the ground.
        """
        east_m, north_m = (self.R_east_map @ position_m).tolist()
        lat = radians(self.latitude_deg)
        normal_m = _A_M / sqrt(1.0 - _E2 * sin(lat) ** 2)
        outward_m = normal_m * cos(lat) - sin(lat) * north_m
        z_m = normal_m * (1.0 - _E2) * sin(lat) + cos(lat) * north_m
        turn = atan2(east_m, outward_m)
        from_axis_m = hypot(outward_m, east_m)
        reduced = atan2(z_m * _A_M, from_axis_m * _B_M)
        latitude = atan2(
            z_m + _E2 / (1.0 - _E2) * _B_M * sin(reduced) ** 3, from_axis_m - _E2 * _A_M * cos(reduced) ** 3
        )
        longitude_deg = (self.longitude_deg + degrees(turn) + 180.0) % 360.0 - 180.0
        return [round(longitude_deg, _DIGITS), round(degrees(latitude), _DIGITS)]


def geojson_of(component: Component, options: ExportOptions) -> dict[str, Any]:
    """Return a FeatureCollection.

    Raises:
        OfflineError: the map's position on the earth is not given.
    """
    if options.origin is None:
        raise OfflineError(
            "--format geojson: a map holds no position on the earth; give "
            f"--origin LAT_DEG,LON_DEG,HEADING_DEG of its frame, {component.frame_name}"
        )
    place = TangentPlane(options.origin)
    return {"type": "FeatureCollection", "features": [*_tags(component, place), *_runs(component, place)]}


def _tags(component: Component, place: TangentPlane) -> list[dict[str, Any]]:
    features = []
    for tag in component.tags:
        spread = place.R_east_map @ tag.covariance @ place.R_east_map.T
        sigmas_m = [float(v) if np.isfinite(v) else None for v in np.sqrt(np.diag(spread))]
        said = {
            "kind": "tag",
            "family": tag.family,
            "tag_id": tag.tag_id,
            "instance": tag.instance,
            "sigma_east_m": sigmas_m[0],
            "sigma_north_m": sigmas_m[1],
            "n_observations": tag.n_observations,
            "runs": list(tag.runs),
        }
        features.append(_feature("Point", place.longitude_latitude(tag.position_m), said))
    return features


def _runs(component: Component, place: TangentPlane) -> list[dict[str, Any]]:
    features = []
    for run in component.runs:
        line = [place.longitude_latitude(position_m) for position_m in run.T_map_base[:, :2]]
        said = {"kind": "run", "run": run.name, "robot": run.robot_id, "distance_m": run.distance_m}
        # A LineString needs two positions.
        features.append(_feature("LineString", line if len(line) > 1 else line * 2, said))
    return features


def _feature(kind: str, coordinates: list[Any], said: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": said}
