"""Whether the encoders are wired as robot.yaml says: tested by passes of tags, before anything else is estimated.

Each of the eight wirings has its own fit to the same passes (`time_offset_search.fit_passes`), with clock, track, mount
and scales free within wide priors, so that none of these can look like a wrong wiring. The observations then show by
how much a wiring is likelier than another.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.robot import WIRINGS, Wiring
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import Stages, Workers
from groundsbot.offline.measurements import Run
from groundsbot.offline.self_calibration.pass_model import PRIOR_SIGMA
from groundsbot.offline.self_calibration.passes import Passes, find_passes
from groundsbot.offline.self_calibration.time_offset_search import PassEstimate, fit_passes, pass_losses

# Evenly spread over the drive; distinguishes wirings in a tenth of a second.
_MOST_PASSES: Final = 60
_MOST_STEPS: Final = 8
# Errors within a pass are correlated, so a pass counts as one observation; and it counts as no more than this in log
# likelihood, whatever its residuals are, so that a tag that was moved or decoded wrongly decides nothing.
_MOST_OF_A_PASS: Final = 3.0
# Where wheels and tags agree, sigmas of observations are too wide by less than 3 times and too narrow by less than 10.
_LEAST_SCALE: Final = 1.0 / 3.0
_LARGEST_SCALE: Final = 10.0
# Least log Bayes factor: of drives whose tags say nothing about seven alternatives, fewer than 3 in 1,000 reach it.
_LEAST_LOG_BAYES_FACTOR: Final = 8.0
_LOOKS_BACKWARD: Final = Wiring(exchanged=True, left_reversed=True, right_reversed=True)


def check_wiring(runs: Sequence[Run], stages: Stages, workers: Workers) -> None:
    """Refuse a run whose tags contradict the wiring of its encoders, and agree with another one.

    Args:
        runs: runs of any robots.
        stages: notified of progress, and records times.
        workers: worker processes among which the runs are divided.

    Raises:
        OfflineError: naming the wiring that fits, and what to change.
    """
    names = [run.name for run in runs]
    for run, fitting in zip(
        runs, workers.map(_fitting_wirings, runs, names, stages, "wiring of the encoders"), strict=True
    ):
        if Wiring() not in fitting:
            raise OfflineError(_contradiction(run, fitting))


def _fitting_wirings(run: Run, _stages: Stages) -> list[Wiring]:
    return fitting_wirings(run)


def fitting_wirings(run: Run) -> list[Wiring]:
    """Return the wirings that the drive may have relative to robot.yaml's, the most likely first.

    `Wiring()` is that of robot.yaml. A drive that does not distinguish wirings, as one straight ahead or past no tags,
    may have several.
    """
    found = _compare(run)
    if Wiring() in found:
        return found
    # Passes were cut by the distance and turn that the wrong wiring has.
    return [again.after(found[0]) for again in _compare(_rewire(run, found[0]))]


def _rewire(run: Run, wiring: Wiring) -> Run:
    segments = []
    for each in run.wheel_segments:
        left_m, right_m = wiring.order(each.left_m, each.right_m)
        sign_left, sign_right = wiring.signs
        segments.append(replace(each, left_m=sign_left * left_m, right_m=sign_right * right_m))
    return replace(run, wheel_segments=tuple(segments))


def _compare(run: Run) -> list[Wiring]:
    """Return the wirings that are not much less likely than the most likely one, which comes first."""
    moves_sideways = any(each.lateral_m is not None for each in run.wheel_segments)
    passes = None if moves_sideways else find_passes([_busiest_camera(run)], _MOST_PASSES)
    if passes is None:
        return [Wiring()]
    with np.errstate(over="ignore", invalid="ignore"):
        fits = {wiring: _fit(passes, wiring) for wiring in WIRINGS}
    best = min(WIRINGS, key=lambda each: float(fits[each].losses.sum()) + fits[each].prior_cost)
    if not fits[best].explains:
        return [Wiring()]
    factors = {each: _log_bayes_factor(fits[best], fits[each]) for each in WIRINGS}
    fitting = (
        each for each in WIRINGS if not factors[each] >= _LEAST_LOG_BAYES_FACTOR
    )  # also where it is not a number
    return sorted(fitting, key=factors.__getitem__)


def _busiest_camera(run: Run) -> Run:
    """Return the run with the one of its cameras that saw most tags, as passes have one sensor."""
    return run.with_camera(int(np.bincount(run.detections.camera, minlength=1).argmax()))


class _WiringFit(NamedTuple):
    """Fit of clock, track, mount and scales under a wiring.

    Attributes:
        losses: (G,) mean negative log-likelihood of the observations of each pass.
        prior_cost: prior cost of the parameters.
        explains: whether the observations fit about as well as their sigmas say.
    """

    losses: FloatArray
    prior_cost: float
    explains: bool


def _fit(passes: Passes, wiring: Wiring) -> _WiringFit:
    left, right = wiring.order(0, 1)
    sign_left, sign_right = wiring.signs
    motion = passes.wheels.motion.copy()
    motion[:, [0, 3]] = sign_left * passes.wheels.motion[:, [left, left + 3]]
    motion[:, [1, 4]] = sign_right * passes.wheels.motion[:, [right, right + 3]]
    rewired = replace(passes, wheels=replace(passes.wheels, motion=motion))
    estimate, _ = fit_passes(rewired, PassEstimate.start(rewired), most_steps=_MOST_STEPS)
    estimate = estimate._replace(scale=np.maximum(estimate.scale, _LEAST_SCALE))
    losses = pass_losses(rewired, estimate) / np.bincount(passes.group)
    return _WiringFit(
        losses,
        0.5 * float(((estimate.parameters / PRIOR_SIGMA) ** 2).sum()),
        bool(np.isfinite(losses).all() and estimate.scale.max() < _LARGEST_SCALE),
    )


def _log_bayes_factor(fit: _WiringFit, other: _WiringFit) -> float:
    """Return by how much one wiring is likelier than another."""
    apart = np.clip(other.losses - fit.losses, -_MOST_OF_A_PASS, _MOST_OF_A_PASS)
    return float(apart.sum()) + other.prior_cost - fit.prior_cost


def _contradiction(run: Run, fitting: Sequence[Wiring]) -> str:
    best, *others = fitting
    if any(each.quantum_m for each in run.wheel_segments):
        present = run.robot.wheels.wiring
        way_out = f"set {best.after(present).settings(present)} in its robot.yaml and give it with --robot"
    else:
        way_out = "correct the signs or the order of the recording's wheels or speeds, and import it again"
    if best == _LOOKS_BACKWARD:
        way_out += ", unless its camera looks backward and mount.yaw_rad has to say so"
    elif others:
        way_out += f"; or {others[0].words()}: `groundsbot-onboard check --push` finds out"
    return f"{run.log}: wheels and tags contradict each other: {best.words()}; {way_out}"
