"""Comparison of a map with a survey, both of which may be wrong.

The survey is aligned with the map by a rigid transform, weighted by the joint covariance of both. Each entry is then
tested for a shift of its own (Baarda, "A testing procedure for use in geodetic networks", 1968): the prediction from
the map and all other entries against the entry. The worst is removed, and the rest is tested again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from scipy.special import chdtrc, chdtri

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import fit_transform, se2
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.evaluation.survey_errors import ComponentSurvey, EntryResult, SurveyErrors
from groundsbot.offline.evaluation.survey_file import SurveyEntry
from groundsbot.offline.maps import Component, MapResult

# Probability that a correct survey has an entry rejected.
FALSE_ALARM: Final = 1e-3
_MAX_STEPS: Final = 20


def evaluate_survey(result: MapResult, entries: Sequence[SurveyEntry]) -> SurveyErrors:
    """Compare every component that shares three entries or more.

    Raises:
        OfflineError: no component shares three, two entries refer to one tag, or their positions determine no rotation.
    """
    components, found = [], set()
    for component in result.components:
        matched = match_entries(component, entries)
        found |= {k for _, k in matched}
        if len(matched) >= 3:
            components.append(compare_entries(component, [i for i, _ in matched], [entries[k] for _, k in matched]))
    if not components:
        raise OfflineError(
            f"the survey shares {len(found)} tags with the map, at least three in one component are "
            "needed; measure more tags, or give the survey of this map"
        )
    return SurveyErrors(tuple(components), tuple(entry for k, entry in enumerate(entries) if k not in found))


def match_entries(component: Component, entries: Sequence[SurveyEntry]) -> list[tuple[int, int]]:
    """Return (tag, entry) by index for each entry that refers to a tag of the component.

    Raises:
        OfflineError: two entries refer to one tag.
    """
    named: dict[tuple[int, str], list[int]] = {}
    for i, tag in enumerate(component.tags):
        named.setdefault((tag.tag_id, tag.instance), []).append(i)
    matched = [(i, k) for k, entry in enumerate(entries) for i in _tags_of(component, entry, named)]
    _check_one_entry_per_tag(component, [i for i, _ in matched])
    return matched


def _tags_of(component: Component, entry: SurveyEntry, named: Mapping[tuple[int, str], Sequence[int]]) -> list[int]:
    """Return the component's tag that an entry means, `named` by id and instance; none if ambiguous."""
    same = named.get((entry.tag_id, entry.instance), ())
    fits = [i for i in same if entry.family in ("", component.tags[i].family)]
    return fits if len(fits) == 1 else []


def _check_one_entry_per_tag(component: Component, tags: Sequence[int]) -> None:
    """Refuse a tag that two entries mean, e.g. once with its family and once without."""
    for i in tags:
        if tags.count(i) > 1:
            tag = component.tags[i]
            raise OfflineError(
                f"the survey has tag {tag.tag_id}{tag.instance} of {tag.family} twice, once without its family; leave "
                "one row out, or give the family of both"
            )


def _check_extent(component: Component, entries: Sequence[SurveyEntry]) -> None:
    """Refuse entries so close together that their rotation about their centre is uncertain by a radian."""
    places_m = np.array([entry.position_m for entry in entries])
    weight = np.array([entry.sigma_m for entry in entries]) ** -2.0
    from_middle_m = places_m - weight @ places_m / weight.sum()
    if weight @ (from_middle_m**2).sum(axis=1) <= 1.0:
        raise OfflineError(
            f"the survey has the tags of {component.runs[0].name}'s component all in one place (within sigma_m), so "
            "its rotation is undetermined; measure tags farther apart"
        )


@dataclass(frozen=True)
class _SurveyFit:
    """Result of a least-squares fit of the survey to the map.

    Attributes:
        T_map_survey: (3,).
        residual: (2n,) map minus survey, in map axes.
        reliability: (2n, 2n) A = Q^-1 R, with R the redundancy matrix of the fit and Q the covariance; A Q A = A.
    """

    T_map_survey: FloatArray
    residual: FloatArray
    reliability: FloatArray

    def estimate_shift(self, rows: Sequence[int]) -> tuple[FloatArray, float]:
        """Return the estimated shift of the entries with these rows, and its squared Mahalanobis length."""
        at = np.array(rows)
        pulled = (self.reliability @ self.residual)[at]
        shift: FloatArray = np.asarray(np.linalg.pinv(self.reliability[np.ix_(at, at)], rcond=1e-12) @ pulled)
        return shift, float(pulled @ shift)


def _adjust(map_m: FloatArray, survey_m: FloatArray, covariance: FloatArray) -> _SurveyFit:
    """Fit the transform by generalised least squares."""
    information: FloatArray = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
    T_map_survey = fit_transform(map_m, survey_m)
    for _ in range(_MAX_STEPS):
        placed = se2.apply(T_map_survey, survey_m)
        jacobian = _transform_jacobian(placed)
        normal = jacobian.T @ information @ jacobian
        step = _solve_least_norm(normal, jacobian.T @ information @ (map_m - placed).reshape(-1))
        T_map_survey = se2.compose(np.array([0.0, 0.0, step[2]]), T_map_survey) + np.array([step[0], step[1], 0.0])
        if np.abs(step).max() < 1e-12:
            break
    placed = se2.apply(T_map_survey, survey_m)
    jacobian = _transform_jacobian(placed)
    weighted = information @ jacobian
    reliability: FloatArray = information - weighted @ _solve_least_norm(jacobian.T @ weighted, weighted.T)
    return _SurveyFit(T_map_survey, (map_m - placed).reshape(-1), reliability)


def _solve_least_norm(normal: FloatArray, right: FloatArray) -> FloatArray:
    """Return the minimum-norm solution: if the remaining entries lie in one place, any rotation will do."""
    return np.asarray(np.linalg.lstsq(normal, right, rcond=None)[0], dtype=np.float64)


def _transform_jacobian(placed_m: FloatArray) -> FloatArray:
    """Return the Jacobian (2n, 3) of positions with respect to a shift and rotation of the survey about the origin."""
    jacobian = np.zeros((len(placed_m), 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -placed_m[:, 1], placed_m[:, 0]
    return jacobian.reshape(-1, 3)


def compare_entries(component: Component, tags: Sequence[int], entries: Sequence[SurveyEntry]) -> ComponentSurvey:
    """Compare two tags or more of a component, by index, with their entries.

    Raises:
        OfflineError: the entries' positions determine no rotation.
    """
    _check_extent(component, entries)
    map_m = np.array([component.tags[i].position_m for i in tags])
    survey_m = np.array([entry.position_m for entry in entries])
    rows = np.array([(2 * i, 2 * i + 1) for i in tags]).reshape(-1)
    covariance = component.tag_covariance[np.ix_(rows, rows)]
    covariance = covariance + np.diag(np.repeat([entry.sigma_m**2 for entry in entries], 2))
    good = _reject_outliers(map_m, survey_m, covariance)
    swapped = _find_swaps(map_m, survey_m, covariance, good)
    judged = []
    for k, i in enumerate(tags):
        part, adjusted = _fit_entries(map_m, survey_m, covariance, [*sorted({*good, k})])
        at = 2 * part.index(k)
        shift, square = adjusted.estimate_shift([at, at + 1])
        verdict = "fits" if k in good else "swapped" if k in swapped else "wrong"
        other = entries[swapped[k]].tag_id if k in swapped else None
        sigmas = float(np.sqrt(max(square, 0.0)))
        judged.append(EntryResult(component.tags[i], entries[k], shift, sigmas, verdict, other))
    _, adjusted = _fit_entries(map_m, survey_m, covariance, good)
    residual = map_m[good] - se2.apply(fit_transform(map_m[good], survey_m[good]), survey_m[good])
    scale, scale_sigma = _scale_error(adjusted, map_m[good])
    n_over = residual.size - 3
    square = float(adjusted.residual @ adjusted.reliability @ adjusted.residual)
    return ComponentSurvey(
        component=component,
        entries=tuple(judged),
        T_map_survey=adjusted.T_map_survey,
        rmse_m=float(np.sqrt((residual**2).sum(axis=1).mean())),
        worst_m=float(np.linalg.norm(residual, axis=1).max()),
        scale_error=scale,
        scale_sigma=scale_sigma,
        nees_per_dim=square / n_over if n_over > 0 else None,
    )


def _fit_entries(
    map_m: FloatArray, survey_m: FloatArray, covariance: FloatArray, part: list[int]
) -> tuple[list[int], _SurveyFit]:
    """Return the fit of some entries."""
    rows = np.array([(2 * k, 2 * k + 1) for k in part]).reshape(-1)
    return part, _adjust(map_m[part], survey_m[part], covariance[np.ix_(rows, rows)])


def _reject_outliers(map_m: FloatArray, survey_m: FloatArray, covariance: FloatArray) -> list[int]:
    """Return the entries that are left after removing the worst, one at a time; at least three."""
    limit = chdtri(2, FALSE_ALARM / len(map_m))
    good = list(range(len(map_m)))
    while len(good) > 3:
        _, adjusted = _fit_entries(map_m, survey_m, covariance, good)
        squares = [adjusted.estimate_shift([2 * k, 2 * k + 1])[1] for k in range(len(good))]
        worst = int(np.argmax(squares))
        if squares[worst] <= limit:
            break
        del good[worst]
    return good


def _find_swaps(map_m: FloatArray, survey_m: FloatArray, covariance: FloatArray, good: Sequence[int]) -> dict[int, int]:
    """Return pairs among the rejected entries that fit once exchanged."""
    found: dict[int, int] = {}
    odd = [k for k in range(len(map_m)) if k not in good]
    for a, b in combinations(odd, 2):
        if a in found or b in found:
            continue
        exchanged = survey_m.copy()
        exchanged[[a, b]] = survey_m[[b, a]]
        part, adjusted = _fit_entries(map_m, exchanged, covariance, [*sorted({*good, a, b})])
        rows = [2 * part.index(k) + axis for k in (a, b) for axis in (0, 1)]
        if chdtrc(4, adjusted.estimate_shift(rows)[1]) > FALSE_ALARM:
            found[a], found[b] = b, a
    return found


def _scale_error(adjusted: _SurveyFit, map_m: FloatArray) -> tuple[float, float]:
    """Return the relative excess of the map's scale over the survey's, and its sigma."""
    direction = (map_m - map_m.mean(axis=0)).reshape(-1)
    pulled = adjusted.reliability @ direction
    information = float(direction @ pulled)
    if information <= 0.0:
        return 0.0, float("inf")
    return float(pulled @ adjusted.residual) / information, information**-0.5
