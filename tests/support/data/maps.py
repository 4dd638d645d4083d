"""Maps and truths made by hand, whose figures are known."""

from pathlib import Path
from typing import Any

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.evaluation.truth import TrueRun, Truth
from groundsbot.offline.maps.fit_results import AlignmentResult, MeasurementResult
from groundsbot.offline.maps.parameter_results import CalibrationResult, ConsistencyCheck, ScaleBudget
from groundsbot.offline.maps.result import AdviceResult, Component, MapResult, RunResult, StartToStart, TagResult

STEP_NS = 100_000_001  # so that stamps do not fit into a float of seconds

START_B = np.array([10.0, 2.0, np.pi / 2])
TAG_PLACES = {("tag36h11", 3): (4.0, 1.0), ("tag36h11", 7): (6.0, -2.0), ("tag25h9", 3): (9.0, 5.0)}


def make_run(name: str, T_map_start: FloatArray, covariance: FloatArray, n: int = 20) -> RunResult:
    """A run that drives an arc from its start, a keyframe every STEP_NS."""
    steps = np.arange(n)[:, np.newaxis] * np.array([0.1, 0.0, 0.02])
    robot_id, run_id = name.split("_")
    return RunResult(
        name=name,
        run=name,
        log=Path("logs") / name,
        robot_id=robot_id,
        run_id=run_id,
        T_map_start=T_map_start,
        covariance=covariance,
        stamps_ns=1_800_000_000_000_000_000 + np.arange(n, dtype=np.int64) * STEP_NS,
        T_map_base=se2.compose(T_map_start, se2.exp(steps)),
        distance_m=0.1 * (n - 1),
    )


def make_component(a: str = "red_one", b: str = "blue_two") -> Component:
    """Two runs and three tags, exactly right, with a joint covariance that couples everything but the frame's start."""
    n = 3 + 2 * len(TAG_PLACES)
    root = 0.02 * np.random.default_rng(5).normal(size=(n, n)) + 0.05 * np.eye(n)
    joint = np.zeros((3 + n, 3 + n))
    joint[3:, 3:] = root @ root.T
    runs = (make_run(a, np.zeros(3), np.zeros((3, 3))), make_run(b, START_B, joint[3:6, 3:6]))
    tags = []
    for index, ((family, tag_id), place) in enumerate(TAG_PLACES.items()):
        rows = slice(6 + 2 * index, 8 + 2 * index)
        seen_by = (a, b) if index < 2 else (b,)
        tags.append(TagResult(family, tag_id, "", 0.15, np.array(place), joint[rows, rows], 10 + index, seen_by))
    start = StartToStart(a, b, START_B[:2].copy(), joint[3:5, 3:5])
    return Component(a, runs, tuple(tags), joint, cost=12.5, n_residuals=40, start_to_start=(start,))


def make_map(*components: Component) -> MapResult:
    """A whole map; of one component unless others are given."""
    components = components or (make_component(),)
    return MapResult(
        components=components,
        alignments=(AlignmentResult("red_one", "blue_two", START_B, 2, 2, 0.03, (("tag36h11", 9),)),),
        noise=NoiseParameters(),
        calibration=(CalibrationResult("red", "wheel_scale", 0, 0.001, 0.002, 0.005),),
        measurements=(
            MeasurementResult(
                "start", "red_one", "blue_two", START_B, np.full(3, 0.1), 0, START_B + 0.01, 0.2, 0.5, contradicts=False
            ),
            MeasurementResult("distance", "red_one", "tag36h11:3", np.array([4.1]), np.array([0.01]), None),
        ),
        checks=(ConsistencyCheck("turn", 0, "red", None, 0.01, 0.002, 0.01),),
        scale_budgets=(ScaleBudget(0, 0.003, {"wheels": 0.75, "tags": 0.25}),),
        warnings=("tag 9 lies elsewhere",),
        advice=(
            AdviceResult(
                "pass",
                0,
                "red_one",
                (("tag36h11", 3, ""), ("tag36h11", 7, "")),
                np.array([[0.0, 0.0], [2.0, 0.1]]),
                14.2,
                ("tag25h9", 3, ""),
                0.31,
                0.18,
            ),
            AdviceResult(
                "tag",
                0,
                "blue_two",
                (("tag36h11", 7, ""),),
                np.array([[6.5, -1.0]]),
                None,
                ("tag25h9", 3, ""),
                0.31,
                0.2,
            ),
        ),
    )


def make_truth(component: Component, T_world_map: FloatArray | None = None) -> Truth:
    """The truth that a component would be exactly right by, the world's frame lying anywhere."""
    T = np.zeros(3) if T_world_map is None else T_world_map
    return Truth(
        runs={run.name: TrueRun(run.stamps_ns, se2.compose(T, run.T_map_base)) for run in component.runs},
        tags_m={(tag.family, tag.tag_id, tag.instance): se2.apply(T, tag.position_m) for tag in component.tags},
        ambiguous=frozenset(),
    )


def suspect_entry(tag_id: int) -> dict[str, Any]:
    """A moved tag among the `suspect_tags` of map.json; its places are in order of time."""
    entry = {"tag_id": tag_id, "family": "f", "kind": "moved", "runs": [], "evidence": "by 0.30 m"}
    return entry | {"has_ordered_places": True}
